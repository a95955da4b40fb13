"""`tune-worldmodel` on a Ray cluster of this machine: processes are killed, and the same command goes on."""

import json
import os
import signal
import subprocess
import sys
import time

import psutil
import pytest
import ray

from envs.command import run
from worldmodel import train, tune
from worldmodel.options import TrainOptions
from worldmodel.tuning import journal
from worldmodel.tuning.options import TuneOptions

TRIALS, STEPS = 3, 12
LINE = ["--preset", "tiny", "--steps", STEPS, "--rungs", 1, "--unpruned", 2, "--around", 3, "--workers", 1]


@pytest.fixture
def start(tiny_dataset, tmp_path):
    """Starts the command in a process of its own."""
    begun = []

    def begin(*further, trials=TRIALS, **variables):
        line = [sys.executable, "-m", "worldmodel.tune", "--data", tiny_dataset, "--out", tmp_path / "tuned"]
        line += [*LINE, "--trials", trials, *further]
        with (tmp_path / "log.txt").open("ab") as log:
            environment = os.environ | {"TORCHDYNAMO_DISABLE": "1"} | variables
            begun.append(subprocess.Popen(list(map(str, line)), stdout=log, stderr=log, env=environment))
        return begun[-1]

    yield begin
    for process in begun:
        process.kill()
        process.wait()


def wait_for(process, found):
    while not (value := found()):
        assert process.poll() is None, "it ended before"
        time.sleep(0.05)
    return value


@pytest.mark.timeout(900)
def test_a_worker_and_then_the_search_are_killed_and_the_same_command_goes_on(start, tiny_dataset, tmp_path):
    out = tmp_path / "tuned"
    results = out / journal.JOURNAL

    def lines(kind):
        return [line for line in journal.read(results) if line["kind"] == kind]

    process = start()
    first = wait_for(process, lambda: lines("score"))[0]
    assert first["trial"] == 0 and first["step"] == STEPS // 3
    os.kill(first["pid"], signal.SIGKILL)
    assert wait_for(process, lambda: lines("death"))[0]["trial"] == 0
    dead = first["pid"]
    wait_for(process, lambda: [line for line in lines("score") if line["pid"] != dead])
    everyone = [p for p in psutil.Process(process.pid).children(recursive=True) if not p.name().endswith("Agent")]
    process.kill()
    process.wait()
    assert not psutil.wait_procs(everyone, timeout=60)[1]  # Ray's processes go with it, its agents by and by

    process = start()
    assert process.wait() == 0, (tmp_path / "log.txt").read_text()[-3000:]
    trials = journal.trials(results)
    assert [trial.number for trial in trials] == list(range(TRIALS))
    assert {trial.status for trial in trials} <= {"finished", "stopped"}
    for trial in trials[:2]:  # the unpruned ones
        assert trial.status == "finished" and set(trial.scores) == {4, 8, 12}
        assert all(parts["flow_error_moving"] > 0 for parts in trial.parts.values()) and len(trial.parts) == 3
    assert trials[0].deaths == 1
    for name, (low, high) in json.loads((out / "tune.json").read_text())["axes"].items():
        own = trials[0].point[name]
        assert (low, high) == pytest.approx((own / 3, own * 3)) and own not in [t.point[name] for t in trials[1:]]
        assert all(low <= trial.point[name] <= high for trial in trials)

    again = [line for line in lines("score") if line["trial"] == 0 and line["pid"] != dead]
    assert min(line["step"] for line in again if "seconds" in line) > STEPS // 3  # the first one was only told again

    report = json.loads((out / "report.json").read_text())
    best = max((trial for trial in trials if trial.status == "finished"), key=lambda trial: trial.score)
    assert report["best"] == best.number and (out / "trials.png").exists()
    line = [
        "--config",
        out / "best.json",
        "--data",
        tiny_dataset,
        "--out",
        tmp_path / "run",
        "--steps",
        1,
        "--batch",
        1,
    ]
    run(TrainOptions, train.main, list(map(str, line)), train._preset)
    trained = json.loads((tmp_path / "run/config.json").read_text())
    assert trained["preset"] == "tiny" and trained["learning_rate"] == best.point["learning_rate"]
    assert trained["losses"]["knn"] == best.point["knn"] and trained["losses"]["power"] == best.point["power"]

    before = results.read_bytes()
    line = ["--data", tiny_dataset, "--out", out, *LINE, "--trials", TRIALS]
    run(TuneOptions, tune.main, list(map(str, line)))  # there is nothing left to do, and no Ray to be started
    assert results.read_bytes() == before and not ray.is_initialized()

    saved = {path: path.stat().st_mtime_ns for path in out.glob("trials/*/checkpoints/*/*.safetensors")}
    process = start(trials=TRIALS + 1)
    assert process.wait() == 0, (tmp_path / "log.txt").read_text()[-3000:]
    *first, new = journal.trials(results)
    assert first == trials and new.number == TRIALS and new.status in ("finished", "stopped")
    assert len({trial.point["rgb"] for trial in (*first, new)}) == TRIALS + 1
    assert saved and {path: path.stat().st_mtime_ns for path in saved} == saved  # none of theirs was trained again
    assert f"of {TRIALS + 1} trials begun" in (out / "report.md").read_text()


@pytest.mark.timeout(900)
def test_a_trial_that_died_too_often_has_failed_and_the_same_command_tries_it_anew(start, tmp_path):
    """Where memory is low, too: Ray, which would kill trials then, lets them alone."""
    out, scarce = tmp_path / "tuned", {"RAY_memory_usage_threshold": "0.01"}  # of all memory, from where on it would

    def end_of(process):
        assert process.wait() == 0, (tmp_path / "log.txt").read_text()[-3000:]
        trials = json.loads((out / "report.json").read_text())["trials"]
        return [trial["status"] for trial in trials], trials[0]

    process = start("--retries", 0, trials=2, **scarce)
    lines = wait_for(process, lambda: [line for line in journal.read(out / journal.JOURNAL) if line["kind"] == "score"])
    os.kill(lines[0]["pid"], signal.SIGKILL)
    statuses, failed = end_of(process)
    assert statuses == ["failed", "finished"]
    assert failed["step"] < STEPS and failed["reason"] and failed["deaths"] == 0
    assert "2 of 2 trials begun (random): 1 finished, 1 failed\n" in (out / "report.md").read_text()
    assert "| 0* | failed |" in (out / "report.md").read_text()

    statuses, finished = end_of(start("--retries", 0, trials=2, **scarce))
    assert statuses == ["finished", "finished"] and finished["step"] == STEPS and not finished["reason"]
    assert finished["scores"][str(STEPS // 3)] == failed["scores"][str(STEPS // 3)]  # it went on at its checkpoint
