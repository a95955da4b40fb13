"""One trial, without Ray: what it reports, where it goes on, and that numbers that are none do not end a search."""

import contextlib
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from worldmodel import trainer as training
from worldmodel.training_data import open_data
from worldmodel.tuning import trial as trials
from worldmodel.tuning.options import TuneOptions
from worldmodel.tuning.space import axes_of, point_of

STEPS = 6


@pytest.fixture
def begin(tiny_dataset, tmp_path, monkeypatch):
    """Runs trial 0 of a search with a rung after 3 steps; gives what it reported until it ended or was killed."""
    options = TuneOptions(tiny_dataset, tmp_path, preset="tiny", steps=STEPS, reduction=2, rungs=1)
    training_options = options.training
    data = open_data(training_options)
    for column in data[0]._columns.values():
        column.flags.writeable = False  # as Ray's shared memory is
    threads = torch.get_num_threads()

    def call(kill_at=math.inf, deterministic=False, **changes):
        told = []

        def report(result):
            told.append(result)
            if result["step"] >= kill_at:
                raise SystemExit

        monkeypatch.setattr(trials.tune, "report", report)
        point = point_of(training_options, axes_of(training_options)) | changes
        with contextlib.suppress(SystemExit):
            shared = replace(training_options, deterministic=deterministic)
            trials.run_trial({**point, "number": 0}, shared, data, threads)
        return told

    call.out = Path(training_options.out) / "000"
    return call


def steps_of(told):
    return [result["step"] for result in told]


def trained(out):
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    return [line["step"] for line in lines if line["kind"] == "train"]


def test_a_trial_that_is_killed_goes_on_and_tells_everything_again(begin):
    killed = begin(kill_at=3)
    assert steps_of(killed) == [3] and not killed[0]["diverged"]
    assert killed[0]["score"] == pytest.approx(killed[0]["psnr"] + killed[0]["depth_psnr"])
    assert killed[0]["flow_error_moving"] > 0
    assert (begin.out / "checkpoints" / "step-00000003").exists()  # before the score was told
    told = begin()
    assert steps_of(told) == [3, STEPS] and told[0]["score"] == killed[0]["score"]
    assert "seconds" not in told[0] and told[1]["seconds"] > killed[0]["seconds"] > 0
    assert trained(begin.out) == list(range(1, STEPS + 1))  # no step twice
    again = begin()
    assert [(r["step"], r["score"]) for r in again] == [(r["step"], r["score"]) for r in told]
    assert trained(begin.out) == list(range(1, STEPS + 1))


def test_another_configuration_in_the_folder_is_begun_anew(begin):
    begin(kill_at=3)
    other = begin(rgb=0.1)
    assert steps_of(other) == [3, STEPS] and trained(begin.out) == list(range(1, STEPS + 1))
    assert json.loads((begin.out / "config.json").read_text())["losses"]["rgb"] == 0.1


def test_a_trial_is_deterministic_where_that_is_asked_for(begin):
    begin(kill_at=3)
    assert not torch.are_deterministic_algorithms_enabled() and torch.backends.cudnn.benchmark
    try:
        begin(kill_at=3, deterministic=True)
        assert torch.are_deterministic_algorithms_enabled() and not torch.backends.cudnn.benchmark
    finally:
        torch.use_deterministic_algorithms(False)
        torch.backends.cudnn.deterministic = False


def test_a_loss_that_is_no_number_makes_a_bad_trial(begin, monkeypatch):
    objective = training.objective

    def spoiled(*arguments):
        total, terms = objective(*arguments)
        return total * math.nan, {name: value * math.nan for name, value in terms.items()}

    monkeypatch.setattr(training, "MAX_BAD_STEPS", 2)
    monkeypatch.setattr(training, "objective", spoiled)
    (told,) = begin()
    assert told["diverged"] and told["score"] == trials.WORST_DB and "not finite" in told["reason"]


def test_so_does_a_score_that_is_none(begin, monkeypatch):
    validate = training.validate
    monkeypatch.setattr(training, "validate", lambda *arguments: validate(*arguments) | {"score": math.nan})
    (told,) = begin()
    assert told["diverged"] and told["step"] == 3 and "score" in told["reason"]
    monkeypatch.setattr(training, "validate", validate)
    assert steps_of(begin()) == [3, STEPS]  # taken up again, by a process that finds what the first one wrote
