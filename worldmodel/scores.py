"""From what was measured on each clip to scores, curves over the predicted frames, and intervals.

Every score is a formula of means over clips (a PSNR that of the mean squared error, an F1 that of the pixel counts), so
one resampling of the clips gives intervals for all of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Statistics = dict[str, Tensor]
"""What was measured: (clips, P) for each predicted frame, or (clips, 1) over all frames of a clip."""
Means = Mapping[str, Tensor]
RESAMPLES = 1000
COVERAGE = 0.95


@dataclass(frozen=True)
class Score:
    """One column of the table."""

    name: str
    title: str
    better: str
    """`higher` or `lower`."""
    needs: tuple[str, ...]
    """Statistics without which there is no such score."""
    formula: Callable[[Means], Tensor]
    """Of the statistics' means over clips, (..., P) or (..., 1)."""
    digits: int = 3


def _ratio(above: str, below: str) -> Callable[[Means], Tensor]:
    return lambda mean: mean[above] / mean[below]


def _mean(name: str) -> Callable[[Means], Tensor]:
    return lambda mean: mean[name]


def _f1(mean: Means) -> Tensor:
    return 2 * mean["found"] / (2 * mean["found"] + mean["invented"] + mean["missed"])


SCORES: tuple[Score, ...] = (
    Score("psnr", "PSNR, dB", "higher", ("se",), lambda mean: -10 * torch.log10(mean["se"].clamp(min=1e-12)), 2),
    Score("ssim", "SSIM", "higher", ("ssim",), _mean("ssim")),
    Score("vgg", "VGG (1 - LPIPS)", "higher", ("lpips",), lambda mean: 1 - mean["lpips"]),
    Score("vgg_cosine", "VGG cosine", "higher", ("cosine",), _mean("cosine")),
    Score("depth_rmse", "depth RMSE, m", "lower", ("depth_se",), lambda mean: mean["depth_se"].sqrt()),
    Score("depth_absrel", "depth AbsRel", "lower", ("depth_absrel",), _mean("depth_absrel"), 4),
    Score("inpainted", "inpainted pixels", "lower", ("inpainted",), _mean("inpainted"), 4),
    Score("flow3d_epe_moving", "3D flow EPE, moving, m", "lower", ("moving",), _ratio("moving_error", "moving"), 4),
    Score(
        "flow3d_epe_moving_relative",
        "3D flow EPE, moving, relative",
        "lower",
        ("moving",),
        _ratio("moving_error", "moving_length"),
    ),
    Score("flow3d_epe_hand", "3D flow EPE, hand, m", "lower", ("hand",), _ratio("hand_error", "hand"), 4),
    Score(
        "flow3d_epe_hand_relative",
        "3D flow EPE, hand, relative",
        "lower",
        ("hand",),
        _ratio("hand_error", "hand_length"),
    ),
    Score("false_flow_m", "false flow on still pixels, m", "lower", ("still",), _ratio("still_flow", "still"), 5),
    Score(
        "flow2d_epe_moving",
        "2D flow EPE, moving, px",
        "lower",
        ("moving_error_px",),
        _ratio("moving_error_px", "moving"),
    ),
    Score("disocclusion_f1", "disocclusion F1", "higher", ("found",), _f1),
    Score(
        "motion_ari", "ARI, moving or not", "higher", ("frames_in_motion",), _ratio("motion_ari", "frames_in_motion")
    ),
    Score("body_ari", "ARI, moving bodies", "higher", ("frames_in_motion",), _ratio("body_ari", "frames_in_motion")),
    Score("tracking_error", "TCP off, share of its way", "lower", ("way",), _ratio("tcp_error", "way")),
)
PICTURE_SCORES = tuple(score.name for score in SCORES[:7])


def score_clips(statistics: Statistics, episodes: NDArray[np.int64], seed: int = 0) -> dict[str, Any]:
    """All scores of one row of the table.

    Args:
        statistics: see `Statistics`.
        episodes: (clips,) the episode that each clip is from. Clips of an episode resemble each other, so intervals
            come from resampling episodes.
        seed: of the resampling; the same for all rows.

    Returns:
        Each score of `SCORES` by name, the mean over the predicted frames, or None where it is not defined; `curves`
        with each frame's value where the frames were measured one by one; `intervals` with the 95 % bootstrap interval
        over episodes (percentiles of 1000 resamples), None where there is but one episode.
    """
    once, draws = _once(episodes), _resamples(episodes, seed)
    result: dict[str, Any] = {}
    curves: dict[str, Any] = {}
    intervals: dict[str, Any] = {}
    for score in SCORES:
        result[score.name] = intervals[score.name] = None
        if not defined(score, statistics):
            continue
        curve = score.formula(_means(statistics, once))[0]
        result[score.name] = number(float(curve.mean()))
        if len(curve) > 1 or score.name in PICTURE_SCORES:
            curves[score.name] = [number(value) for value in curve.tolist()]
        if draws is not None:
            intervals[score.name] = _interval(score.formula(_means(statistics, draws)).mean(1))
    return result | {"curves": curves, "intervals": intervals}


def compare_clips(
    ours: Statistics, theirs: Statistics, episodes: NDArray[np.int64], seed: int = 0
) -> dict[str, dict[str, Any]]:
    """How far one row is from another on the same clips.

    Both are resampled together, so that what makes a clip hard for both cancels out.

    Args:
        ours, theirs: of the same clips.
        episodes, seed: see `score_clips`.

    Returns:
        For each score that both have: `difference`, ours less theirs, and its 95 % `interval`.
    """
    once, draws = _once(episodes), _resamples(episodes, seed)
    result = {}
    for score in SCORES:
        if not (defined(score, ours) and defined(score, theirs)):
            continue

        def difference(weights: Tensor, score: Score = score) -> Tensor:
            return (score.formula(_means(ours, weights)) - score.formula(_means(theirs, weights))).mean(1)

        interval = None if draws is None else _interval(difference(draws))
        result[score.name] = {"difference": number(float(difference(once))), "interval": interval}
    return result


def defined(score: Score, statistics: Statistics) -> bool:
    """Whether all that a score is made of was measured."""
    return all(name in statistics for name in score.needs)


def number(value: float) -> float | None:
    """A number for JSON, which knows no NaN."""
    return value if math.isfinite(value) else None


def join(parts: Sequence[Statistics]) -> Statistics:
    """Statistics of batches of clips as those of all clips."""
    return {name: torch.cat([part[name].double().cpu() for part in parts]) for name in parts[0]} if parts else {}


def _interval(values: Tensor) -> list[float] | None:
    """Of resampled values; resamples in which a score is not defined do not count."""
    finite = values[torch.isfinite(values)].numpy()
    if not len(finite):
        return None
    return [float(end) for end in np.quantile(finite, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2])]


def _once(episodes: NDArray[np.int64]) -> Tensor:
    return torch.ones((1, len(episodes)), dtype=torch.float64)


def _means(statistics: Statistics, weights: Tensor) -> Means:
    total = weights.sum(1, keepdim=True)
    return {name: weights @ value / total for name, value in statistics.items()}


def _resamples(episodes: NDArray[np.int64], seed: int) -> Tensor | None:
    """(RESAMPLES, clips) how often each clip counts when episodes are drawn with replacement."""
    names, which = np.unique(episodes, return_inverse=True)
    if len(names) < 2:
        return None
    shares = np.full(len(names), 1 / len(names))
    counts = np.random.default_rng(seed).multinomial(len(names), shares, size=RESAMPLES)
    return torch.from_numpy(counts[:, which]).double()
