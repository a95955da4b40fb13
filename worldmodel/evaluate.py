"""Command `evaluate-worldmodel`: scores of trained models on a dataset, beside copying the last frame."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro
from tqdm import tqdm

from data_collection.dataset import RGBDDataset
from envs import command as command_line
from envs.errors import UsageError
from envs.files import locked, write_json, written_aside
from worldmodel import evaluation_report as report
from worldmodel.checkpoint import content_hashes, data_seen, load_inference, load_model
from worldmodel.clips import ClipSource
from worldmodel.devices import best_precision, find_device
from worldmodel.evaluation_table import EvaluationTable
from worldmodel.held_out import ValidationSet
from worldmodel.interface import check_fits
from worldmodel.measurement import Networks, Sampling, measure_copy, measure_model
from worldmodel.memory import keep_freed_memory
from worldmodel.perceptual import SMALLEST, PerceptualNetwork
from worldmodel.perceptual_weights import WeightsUnavailable, load_weights
from worldmodel.sampling import Selection
from worldmodel.scores import RESAMPLES
from worldmodel.shelf import Shelf
from worldmodel.world_model import WorldModel


@dataclass(frozen=True)
class EvaluationOptions:
    """Score models on free-running prediction, the same clips for all that have the same frame gap.

    With --samples 100, as in the paper, a model with latents predicts each clip 100 times from latents of the prior and
    the best prediction counts; without, and for models without latents, there is one prediction, with latents at 0.
    Copying the last frame seen stands beside them as `copy`. Flow, disocclusion, segmentation and tracking are scored
    where the dataset has ground truth (collect-rollouts --ground-truth).
    """

    data: Path
    """Dataset that no model was trained on."""
    out: Path = Path("runs/evaluation")
    """Folder for evaluation.json, evaluation.md and curves.png."""
    models: Annotated[tuple[str, ...], tyro.conf.arg(aliases=("--model",))] = ("t3vip",)
    """Shipped names, training runs, or folders with config.json and model.safetensors."""
    clips: int = 256
    """Clips, spread evenly over the dataset."""
    predicted: int = 10
    """Frames to predict; more than a model was trained for is allowed, as long as the episodes are that long."""
    context: int = 2
    """Frames that the models see."""
    samples: int = 0
    """Futures of each clip of which the best counts; 100 in the paper. 0 for latents at 0 only, which is far faster."""
    select: Selection = "vgg"
    """What the best sample is the best in, over all of its frames: `vgg` (lowest LPIPS, as in the paper) or `psnr`. All
    scores are then those of the sample chosen."""
    frame_gap: int | None = None
    """Control steps between frames, instead of what each model was trained with; the actions between are added up."""
    vgg: bool = True
    """Score by VGG too. Fetches its weights (60 MB) the first time; without a network the scores are left out."""
    without_motion: bool = False
    """Score each model once more with every transform the identity, every kernel a copy: what painting does alone."""
    batch: int = 16
    """Clips at a time."""
    seed: int = 0
    """Of the latents and of the resampling that gives the intervals."""
    device: str = "auto"
    """Where the models run: cpu, cuda, or auto for a GPU where there is one."""

    def __post_init__(self) -> None:
        for name in ("clips", "predicted", "context", "batch"):
            if getattr(self, name) < 1:
                raise UsageError(f"--{name} is {getattr(self, name)}; give at least 1")
        if self.frame_gap is not None and self.frame_gap < 1:
            raise UsageError(f"--frame-gap is {self.frame_gap}; give at least 1, or leave it to the models")
        if self.samples < 0:
            raise UsageError(f"--samples is {self.samples}; give 0 for latents at 0 only, or for example 100")
        if not self.models:
            raise UsageError("--models is empty; name at least one")
        for name in self.models:
            if name == "copy" or name.startswith("copy at gap "):
                raise UsageError(f"--models {name} would go by the name of copying the last frame; give ./{name}")


def main(options: EvaluationOptions) -> None:
    """Score, print, write."""
    keep_freed_memory()
    dataset = RGBDDataset(options.data)
    models = {name: load_model(name, options.device) for name in options.models}
    remarks = [note for name, model in models.items() for note in _remarks(name, model, dataset)]
    for note in remarks:
        print(note)
    gaps = {name: options.frame_gap or model.frame_gap for name, model in models.items()}
    sets = _clip_sets(dataset, sorted(set(gaps.values())), options)
    options.out.mkdir(parents=True, exist_ok=True)
    networks, notes = _networks(options, dataset)
    select: Selection = options.select if networks is not None else "psnr"
    sampling = Sampling(options.samples, select, options.seed) if options.samples else None
    table = EvaluationTable(sets, sampling, options.seed)
    document = _document(options, dataset, sets, select, remarks + notes)
    kept = options.out / "measured"
    total = sum(map(_count, [*sets.values(), *(sets[gap] for gap in gaps.values())]))
    with locked(options.out), tqdm(total=total, unit="clip") as bar:
        for gap, data in sets.items():
            bar.set_description("copy")
            shelf = Shelf(kept, _subject(options, dataset, gap, networks))
            table.add_copy(gap, measure_copy(data, networks, bar.update, shelf))
        for name, model in models.items():
            bar.set_description(name)
            data, inference = sets[gaps[name]], load_inference(name, model)
            data = replace(data, source=data.source.with_actions(model.context.action_column))
            shelf = Shelf(kept, _subject(options, dataset, gaps[name], networks, name))
            still = options.without_motion
            measured = measure_model(model, data, networks, sampling, inference, still, bar.update, shelf)
            entry = table.add_model(name, gaps[name], measured, stochastic=bool(model.latent_channels))
            bar.write(report.line(name, entry))
            document["models"] = table.entries
            _write(options.out, document)
        shutil.rmtree(kept)
    print(f"\n{report.markdown(document)}")
    for file in ("evaluation.json", "evaluation.md", "curves.png"):
        print(options.out / file)


def _remarks(name: str, model: WorldModel, dataset: RGBDDataset) -> list[str]:
    """What the reader of the report must know about this model on this data."""
    notes = check_fits(name, model, dataset)
    if dataset.content_hash in data_seen(name, "train"):
        notes.append(f"{name} was trained on this data: its scores say nothing about data that it has not seen")
    elif dataset.content_hash in data_seen(name, "validation"):
        notes.append(f"{name} was chosen by its scores on this data, which are therefore a little too good")
    return notes


def _clip_sets(dataset: RGBDDataset, gaps: list[int], options: EvaluationOptions) -> dict[int, ValidationSet]:
    """The clips for each frame gap, read from the disk as they are scored: a few of all that the data holds."""
    sets: dict[int, ValidationSet] = {}
    frames = options.context + options.predicted
    for gap in gaps:
        source = ClipSource(dataset, gap, memory_limit=0)
        sets[gap] = ValidationSet(source, options.clips, frames, options.context, options.batch)
        _count(sets[gap])  # now, not after the first model: are the episodes long enough?
    return sets


def _count(data: ValidationSet) -> int:
    return len(data.source.spread(data.clips, data.frames))


def _subject(
    options: EvaluationOptions, dataset: RGBDDataset, gap: int, networks: Networks | None, model: str | None = None
) -> dict[str, Any]:
    """What the measurements of a batch depend on; without a model, those of copying."""
    subject = {
        "data": dataset.content_hash,
        "frame_gap": gap,
        "vgg": networks is not None,
        "device": str(find_device(options.device)),
        **{name: getattr(options, name) for name in ("clips", "predicted", "context", "batch")},
    }
    if model is not None:
        subject["model"] = content_hashes(model)
        subject |= {name: getattr(options, name) for name in ("samples", "select", "seed", "without_motion")}
    return subject


def _networks(options: EvaluationOptions, dataset: RGBDDataset) -> tuple[Networks | None, list[str]]:
    """What judges by VGG, and what the reader of the report must know where there is none."""
    reason = "The VGG scores were left out (--no-vgg)"
    if options.vgg and min(dataset.camera.height, dataset.camera.width) < SMALLEST:
        reason = f"The VGG scores are left out: they need pictures of at least {SMALLEST} pixels a side"
    elif options.vgg:
        try:
            weights = load_weights()
        except WeightsUnavailable as error:
            reason = f"The VGG scores are left out: {error}"
        else:
            device = find_device(options.device)
            deciding = PerceptualNetwork(weights).to(device)
            precision = best_precision(device)
            same = precision == deciding.precision
            return Networks(deciding if same else PerceptualNetwork(weights, precision).to(device), deciding), []
    if options.samples and options.select == "vgg":
        reason += "; the best sample is chosen by PSNR"
    print(reason)
    return None, [reason]


def _document(
    options: EvaluationOptions,
    dataset: RGBDDataset,
    sets: dict[int, ValidationSet],
    select: Selection,
    notes: list[str],
) -> dict[str, Any]:
    return {
        "data": {"path": str(options.data), "env_id": dataset.attrs["env_id"], "hash": dataset.content_hash},
        "protocol": {
            "clips": max(map(_count, sets.values())),
            "context": options.context,
            "predicted": options.predicted,
            "samples": options.samples,
            "select": select,
            "seed": options.seed,
            "resamples": RESAMPLES,
            "notes": notes,
        },
        "models": {},
    }


def _write(folder: Path, document: dict[str, Any]) -> None:
    write_json(folder / "evaluation.json", document)
    with written_aside(folder / "evaluation.md") as aside:
        aside.write_text(report.markdown(document))
    report.draw_curves(document, folder / "curves.png")


def command() -> None:
    """Entry point of `evaluate-worldmodel`."""
    command_line.run(EvaluationOptions, main)
