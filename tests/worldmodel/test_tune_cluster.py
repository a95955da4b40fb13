"""`tune-worldmodel --ray`: trials on two machines, one of which dies; its trial goes on at the other."""

import os
import subprocess
import sys
import time
from unittest import mock

import psutil
import pytest

from data_collection.ray_cluster import QUIET
from tests.ray_nodes import started_nodes
from worldmodel.tuning import journal

TRIALS, STEPS = 2, 60
LINE = ["--preset", "tiny", "--trials", TRIALS, "--steps", STEPS, "--unpruned", TRIALS]


@pytest.fixture
def cluster():
    """Two nodes with a CPU each."""
    with mock.patch.dict(os.environ, QUIET | {"TORCHDYNAMO_DISABLE": "1"}):
        nodes = started_nodes()
        yield nodes
        nodes.shutdown()


@pytest.fixture
def search(cluster, tiny_dataset, tmp_path):
    """The command, in a process of its own, with the cluster."""
    line = [sys.executable, "-m", "worldmodel.tune", "--data", tiny_dataset, "--out", tmp_path / "tuned", *LINE]
    with (tmp_path / "log.txt").open("wb") as log:
        process = subprocess.Popen([str(w) for w in (*line, "--ray", cluster.address)], stdout=log, stderr=log)
    yield process
    process.kill()
    process.wait()


def runs_on(node, pid):
    """Whether a process is a worker of a node."""
    try:
        return node.all_processes["raylet"][0].process.pid in {parent.pid for parent in psutil.Process(pid).parents()}
    except psutil.NoSuchProcess:
        return False


def test_a_machine_dies_and_its_trial_goes_on_at_another(cluster, search, tmp_path):
    results = tmp_path / "tuned" / journal.JOURNAL
    head, (doomed,) = cluster.head_node, cluster.worker_nodes

    def scores():
        return [line for line in journal.read(results) if line["kind"] == "score"]

    def last_on(node):
        return next((line for line in reversed(scores()) if runs_on(node, line["pid"])), None)

    while not (last_on(head) and (lost := last_on(doomed)) and lost["step"] <= STEPS - 20):
        assert search.poll() is None, "it ended before both had a trial"
        time.sleep(0.1)
    cluster.remove_node(doomed, allow_graceful=False)
    assert search.wait() == 0, (tmp_path / "log.txt").read_text()[-3000:]

    trials = journal.trials(results)
    assert [trial.status for trial in trials] == ["finished"] * TRIALS and {trial.step for trial in trials} == {STEPS}
    assert [trial.deaths for trial in trials] == [int(trial.number == lost["trial"]) for trial in trials]
    again = [line for line in scores() if line["trial"] == lost["trial"] and line["pid"] != lost["pid"]]
    trained = [line["step"] for line in again if "seconds" in line]  # the others are told again
    assert lost["step"] < trained[0] and trained[-1] == STEPS
