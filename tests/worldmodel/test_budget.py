"""`--minutes`: as many steps as fill the time, found once, by a trial that leaves no trace in the run."""

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from envs.command import run
from envs.errors import UsageError
from worldmodel import budget, train
from worldmodel.budget import Cost, measure_cost
from worldmodel.options import PRESETS, Schedule, TrainOptions
from worldmodel.study.options import StudyOptions


@pytest.mark.parametrize("every", [10, 1000])
def test_the_steps_fill_the_time_but_no_more(every):
    options = replace(PRESETS["tiny"], data=Path("d"), out=Path("o"), validate_every=every, save_every=every)
    cost = Cost(step=0.5, validation=4.0, checkpoint=1.0)
    steps = cost.steps_in(600, options)
    spent = 0.5 * steps + -(-steps // every) * 5.0  # one each at every multiple, and at the end
    assert 600 - 2 * 5.0 - 0.5 <= spent <= 600


def test_too_little_time_is_refused():
    options = replace(PRESETS["tiny"], data=Path("d"), out=Path("o"))
    with pytest.raises(UsageError, match=r"minutes is 0.05, and .* take 0.098; give more"):
        Cost(step=0.9, validation=4.0, checkpoint=1.0).steps_in(3, options)
    with pytest.raises(UsageError, match="minutes is -1"):
        replace(options, minutes=-1)


def test_endless_time_is_refused_for_a_study_too():
    with pytest.raises(UsageError, match="minutes is inf; give a positive number"):
        StudyOptions("table", Path("a"), Path("b"), Path("c"), Path("out"), minutes=math.inf)


@dataclass
class Batches:
    clips: int
    batch: int


class Rehearsal:
    """Stands in for a trainer: a step takes as long as its clip has frames, and twice that with a posterior."""

    def __init__(self, clock, options):
        self.clock, self.options, self.step, self.validation = clock, options, 0, Batches(clips=8, batch=4)
        self.model = torch.nn.Identity()
        self.compiled = set()

    def next_clips(self):
        progress = self.step / self.options.steps
        return self.options.schedule.clip_length(progress) * (2 if progress > 0.25 else 1)

    def update(self, seconds):
        self.clock[0] += seconds + (0 if seconds in self.compiled else 100)
        self.compiled.add(seconds)

    def score(self, writer):
        self.clock[0] += self.validation.clips + (0 if "score" in self.compiled else 100)
        self.compiled.add("score")

    def save(self):
        self.clock[0] += 3


def test_every_part_of_the_curriculum_is_timed_without_compilation(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(budget.time, "perf_counter", lambda: clock[0])
    schedule = Schedule(clip_lengths=((0.5, 4), (1.0, 10)), posterior_from=0.25)
    options = replace(PRESETS["tiny"], data=Path("d"), out=Path("o"), schedule=schedule)
    cost = measure_cost(lambda options: Rehearsal(clock, options), options)
    assert cost == Cost(step=0.25 * 4 + 0.25 * 8 + 0.5 * 20, validation=8, checkpoint=3)


def test_a_timed_run_is_the_run_of_so_many_steps_and_keeps_their_number(tiny_dataset, tmp_path, monkeypatch, capsys):
    def call(out, *arguments):
        line = ["--preset", "tiny", "--data", tiny_dataset, "--out", tmp_path / out, "--batch", 2, *arguments]
        run(TrainOptions, train.main, list(map(str, line)), train._preset)
        return load_file(max((tmp_path / out / "checkpoints").glob("step-*")) / "training.safetensors")

    measured = []

    def measure(make_trainer, options):
        measured.append(measure_cost(make_trainer, options))
        return Cost(step=0.0999, validation=0.0, checkpoint=0.0)

    monkeypatch.setattr(train, "measure_cost", measure)
    timed = call("timed", "--minutes", 0.4 / 60)
    assert measured[0].step > 0 and measured[0].validation > 0 and measured[0].checkpoint > 0
    config = json.loads((tmp_path / "timed" / "config.json").read_text())
    assert config["steps"] == 4 and config["minutes"] == pytest.approx(0.4 / 60)
    assert "4 steps" in capsys.readouterr().out
    counted = call("counted", "--steps", 4)
    assert timed.keys() == counted.keys() and all(torch.equal(timed[name], counted[name]) for name in timed)
    call("timed", "--minutes", 0.4 / 60)
    assert len(measured) == 1  # the same command again asks the clock no more
    with pytest.raises(SystemExit):
        call("timed", "--minutes", 1)
    assert "minutes = 0.00666" in capsys.readouterr().err
