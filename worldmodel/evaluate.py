"""Command `evaluate-worldmodel`: scores of trained models on a dataset, beside copying the last frame."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data_collection.dataset import RGBDDataset
from envs import command as command_line
from envs.errors import UsageError
from worldmodel.checkpoint import load_model
from worldmodel.clips import ClipSource
from worldmodel.memory import keep_freed_memory
from worldmodel.validation import Scores, ValidationSet, validate

ROWS = (
    ("psnr", "RGB PSNR, dB"),
    ("copy_psnr", "  copying the last frame"),
    ("depth_rmse", "depth RMSE, m"),
    ("copy_depth_rmse", "  copying the last frame"),
    ("flow_error_moving", "scene-flow error, moving pixels (no motion: 1)"),
    ("flow_error_hand", "scene-flow error, hand (no motion: 1)"),
    ("false_flow_m", "false flow on still pixels, m"),
    ("tracking_error", "TCP off after the last step, share of its way"),
    ("inpainted", "share of inpainted pixels"),
)


@dataclass(frozen=True)
class EvaluationOptions:
    """Score models on free-running prediction with latents at 0, the same clips for all of them.

    The row `NAME without motion` is the same model with every transform replaced by the identity: what its inpainter
    and its splatting do alone. Flow and tracking are scored where the dataset has ground truth.
    """

    data: Path
    """Dataset that no model was trained on."""
    out: Path = Path("runs/evaluation")
    """Folder for evaluation.json."""
    models: tuple[str, ...] = ("t3vip",)
    """Shipped names, training runs, or folders with config.json and model.safetensors."""
    clips: int = 256
    """Clips, spread evenly over the dataset."""
    predicted: int = 10
    """Frames to predict."""
    context: int = 2
    """Frames that the models see."""
    batch: int = 16
    """Clips at a time."""
    device: str = "cpu"
    """Where the models run."""

    def __post_init__(self) -> None:
        for name in ("clips", "predicted", "context", "batch"):
            if getattr(self, name) < 1:
                raise UsageError(f"--{name} is {getattr(self, name)}; give at least 1")
        if not self.models:
            raise UsageError("--models is empty; name at least one")


def main(options: EvaluationOptions) -> None:
    """Score, print, write."""
    keep_freed_memory()
    dataset = RGBDDataset(options.data)
    results: dict[str, Scores] = {}
    for name in options.models:
        model = load_model(name, options.device)
        if (model.camera.height, model.camera.width) != (dataset.camera.height, dataset.camera.width):
            raise UsageError(
                f"{name} wants pictures of {model.camera.height}x{model.camera.width}, {options.data} has "
                f"{dataset.camera.height}x{dataset.camera.width}; collect with another --image-size"
            )
        if model.context.action_dim != dataset.action_dim:
            raise UsageError(
                f"{name} takes actions of {model.context.action_dim} numbers, {options.data} has {dataset.action_dim}; "
                "evaluate on data of the environment it was trained in"
            )
        source = ClipSource(dataset, model.frame_gap)
        clips = ValidationSet(
            source, options.clips, options.context + options.predicted, options.context, options.batch
        )
        results[name] = validate(model, clips)
        results[f"{name} without motion"] = validate(model, clips, still=True)
        for row in (name, f"{name} without motion"):
            print(f"\n{row}, {options.data}, {options.clips} clips")
            print(_table(results[row]))
    _write(options, dataset, results)


def _table(scores: Scores) -> str:
    lines = []
    for key, title in ROWS:
        if key in scores:
            value = scores[key]
            shown = "  ".join(f"{v:7.3f}" for v in value) if isinstance(value, list) else f"{value:7.4f}"
            lines.append(f"{title:48} {shown}")
    return "\n".join(lines)


def _write(options: EvaluationOptions, dataset: RGBDDataset, results: dict[str, Scores]) -> None:
    document: dict[str, Any] = {
        "data": {"path": str(options.data), "env_id": dataset.attrs["env_id"], "hash": dataset.content_hash},
        "clips": options.clips,
        "models": results,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "evaluation.json"
    aside = path.with_suffix(".tmp")
    aside.write_text(json.dumps(document, indent=2) + "\n")
    aside.replace(path)
    print(f"\n{path}")


def command() -> None:
    """Entry point of `evaluate-worldmodel`."""
    command_line.run(EvaluationOptions, main)
