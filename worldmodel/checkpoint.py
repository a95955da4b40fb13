"""Checkpoints that are whole or not there.

    RUN/
      config.json                 options of the run
      metrics.jsonl               one line an interval
      tensorboard/, pictures/     for people
      model/                      the best model so far by validation score; what `load_model` reads
        config.json               architecture, context, and where it came from
        model.safetensors
        inference.safetensors     of a model with latents: the inference network, for evaluation only; may be missing
      checkpoints/step-00001000/  enough to go on exactly
        training.safetensors      weights of model and inference network, Adam's moments
        state.json                step, best score; written last

A folder is written aside, flushed to disk and renamed, so a killed process leaves the last whole one. Every random draw
of a step comes from the run's seed and the step's number: there is no generator state to save.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from envs.errors import UsageError
from worldmodel.config import ModelConfig, ModelContext
from worldmodel.devices import Precision, find_device, find_precision
from worldmodel.inference import InferenceNetwork, inference_network
from worldmodel.models import make_model
from worldmodel.world_model import WorldModel

PRETRAINED = Path(__file__).parent / "pretrained"
WEIGHTS, CONFIG, TRAINING, STATE = "model.safetensors", "config.json", "training.safetensors", "state.json"
INFERENCE = "inference.safetensors"
KEEP = 2


def write_folder(folder: Path, tensors: Mapping[str, Mapping[str, Tensor]], documents: Mapping[str, Any]) -> None:
    """Write safetensors and JSON files as one folder, aside and renamed; an older folder of that name is replaced."""
    aside = folder.with_name(folder.name + ".tmp")
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir(parents=True)
    for name, group in tensors.items():
        save_file({key: value.detach().cpu().contiguous() for key, value in group.items()}, aside / name)
    for name, document in documents.items():
        (aside / name).write_text(json.dumps(document, indent=2) + "\n")
    for path in [*aside.iterdir(), aside]:
        descriptor = os.open(path, os.O_RDONLY)
        os.fsync(descriptor)
        os.close(descriptor)
    if folder.exists():
        old = folder.with_name(folder.name + ".old")
        shutil.rmtree(old, ignore_errors=True)
        folder.rename(old)
        aside.rename(folder)
        shutil.rmtree(old)
    else:
        aside.rename(folder)


def save_model(
    model: WorldModel, folder: Path, origin: Mapping[str, Any], inference: InferenceNetwork | None = None
) -> None:
    """Save weights and config for `load_model`.

    Args:
        origin: where the model came from (options, seed, data hashes, scores), for people and `load_origin`.
        inference: of a model with latents, for `load_inference`; prediction does without it.
    """
    document = {
        "format": 1,
        "kind": model.kind,
        "model": asdict(model.config),
        "context": asdict(model.context),
        "origin": dict(origin),
    }
    tensors = {WEIGHTS: model.state_dict()} | ({INFERENCE: inference.state_dict()} if inference is not None else {})
    write_folder(folder, tensors, {CONFIG: document})


def find_model(name: str | Path) -> Path:
    """The folder of a model: a training run, a folder with config.json and weights, or a shipped name.

    Shipped models of the tabletop go by their kind (`t3vip`), others by environment and kind (`planar-push/t3vip`).
    A folder of that name in the working directory comes first.

    Raises:
        UsageError: nothing of that kind is there.
    """
    for folder in (Path(name), Path(name) / "model", Path(name) / "model.old", PRETRAINED / name):
        if (folder / WEIGHTS).is_file() and (folder / CONFIG).is_file():
            return folder
    raise UsageError(
        f"no model at '{name}'; give a training run, a folder with {CONFIG} and {WEIGHTS}, or a shipped name "
        f"({', '.join(shipped_models()) or 'none is shipped'})"
    )


def shipped_models() -> list[str]:
    """Names of the models that come with the package, those of the tabletop first."""
    folders = (path.parent.relative_to(PRETRAINED) for path in PRETRAINED.rglob(WEIGHTS))
    return [folder.as_posix() for folder in sorted(folders, key=lambda folder: (len(folder.parts), folder))]


def load_model(name: str | Path, device: str | torch.device = "cpu", precision: Precision = "auto") -> WorldModel:
    """Load a world model for use.

    Args:
        name: see `find_model`.
        device: where it shall run; see `find_device`.
        precision: what its network runs in; `auto` is bfloat16 where the device computes in it, else float32.

    Returns:
        The model in evaluation mode.

    Raises:
        UsageError: it is not there or damaged, or there is no such device or precision.
    """
    folder, device = find_model(name), find_device(device)
    try:
        document = json.loads((folder / CONFIG).read_text())
        config, context = dict(document["model"]), dict(document["context"])
        unsaid = {field.name for field in fields(ModelConfig)} - set(config)
        if unsaid:  # defaults change, and weights mean something only with what they were trained with
            raise ValueError(f"its {CONFIG} does not say {', '.join(sorted(unsaid))}")
        hashable: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in context.items()}
        model = make_model(document["kind"], ModelConfig(**config), ModelContext(**hashable))
        model.load_state_dict(load_file(folder / WEIGHTS))
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise UsageError(
            f"the model in {folder} cannot be read ({reason}); train it again or restore the folder"
        ) from error
    model.precision = getattr(torch, find_precision(precision, device))
    return model.to(device).to(memory_format=torch.channels_last).eval()  # type: ignore[call-overload]


def load_inference(name: str | Path, model: WorldModel) -> InferenceNetwork | None:
    """The inference network that was saved beside a model, on the model's device, in evaluation mode.

    Args:
        name: as for `load_model`.
        model: what `load_model` made of it.

    Returns:
        None where the folder has none: the model is deterministic, or was shipped without.

    Raises:
        UsageError: the file is damaged or of another model.
    """
    path = find_model(name) / INFERENCE
    if not model.latent_channels or not path.is_file():
        return None
    network = inference_network(model)
    try:
        network.load_state_dict(load_file(path))
    except (SafetensorError, OSError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise UsageError(f"{path} cannot be read ({reason}); remove it, or restore the folder") from error
    return network.to(model.device).eval()


def load_origin(name: str | Path) -> dict[str, Any]:
    """Where a model came from, as `save_model` was told.

    Args:
        name: see `find_model`.
    """
    origin: dict[str, Any] = json.loads((find_model(name) / CONFIG).read_text()).get("origin", {})
    return origin


def data_seen(name: str | Path, part: Literal["train", "validation"]) -> list[str]:
    """Content hashes of the data that a model was trained on, or chosen by its scores on.

    Those of the models that its weights started from are among them.

    Args:
        name: see `find_model`.
        part: `train` or `validation`.
    """
    hashes, origin = [], load_origin(name)
    while origin:
        hashes += [origin["data"][part]] if part in origin.get("data", {}) else []
        origin = origin.get("start", {})
    return hashes


def content_hashes(name: str | Path) -> dict[str, str]:
    """SHA-256 of each of a model's files, by which one knows whether it is still the same.

    Args:
        name: see `find_model`.
    """
    folder = find_model(name)
    files = (folder / file for file in (CONFIG, WEIGHTS, INFERENCE))
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files if path.is_file()}


def save_training(
    run: Path, modules: Mapping[str, nn.Module], optimiser: torch.optim.Adam, state: dict[str, Any]
) -> None:
    """Write a checkpoint to go on from; only the newest two are kept."""
    tensors = {
        f"{prefix}.{key}": value for prefix, module in modules.items() for key, value in module.state_dict().items()
    }
    for name, parameter in _named_parameters(modules):
        for key, value in optimiser.state.get(parameter, {}).items():
            tensors[f"adam.{key}.{name}"] = torch.as_tensor(value)
    write_folder(run / "checkpoints" / f"step-{state['step']:08d}", {TRAINING: tensors}, {STATE: state})
    for old in _checkpoints(run)[:-KEEP]:
        shutil.rmtree(old)


def load_training(run: Path, modules: Mapping[str, nn.Module], optimiser: torch.optim.Adam) -> dict[str, Any] | None:
    """Load the newest checkpoint into modules and optimiser.

    Returns:
        Its state, or None when the run has no checkpoint yet.
    """
    folders = _checkpoints(run)
    if not folders:
        return None
    try:
        tensors = load_file(folders[-1] / TRAINING)
        state: dict[str, Any] = json.loads((folders[-1] / STATE).read_text())
        for prefix, module in modules.items():
            start = f"{prefix}."
            module.load_state_dict({k[len(start) :]: v for k, v in tensors.items() if k.startswith(start)})
    except (SafetensorError, OSError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise UsageError(
            f"the checkpoint {folders[-1]} does not fit ({reason}); remove it, or give another --out"
        ) from error
    for name, parameter in _named_parameters(modules):
        moments = {
            key: tensors[f"adam.{key}.{name}"]
            for key in ("step", "exp_avg", "exp_avg_sq")
            if f"adam.{key}.{name}" in tensors
        }
        if moments:
            optimiser.state[parameter] = {
                key: value.to(parameter.device if optimiser.defaults.get("fused") else "cpu", copy=True)
                if key == "step"
                else torch.empty_like(parameter).copy_(value)  # laid out as the weights are: fused Adam insists
                for key, value in moments.items()
            }
    return state


def _named_parameters(modules: Mapping[str, nn.Module]) -> list[tuple[str, nn.Parameter]]:
    return [(f"{prefix}.{n}", p) for prefix, module in modules.items() for n, p in module.named_parameters()]


def _checkpoints(run: Path) -> list[Path]:
    return sorted(
        p for p in (run / "checkpoints").glob("step-*") if re.fullmatch(r"step-\d{8}", p.name) and (p / STATE).exists()
    )
