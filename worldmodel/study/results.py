"""study.json: everything that a study has found so far."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open

from data_collection.dataset import RGBDDataset
from envs.errors import UsageError
from worldmodel.checkpoint import CONFIG, WEIGHTS, find_model
from worldmodel.config_file import read_config
from worldmodel.scores import PICTURE_SCORES, SCORES
from worldmodel.study.options import StudyOptions
from worldmodel.study.paper import numbers_of, setting_of
from worldmodel.study.plan import Contestant
from worldmodel.study.scoring import CONTEXT, averages, scores_of
from worldmodel.study.training import Progress, command_of, folder_of, progress_of

MOTION_SCORES = tuple(score.name for score in SCORES if score.name not in PICTURE_SCORES)


def collect(options: StudyOptions) -> dict[str, Any]:
    """What is trained and scored of a study, in the order of the paper's table.

    Returns:
        `models` by run name: `title`, `frame_gap`, `command`, `training` (with `machine`, None of a run that does not
        say what it was trained on), `prediction` (how the scored prediction was
        made), `horizons` (by number of frames, each picture score), `latents_zero` (the same with latents at 0, where
        that is not what `horizons` has), `curves`, `intervals` (over all frames), `motion`, `latents` (their use) and
        `paper` (the paper's numbers, None where it gives none). `copy` by frame gap: `horizons`, `curves` and `motion`
        of copying the last frame seen. `missing`: runs that are not there yet.

    Raises:
        UsageError: models were trained on different data.
    """
    env_id = str(RGBDDataset(options.test).attrs["env_id"])
    models: dict[str, Any] = {}
    copies: dict[str, Any] = {}
    missing: list[str] = []
    trained_on: dict[str, str] = {}
    for contestant in options.contestants:
        progress = progress_of(options, contestant)
        scores = scores_of(options, contestant) if progress is not None and progress.whole else None
        if progress is None or scores is None:
            missing.append(contestant.run)
            continue
        trained_on[contestant.run] = _same_data(options, contestant, trained_on)
        (ours,) = (entry for name, entry in scores["models"].items() if name != "copy")
        models[contestant.run] = _entry(options, contestant, progress, ours, env_id)
        copied = scores["models"]["copy"]
        copies[str(contestant.gap)] = {
            "horizons": averages(copied, options.averaged),
            "curves": copied["curves"],
            "motion": {name: copied[name] for name in MOTION_SCORES},
        }
    return {
        "format": 1,
        "study": options.study,
        "title": options.plan.title,
        "question": options.plan.question,
        "data": {name: _data(getattr(options, name)) for name in ("train", "validation", "test")},
        "budget": {"minutes": options.minutes} if options.steps is None else {"steps": options.steps},
        "settings": {
            "preset": options.preset,
            "config": {} if options.config is None else read_config(options.config),
            "seed": options.seed,
            "context": CONTEXT,
            "horizons": list(options.averaged),
            "clips": options.clips,
            "samples": options.samples,
            "select": options.select,
        },
        "paper": {str(gap): _setting(options, gap, env_id) for gap in sorted({c.gap for c in options.contestants})},
        "models": models,
        "copy": copies,
        "missing": missing,
    }


def _entry(
    options: StudyOptions, contestant: Contestant, progress: Progress, scores: dict[str, Any], env_id: str
) -> dict[str, Any]:
    model = find_model(folder_of(options, contestant))
    origin = json.loads((model / CONFIG).read_text())["origin"]
    zero = scores.get("latents_zero")
    return {
        "title": contestant.title,
        "name": contestant.name,
        "frame_gap": contestant.gap,
        "command": command_of(options, contestant),
        "training": {
            "steps": progress.step,
            "minutes": progress.seconds / 60,
            "best_step": origin["step"],
            "parameters": _parameters(model / WEIGHTS),
            "machine": origin.get("machine"),
        },
        "prediction": scores["prediction"],
        "horizons": averages(scores, options.averaged),
        "latents_zero": None if zero is None else averages(zero, options.averaged),
        "curves": scores["curves"],
        "intervals": scores["intervals"],
        "motion": {name: scores[name] for name in MOTION_SCORES},
        "latents": scores.get("latents"),
        "paper": numbers_of(options.study, contestant, env_id),
    }


def _same_data(options: StudyOptions, contestant: Contestant, others: dict[str, str]) -> str:
    """The hash of the data that a contestant was trained on, which must be the others'."""
    origin = json.loads((find_model(folder_of(options, contestant)) / CONFIG).read_text())["origin"]
    for other, theirs in others.items():
        if origin["data"]["train"] != theirs:
            raise UsageError(
                f"{contestant.run} and {other} were trained on different data; remove the folder of one of them in "
                f"{options.out / 'models'}"
            )
    return str(origin["data"]["train"])


def _data(path: Path) -> dict[str, Any]:
    dataset = RGBDDataset(path)
    return {
        "path": str(path),
        "env_id": dataset.attrs["env_id"],
        "episodes": dataset.episodes,
        "hash": dataset.content_hash,
    }


def _setting(options: StudyOptions, gap: int, env_id: str) -> dict[str, Any] | None:
    setting = setting_of(options.study, gap, env_id)
    if setting is None:
        return None
    return {
        "table": setting.table,
        "dataset": setting.dataset,
        "skip": setting.skip,
        "test_steps": setting.test_steps,
    }


def _parameters(weights: Path) -> int:
    with safe_open(weights, "pt") as file:
        return sum(int(torch.Size(file.get_slice(name).get_shape()).numel()) for name in file.keys())  # noqa: SIM118
