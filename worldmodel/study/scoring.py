"""One contestant's scores: `evaluate-worldmodel` on the test data, done again only if something has changed."""

from __future__ import annotations

import json
from typing import Any

from data_collection.dataset import RGBDDataset
from envs.errors import UsageError
from envs.files import write_json
from worldmodel import evaluate, perceptual_weights
from worldmodel.checkpoint import content_hashes
from worldmodel.perceptual import SMALLEST
from worldmodel.scores import PICTURE_SCORES
from worldmodel.study.options import StudyOptions
from worldmodel.study.plan import Contestant
from worldmodel.study.training import folder_of
from worldmodel.training_data import check_apart

CONTEXT = 2
"""Frames that every model sees."""
_EVALUATION, _PROTOCOL = "evaluation.json", "protocol.json"


def check_lengths(options: StudyOptions) -> None:
    """See before the first training that the test episodes are long enough to be scored on.

    Raises:
        UsageError: they are not, or some are training or validation episodes.
    """
    test = RGBDDataset(options.test)
    for path in (options.train, options.validation):
        check_apart(RGBDDataset(path), test)
    frames = CONTEXT + options.averaged[-1]
    span = max(c.gap for c in options.contestants) * (frames - 1) + 1
    if test.episode_lengths.max() < span:
        raise UsageError(
            f"no test episode is {span} frames long, as {frames} frames at the widest gap need (the longest has "
            f"{test.episode_lengths.max()}); give shorter --horizons or a narrower --gap"
        )


def scores_of(options: StudyOptions, contestant: Contestant) -> dict[str, Any] | None:
    """A contestant's evaluation.json, if it is of this model, on this test data, by this protocol; else None.

    Where it was to be scored by VGG and the weights were not to be had, it counts until they are there.
    """
    folder = options.out / "scores" / contestant.run
    try:
        protocol = json.loads((folder / _PROTOCOL).read_text())
        evaluation: dict[str, Any] = json.loads((folder / _EVALUATION).read_text())
    except (OSError, ValueError):
        return None
    if protocol != _protocol(options, contestant):
        return None
    return None if _lacks_vgg(options, evaluation) and perceptual_weights.are_cached() else evaluation


def score(options: StudyOptions, contestant: Contestant) -> dict[str, Any]:
    """Evaluate a contestant as far ahead as the study looks."""
    folder = options.out / "scores" / contestant.run
    (folder / _PROTOCOL).unlink(missing_ok=True)  # written last: without it the rest does not count
    evaluate.main(
        evaluate.EvaluationOptions(
            data=options.test,
            out=folder,
            models=(str(folder_of(options, contestant)),),
            clips=options.clips,
            predicted=options.averaged[-1],
            context=CONTEXT,
            samples=options.samples,
            select=options.select,
            vgg=options.vgg,
            seed=options.seed,
            device=options.device,
        )
    )
    write_json(folder / _PROTOCOL, _protocol(options, contestant))
    evaluation: dict[str, Any] = json.loads((folder / _EVALUATION).read_text())
    return evaluation


def averages(entry: dict[str, Any], horizons: tuple[int, ...]) -> dict[str, dict[str, float | None]]:
    """Scores over the first frames of one prediction.

    Args:
        entry: of a model in evaluation.json, or its `latents_zero`.
        horizons: over how many frames.

    Returns:
        By horizon, each picture score's mean over so many frames; None where the model has no such score.
    """
    curves = entry["curves"]
    return {
        str(horizon): {
            name: sum(curves[name][:horizon]) / horizon if _whole(curves.get(name), horizon) else None
            for name in PICTURE_SCORES
        }
        for horizon in horizons
    }


def _lacks_vgg(options: StudyOptions, evaluation: dict[str, Any]) -> bool:
    camera = RGBDDataset(options.test).camera
    wanted = options.vgg and min(camera.height, camera.width) >= SMALLEST
    return wanted and "vgg" not in evaluation["models"]["copy"]["curves"]


def _whole(curve: list[float | None] | None, horizon: int) -> bool:
    return curve is not None and len(curve) >= horizon and None not in curve[:horizon]


def _protocol(options: StudyOptions, contestant: Contestant) -> dict[str, Any]:
    """What the scores depend on."""
    return {
        "test": RGBDDataset(options.test).content_hash,
        "model": content_hashes(folder_of(options, contestant)),
        "predicted": options.averaged[-1],
        "context": CONTEXT,
        "clips": options.clips,
        "samples": options.samples,
        "select": options.select,
        "vgg": options.vgg,
        "seed": options.seed,
    }
