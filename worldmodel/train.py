"""Command `train-worldmodel`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from envs import command as command_line
from envs.errors import UsageError
from envs.files import locked, write_json
from worldmodel.budget import Cost, measure_cost
from worldmodel.clips import ClipSource
from worldmodel.config_file import changed, read_config
from worldmodel.devices import describe, find_device, find_precision, prepare_devices
from worldmodel.held_out import ValidationSet
from worldmodel.memory import keep_freed_memory
from worldmodel.models import make_model, named_config
from worldmodel.options import PRESETS, TrainOptions, preset_for
from worldmodel.ranks import Ranks, join_ranks
from worldmodel.trainer import Trainer
from worldmodel.training_data import model_context, open_data, settled
from worldmodel.warm_start import WarmStart

HOW_NOT_WHAT = ("device", "deterministic", "cuda_graphs", "memory_limit", "save_every", "log_every")
"""Options that a run may go on with others of."""


def main(options: TrainOptions) -> None:
    """Train, with all processes that torchrun started."""
    keep_freed_memory()
    prepare_devices(options.deterministic)
    with join_ranks(options.device) as ranks:
        train_with(ranks, options)


def train_with(ranks: Ranks, options: TrainOptions) -> None:
    """Train as one of several processes, which all call this."""
    ranks.share(options.batch)  # refuse an odd one before the data is read
    options = settled(options)
    train, validation = open_data(options)

    def prepare(options: TrainOptions) -> Trainer:
        return make_trainer(options, train, validation, ranks)

    with ExitStack() as stack:
        ranks.decide(lambda: stack.enter_context(_alone_in(options.out)))
        found = ranks.decide(lambda: existing_run(options))
        if found is None:
            cost = None if options.minutes is None else measure_cost(prepare, options)  # all train, all measure
            options = ranks.decide(lambda: _filling(_precise(options), cost))
        trainer = prepare(found or options)
        if found is None:  # only what can be trained takes the folder
            ranks.decide(lambda: claim(options))
        trainer.run()


def _alone_in(folder: Path) -> AbstractContextManager[int]:
    """The lock of a run's folder, which is made if need be."""
    folder.mkdir(parents=True, exist_ok=True)
    return locked(folder)


def make_trainer(options: TrainOptions, train: ClipSource, validation: ValidationSet, ranks: Ranks) -> Trainer:
    """A trainer with a new model; its weights come from the seed, or from the model to start from."""
    kind, architecture = named_config(options.model, options.architecture)
    start = None if options.start_from is None else WarmStart.load(options.start_from)
    context = model_context(train, options)
    torch.manual_seed(options.seed)
    model = make_model(kind, architecture, context if start is None else start.context(context))
    model = model.to(ranks.device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    origin: dict[str, Any] = {
        "options": document_of(options),
        "data": {"train": train.dataset.content_hash, "validation": validation.source.dataset.content_hash},
        "versions": {"torch": torch.__version__},
        "machine": describe(ranks.device),
    }
    if start is None:
        return Trainer(model, options, train, validation, origin, ranks)
    origin["start"] = start.note(origin["data"])
    trainer = Trainer(model, options, train, validation, origin, ranks)
    start.give_weights(trainer.model, trainer.inference)
    return trainer


def _filling(options: TrainOptions, cost: Cost | None) -> TrainOptions:
    """The options with the number of steps that fill the given minutes, if minutes are given."""
    if options.minutes is None or cost is None:
        return options
    options = replace(options, steps=cost.steps_in(60 * options.minutes, options))
    print(
        f"{options.minutes:g} minutes are {options.steps} steps here: {cost.step:.3f} s a step over the run, "
        f"{cost.validation:.1f} s a validation, {cost.checkpoint:.1f} s a checkpoint",
        flush=True,
    )
    return options


def parse_options(arguments: Sequence[str]) -> TrainOptions:
    """The options that `train-worldmodel` makes of these arguments.

    Raises:
        UsageError: they do not parse, or cannot be.
    """
    return command_line.parse(TrainOptions, arguments, _preset)


def existing_run(options: TrainOptions) -> TrainOptions | None:
    """The options of the run that `options.out` holds; None where there is none yet.

    Raises:
        UsageError: it is a run with other options, or damaged.
    """
    path = options.out / "config.json"
    if not path.exists():
        return None
    try:
        before = {"action_column": "action", **json.loads(path.read_text())}  # older runs do not say
        if options.minutes is not None:  # then the number of steps is the run's own
            options = replace(options, steps=int(before["steps"]))
        if options.precision == "auto":
            options = replace(options, precision=before["precision"])
    except (ValueError, TypeError, KeyError) as error:
        raise UsageError(f"{path} is damaged ({error}); restore it, or give another --out") from error
    now = {name: value for name, value in document_of(options).items() if name not in HOW_NOT_WHAT}
    if found := changes(before, now):
        raise UsageError(
            f"{options.out} holds a run with {'; '.join(found)}; give the same options to go on with it, or another "
            "--out"
        )
    return options


def changes(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """The options `now` that were others `before`, each with both values."""
    return [
        change
        for name, value in now.items()
        if not _same(name, before.get(name), value)
        for change in _differences(name, before.get(name), value)
    ]


def _differences(name: str, before: Any, now: Any) -> list[str]:
    """An option's two values; of a group of options, those of all that differ."""
    if isinstance(before, dict) and isinstance(now, dict):
        keys = [key for key in {**now, **before} if before.get(key) != now.get(key)]
        return [change for key in keys for change in _differences(f"{name}.{key}", before.get(key), now.get(key))]
    return [f"{name} = {before}, not {now}"]


def _same(name: str, before: Any, now: Any) -> bool:
    """Whether an option has the same value; a folder may go by several names."""
    if name in ("data", "validation", "start_from") and before is not None and now is not None:
        return Path(before).resolve() == Path(now).resolve()
    return bool(before == now)


def claim(options: TrainOptions) -> TrainOptions:
    """Write the options beside the run; returns them, with the precision that this machine makes of `auto`."""
    options = _precise(options)
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(options.out / "config.json", document_of(options))
    return options


def _precise(options: TrainOptions) -> TrainOptions:
    """The options with the precision that this machine makes of `auto`."""
    return replace(options, precision=find_precision(options.precision, find_device(options.device)))


def document_of(options: TrainOptions) -> dict[str, Any]:
    """The options as JSON has them, without those that say where they came from and where the run is."""
    _, architecture = named_config(options.model, options.architecture)
    document: dict[str, Any] = json.loads(json.dumps(asdict(replace(options, architecture=architecture)), default=str))
    return {name: value for name, value in document.items() if name not in ("out", "config")}


def _preset(arguments: Sequence[str]) -> TrainOptions:
    """The options that hold where the command line is silent: those of its preset for its model, changed by the model
    that it starts from, and by its --config."""
    path = command_line.given(arguments, "--config")
    values = {} if path is None else read_config(Path(path))
    if command_line.given(arguments, "--steps") is not None:  # they take the file's time's place
        if command_line.given(arguments, "--minutes") not in (None, "None"):
            raise UsageError("--steps and --minutes are both given; give one of them")
        values.pop("minutes", None)
    name = command_line.given(arguments, "--preset") or values.pop("preset", "cpu")
    if not isinstance(name, str) or name not in PRESETS:
        raise UsageError(f"no preset '{name}'; there are {', '.join(PRESETS)}")
    given = command_line.given(arguments, "--start-from") or values.get("start_from")
    start = None if given in (None, "None") else WarmStart.load(str(given))
    usual = "t3vip" if start is None else start.model_name
    options = preset_for(name, str(command_line.given(arguments, "--model") or values.get("model", usual)))
    options = options if start is None else start.options(options)
    return options if path is None else changed(options, values | {"preset": name}, path)


def command() -> None:
    """Entry point of `train-worldmodel`."""
    command_line.run(TrainOptions, main, default=_preset)


if __name__ == "__main__":  # torchrun -m worldmodel.train
    command()
