"""The rows of an evaluation as they are measured, and the entries of evaluation.json that they make."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from worldmodel.held_out import ValidationSet
from worldmodel.measurement import Measured, Sampling
from worldmodel.scores import Statistics, compare_clips, score_clips

VARIANTS = {"best": "latents_zero", "still": "without_motion", "posterior": "posterior"}
"""What was measured besides, and the key of the entry that it adds."""


class EvaluationTable:
    """Models, and copying the last frame.

    Args:
        sets: by frame gap, the clips that all models of this gap are measured on.
        sampling: how the best of many futures was found, if it was.
        seed: of the resampling that gives the intervals.
    """

    def __init__(self, sets: dict[int, ValidationSet], sampling: Sampling | None, seed: int) -> None:
        self.sets, self.sampling, self.seed = sets, sampling, seed
        self._episodes = {gap: _episodes(data) for gap, data in sets.items()}
        self._models: dict[str, dict[str, Any]] = {}
        self._copies: dict[str, dict[str, Any]] = {}
        self._measured: dict[int, dict[str, Statistics]] = {gap: {} for gap in sets}

    @property
    def entries(self) -> dict[str, dict[str, Any]]:
        """By name: models in the order in which they came, then copying."""
        return {**self._models, **self._copies}

    def add_copy(self, gap: int, statistics: Statistics) -> None:
        """The row of copying; its name tells the gap where there are several."""
        name = "copy" if len(self.sets) == 1 else f"copy at gap {gap}"
        self._copies[name] = {"frame_gap": gap, "prediction": name} | self._scored(gap, statistics)
        self._measured[gap][name] = statistics

    def add_model(self, name: str, gap: int, measured: Measured, stochastic: bool) -> dict[str, Any]:
        """One model's entry: the best sample's scores where there are samples; motion is that of latents at 0.

        It is compared with copying, and the models before it are compared with it.
        """
        kinds, headline = measured.kinds, measured.headline
        prediction = "latents at 0" if stochastic else "deterministic"
        if "best" in kinds and self.sampling is not None:
            prediction = f"best of {self.sampling.samples} by {self.sampling.select.upper()}"
        entry: dict[str, Any] = {"frame_gap": gap, "prediction": prediction} | self._scored(gap, headline)
        entry["less"] = {}
        for other, statistics in self._measured[gap].items():
            if other in self._models:
                earlier = self._models[other]["less"]
                earlier[name] = compare_clips(statistics, headline, self._episodes[gap], self.seed)
            else:
                entry["less"][other] = compare_clips(headline, statistics, self._episodes[gap], self.seed)
        zero = self._scored(gap, kinds["zero"])
        for kind, key in VARIANTS.items():
            if kind in kinds:
                entry[key] = zero if kind == "best" else self._scored(gap, kinds[kind])
        entry["latents"] = measured.latents
        if measured.latents is not None:
            entry["latents"] = measured.latents | {"psnr_gap": entry["posterior"]["psnr"] - zero["psnr"]}
        self._measured[gap][name] = headline
        self._models[name] = entry
        return entry

    def _scored(self, gap: int, statistics: Statistics) -> dict[str, Any]:
        return score_clips(statistics, self._episodes[gap], self.seed)


def _episodes(data: ValidationSet) -> NDArray[np.int64]:
    """(clips,) the episode that each clip is from."""
    starts = data.source.spread(data.clips, data.frames)
    return np.searchsorted(data.source.dataset.episode_slices[:, 1], starts, side="right")
