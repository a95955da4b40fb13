"""The search itself: trials on Ray Tune, begun or gone on with."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

from data_collection.ray_cluster import connect
from envs.errors import UsageError
from envs.files import write_json
from worldmodel.clips import ClipSource
from worldmodel.held_out import ValidationSet
from worldmodel.train import HOW_NOT_WHAT, changes, document_of
from worldmodel.training_data import open_data, settled
from worldmodel.tuning import journal
from worldmodel.tuning.options import TuneOptions
from worldmodel.tuning.space import axes_of, point_of

SETTINGS, RAY = "tune.json", "ray"
QUIET = {
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",  # the trainer writes its own
    "TUNE_PRINT_ALL_TRIAL_ERRORS": "0",
    "TUNE_WARN_EXCESSIVE_EXPERIMENT_CHECKPOINT_SYNC_THRESHOLD_S": "0",
    "RAY_AIR_NEW_OUTPUT": "0",
}

Data = tuple[ClipSource, ValidationSet]


def settle(options: TuneOptions) -> Data:
    """Open the data, and write down what is searched, or see that it is what the folder's search was begun with.

    Where a configuration hangs on its number alone, more trials may be asked for than at the beginning, and the folder
    may have been moved or copied.

    Raises:
        UsageError: the data does not do, the folder holds another search, or one that cannot go on in another place.
    """
    training = settled(options.training)
    data = open_data(training)
    document: dict[str, Any] = {
        "out": str(options.out.resolve()),
        "options": options.document(),
        "retries": options.retries,
        "training": document_of(training),
        "shared": options.shared,
        "data": {"train": data[0].dataset.content_hash, "validation": data[1].source.dataset.content_hash},
        "budgets": options.budgets,
        "axes": {axis.name: [axis.low, axis.high] for axis in axes_of(training, options.around)},
    }
    document = json.loads(json.dumps(document))
    path = options.out / SETTINGS
    if not path.exists():
        if options.out.exists() and any(p.name != ".lock" for p in options.out.iterdir()):
            raise UsageError(f"{options.out} holds something else than a search; give another --out")
        write_json(path, document)
        return data
    try:
        before = json.loads(path.read_text())
        repeatable = options.searcher == "random"
        more = options.trials > before["options"]["trials"] and repeatable
        same_ranges = before["axes"] == document["axes"]
        if more and same_ranges:
            before["options"]["trials"] = options.trials
        place = before.get("out", document["out"])
        other_retries = before.get("retries", options.retries) != options.retries
        what = {name: value for name, value in document["training"].items() if name not in HOW_NOT_WHAT}
        groups = {"options": document["options"], "training": what, "data": document["data"]}
        found = next(filter(None, (changes(before[name], now) for name, now in groups.items())), [])
        if other_retries and not repeatable:
            found.append(f"retries = {before['retries']}, not {options.retries}")
        if not found and not same_ranges:  # those of an older version: configurations would be drawn anew
            found.append(f"ranges {before['axes']}, not {document['axes']}")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(f"{path} is damaged ({error}); restore it, or give another --out") from error
    if found:
        raise UsageError(
            f"{options.out} holds a search with {'; '.join(found)}; give the same options to go on with it, or another "
            "--out"
        )
    moved = place != document["out"]
    if moved and not repeatable and (options.out / RAY).exists():
        raise UsageError(
            f"{options.out} holds a search that was begun in {place}, where {options.searcher} would go on writing; "
            "put the folder back there, or give another --out"
        )
    if more or other_retries or moved:
        if (options.out / RAY).exists():  # it keeps to the old numbers and place; trials go on from their own folders
            shutil.rmtree(options.out / RAY)
        write_json(path, document)
    return data


def unfinished(options: TuneOptions, retried: bool = False) -> bool:
    """Whether there are trials that have not come to their ends.

    Args:
        retried: count those that died too often among them.
    """
    done = journal.ENDED if retried else (*journal.ENDED, "failed")
    ended = [trial for trial in journal.trials(options.out / journal.JOURNAL) if trial.status in done]
    return len(ended) < options.trials


def search(options: TuneOptions, data: Data) -> None:
    """Run the trials that have not ended; Ctrl-C leaves a search that goes on from there.

    Raises:
        UsageError: no such cluster, it has too little for a trial, or memory ran low there.
    """
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    workers = options.workers or max(len(os.sched_getaffinity(0)) // options.cpus_per_trial, 1)
    with connect(None if options.ray == "local" else options.ray, workers * options.cpus_per_trial):
        _check_room(options)
        tuner = _tuner(options, data)
        del data  # Ray holds it now, for all processes
        try:
            tuner.fit()
        except RuntimeError as error:
            if "running low on memory" not in str(error):
                raise
            raise UsageError(
                "Ray has killed a trial on a machine whose memory ran low, and ended the search; the same command goes "
                "on with it, with fewer --workers if it happens again. ray start leaves that to the kernel, and the "
                "search goes on by itself, where RAY_memory_monitor_refresh_ms=0 is set"
            ) from error


def _tuner(options: TuneOptions, data: Data) -> Any:
    from ray import tune  # slow to import, and not needed to refuse options

    from worldmodel.tuning.halving import Halving
    from worldmodel.tuning.searchers import make_searcher, ray_space
    from worldmodel.tuning.trial import run_trial
    from worldmodel.tuning.watcher import Watcher

    training = settled(options.training)
    axes = axes_of(training, options.around)
    validation = data[1]
    if validation.source.dataset.has_ground_truth:  # read what its scores need now, once, not in every trial
        validation.source.truth_at(validation.source.spread(1, validation.frames), validation.frames)
    trainable = tune.with_resources(
        tune.with_parameters(run_trial, training=training, data=data, threads=options.cpus_per_trial),
        {"cpu": options.cpus_per_trial, "gpu": options.gpus_per_trial},
    )
    folder = options.out.resolve() / RAY
    if _can_go_on(folder):
        return tune.Tuner.restore(str(folder), trainable, resume_unfinished=True, resume_errored=True)
    shutil.rmtree(folder, ignore_errors=True)
    results = options.out.resolve() / journal.JOURNAL
    return tune.Tuner(
        trainable,
        param_space=ray_space(axes),
        tune_config=tune.TuneConfig(
            metric="score",
            mode="max",
            num_samples=options.trials,
            search_alg=make_searcher(options.searcher, axes, point_of(training, axes), options.budgets, options.seed),
            scheduler=Halving(results, options.budgets, options.reduction, options.unpruned),
            max_concurrent_trials=options.workers if options.ray not in (None, "local") else None,
            reuse_actors=True,
            trial_dirname_creator=_trial_name,
        ),
        run_config=tune.RunConfig(
            name=RAY,
            storage_path=str(folder.parent),
            failure_config=tune.FailureConfig(max_failures=options.retries),
            callbacks=[Watcher(results, options.trials, options.budgets[-1])],
            verbose=0,
        ),
    )


def _trial_name(trial: Any) -> str:
    return f"trial-{trial.config['number']:03d}"


def _can_go_on(folder: Path) -> bool:
    """Whether Ray's state is there and whole; where a kill tore it, trials still have their own checkpoints."""
    states = sorted(folder.glob("experiment_state-*.json"))
    if not states or not (folder / "tuner.pkl").exists():
        return False
    try:
        return bool(json.loads(states[-1].read_text())["trial_data"])
    except (ValueError, KeyError):
        return False


def _check_room(options: TuneOptions) -> None:
    import ray

    has = ray.cluster_resources()
    for name, needed in (("CPU", options.cpus_per_trial), ("GPU", options.gpus_per_trial)):
        if has.get(name, 0) < needed:
            raise UsageError(
                f"a trial needs {needed:g} {name}, and the cluster has {has.get(name, 0):g}; give fewer "
                f"--{name.lower()}s-per-trial, or a larger cluster"
            )
