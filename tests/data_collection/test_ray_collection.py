"""Collecting on Ray: the same bytes wherever an episode is made, and a process or a machine that dies costs one."""

import os
import signal
import threading
import time
from pathlib import Path
from unittest import mock

import pytest
import ray
from commands import HERE, assert_one_line_error, call, finish, options, start
from standin import reset_seed

from data_collection.collect import Config
from data_collection.process_workers import ProcessPool
from data_collection.ray_cluster import QUIET, connect
from data_collection.ray_workers import Collector, RayPool
from data_collection.repair import find_damage
from data_collection.workers import Collected, WorkerLost, collect_episodes
from envs.command import end_on_sigterm
from envs.files import locked
from tests.ray_nodes import started_nodes

ROOT = HERE.parent.parent
STEP_S = 0.1
"""So that an episode takes a while, and a machine can die in the middle of one."""


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Two nodes with a CPU each, the second of which is to be killed; episode 2 of seed 0 kills its process, once."""
    fault = {
        "STANDIN_FAULT": "kill",
        "STANDIN_EPISODE": reset_seed(0, 2),
        "STANDIN_MARK": tmp_path_factory.mktemp("fault") / "mark",
        "STANDIN_SLEEP": STEP_S,
        "PYTHONPATH": f"{HERE}{os.pathsep}{ROOT}",
    }
    with mock.patch.dict(os.environ, {**QUIET, **{name: str(value) for name, value in fault.items()}}):
        nodes = started_nodes()
    yield nodes
    nodes.shutdown()


def shards(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.h5"))}


def test_the_command_makes_the_same_files_and_survives_a_process_that_dies(cluster, collected, tmp_path):
    given = options(tmp_path / "data", workers=5, ray=cluster.address, **{"ground-truth": True})
    code, out, err = call("collect-rollouts", given)
    assert code == 0 and "4 episodes in" in out, err
    assert shards(tmp_path / "data") == shards(collected)
    assert "the Ray cluster has 2 CPUs: so many workers, not 4" in err
    lost = [line for line in err.replace("\r", "\n").splitlines() if " lost episode " in line]
    assert len(lost) == 1 and "lost episode 2: its process died" in lost[0] and "pid " in lost[0], err
    times = {path: path.stat().st_mtime_ns for path in (tmp_path / "data").glob("*.h5")}
    (tmp_path / "data" / "shard-00001.h5").unlink()
    assert call("collect-rollouts", given)[0] == 0
    assert shards(tmp_path / "data") == shards(collected)
    assert sum(path.stat().st_mtime_ns != time for path, time in times.items()) == 1


class Watched(RayPool):
    """Remembers whom it hired, and takes a machine from the cluster once the worker on it has begun an episode."""

    def __init__(self, cluster, doomed, *arguments):
        super().__init__(*arguments)
        self.cluster, self.doomed, self.hired = cluster, doomed, []

    def hire(self, name, episode):
        self.hired.append(super().hire(name, episode))
        return self.hired[-1]

    def wait(self, crew):
        if self.doomed in self.cluster.worker_nodes:
            begun = [worker for worker in self.hired if worker.place and len(worker._asked) == 1]
            if any(worker.place.endswith(self.doomed.node_id[:8]) for worker in begun):
                self.cluster.remove_node(self.doomed, allow_graceful=False)
        return super().wait(crew)


def test_a_machine_that_dies_costs_the_episode_in_flight(cluster, tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    for folder in (here, there):
        folder.mkdir()
    manifest = config(here, seed=1, episodes=5).manifest()
    assert all(isinstance(e, Collected) for e in collect_episodes(ProcessPool(manifest, here, 300), here, range(5), 1))
    (doomed,) = cluster.worker_nodes
    with connect(cluster.address, None):
        pool = Watched(cluster, doomed, manifest, there, 300)
        events = list(collect_episodes(pool, there, range(5), 2))
        nodes = {worker.place.split("node ")[-1] for worker in pool.hired[:2]}
        assert nodes == {node.node_id[:8] for node in (cluster.head_node, doomed)}  # one on each
    assert doomed not in cluster.worker_nodes
    lost = [event for event in events if isinstance(event, WorkerLost)]
    assert len(lost) == 1 and doomed.node_id[:8] in lost[0].worker, lost
    assert lost[0].reason == "its machine cannot be reached any more"
    assert sorted(event.episode for event in events if isinstance(event, Collected)) == [0, 1, 2, 3, 4]
    assert shards(there) == shards(here) and len(shards(there)) == 5 and not find_damage(there)


def test_a_cluster_of_its_own_ends_with_the_command(tmp_path):
    given = options(tmp_path, episodes=50, ray="local")
    process = start("collect-rollouts", given, STANDIN_SLEEP=0.02, PYTHONPATH=f"{HERE}{os.pathsep}{ROOT}")
    while not shards(tmp_path):
        assert process.poll() is None, finish(process)
    process.send_signal(signal.SIGTERM)
    code, _, err = finish(process)
    assert code == 143 and "terminated; run the same command again" in err and "Traceback" not in err, err
    assert find_damage(tmp_path) == [] and not list(tmp_path.glob("*.tmp"))
    with locked(tmp_path):
        pass


def test_a_signal_keeps_its_exit_code_where_it_comes_while_ray_waits(cluster):
    before = signal.getsignal(signal.SIGTERM)
    end_on_sigterm("that was all")
    ended = signal.getsignal(signal.SIGTERM)
    try:
        with pytest.raises(SystemExit) as stop, connect(cluster.address, None):
            never = ray.remote(lambda: time.sleep(600)).remote()
            threading.Timer(1, os.kill, (os.getpid(), signal.SIGTERM)).start()
            ray.wait([never], timeout=60)
        assert stop.value.code == 143 and signal.getsignal(signal.SIGTERM) is ended
    finally:
        signal.signal(signal.SIGTERM, before)


def test_what_goes_wrong_in_an_actor_is_said(tmp_path, monkeypatch):
    monkeypatch.setenv("STANDIN_FAULT", "raise")
    monkeypatch.setenv("STANDIN_EPISODE", str(reset_seed(0, 1)))
    collector = Collector(config(tmp_path).manifest())
    assert collector.collect(None).kind == "ready" and collector.collect(0).kind == "collected"
    answer = collector.collect(1)
    assert answer.kind == "failed" and answer.detail == "RuntimeError: the square fell off the plane"
    assert "misbehave()" in answer.trace
    blind = Collector(config(tmp_path, env="standin:standin/Blind-v0").manifest()).collect(None)
    assert blind.kind == "usage" and "has no attribute 'camera'" in blind.detail


def test_no_cluster_there(tmp_path):
    assert_one_line_error(call("collect-rollouts", options(tmp_path, ray="here")), "ray is 'here'", "HOST:PORT")


def config(out: Path, **changed) -> Config:
    return Config(
        out,
        **{
            "env": "standin:standin/Square-v0",
            "steps": 8,
            "policy": "noise",
            "image_size": 16,
            "episodes": 4,
            **changed,
        },
    )
