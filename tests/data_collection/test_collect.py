"""The collector: same episodes whoever collects them, resuming, workers that fail, bad input."""

import json
import os
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from commands import assert_one_line_error, call, finish, options, start
from standin import FAR, NEAR, StandIn, reset_seed

from data_collection.collect import Config, main
from data_collection.dataset import RGBDDataset
from data_collection.environments import versions
from data_collection.episodes import EpisodeMaker
from data_collection.manifest import Manifest
from data_collection.policies.random import RandomPolicy
from data_collection.repair import find_damage
from data_collection.rollout import collect_episode
from data_collection.workers import Worker
from envs.errors import UsageError
from envs.files import locked


def test_episodes_are_as_the_environment_gave_them(collected):
    dataset = RGBDDataset(collected)
    assert dataset.episodes == 4 and dataset.has_ground_truth
    assert (dataset.episode_lengths == 9).all()
    assert dataset.attrs["action_aggregation"] == list(StandIn.ACTION_AGGREGATION)
    assert dataset.attrs["workspace"] == [[-1, -1, 0], [1, 1, 0.1]]
    assert dataset.attrs["action_bounds"] == [[-1, -1, -1], [1, 1, 1]]
    episode = dataset.episode(1)
    assert (episode["action"][-1] == 0).all() and episode["reward"][-1] == 0
    env = StandIn()
    obs, _ = env.reset(seed=reset_seed(0, 1))
    for t in range(9):
        np.testing.assert_array_equal(episode["rgb"][t], obs["rgb"])
        np.testing.assert_array_equal(episode["state"][t], env.get_state())
        np.testing.assert_array_equal(episode["segmentation"][t], env.segmentation())
        depth = dataset.depth_metres(episode["depth"][t])
        np.testing.assert_allclose(depth, obs["depth"], atol=(FAR - NEAR) / 65535)
        obs, reward, *_ = env.step(episode["action"][t])
        if t < 8:
            assert episode["reward"][t] == np.float32(reward)


def test_same_episodes_with_two_workers(collected, tmp_path):
    code, _, err = call("collect-rollouts", options(tmp_path, workers=2, **{"ground-truth": True}))
    assert code == 0, err
    assert RGBDDataset(tmp_path).content_hash == RGBDDataset(collected).content_hash


def test_episodes_and_runs_differ(collected):
    dataset = RGBDDataset(collected)
    actions = [dataset.episode(number)["action"] for number in range(4)]
    env = StandIn()
    actions.append(collect_episode(env, RandomPolicy(), 8, seed=0, episode=0)[0]["action"])
    actions.append(collect_episode(env, RandomPolicy(), 8, seed=1, episode=0)[0]["action"])
    for i in range(len(actions)):
        for j in range(i):
            assert not np.array_equal(actions[i], actions[j])


def test_same_command_goes_on_and_a_larger_number_extends(tmp_path):
    main(Config(**arguments(tmp_path, episodes=2)))
    times = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.h5")}
    (tmp_path / "shard-00000.h5").unlink()
    (tmp_path / "shard-00007.h5.123.tmp").write_bytes(b"half a shard")
    main(Config(**arguments(tmp_path, episodes=3)))
    assert RGBDDataset(tmp_path).episode_indices.tolist() == [0, 1, 2]
    assert (tmp_path / "shard-00001.h5").stat().st_mtime_ns == times[tmp_path / "shard-00001.h5"]
    assert not list(tmp_path.glob("*.tmp")) and find_damage(tmp_path) == []
    assert json.loads((tmp_path / "dataset.json").read_text())["episodes"] == 3
    for field, value in (("seed", 9), ("steps", 4), ("policy", "random"), ("image_size", 8), ("ground_truth", True)):
        shown = "env_kwargs" if field == "image_size" else field
        with pytest.raises(UsageError, match=rf"was collected with {shown} = .*{value}.*choose another --out"):
            main(Config(**{**arguments(tmp_path, episodes=3), field: value}))


def test_the_episodes_that_are_there_are_counted(tmp_path):
    assert "2 episodes in" in call("collect-rollouts", options(tmp_path, episodes=2))[1]
    assert "2 episodes in" in call("collect-rollouts", options(tmp_path, episodes=1))[1]


def arguments(out, **changed):
    return {
        "out": out,
        "env": "standin:standin/Square-v0",
        "episodes": 4,
        "steps": 8,
        "policy": "noise",
        "workers": 1,
        "image_size": 16,
        **changed,
    }


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("kill", "killed by SIGKILL"),
        ("hang", "hung: the episode was not done in 8 s"),
        ("raise", "fell off the plane"),
    ],
)
def test_failing_worker_is_named_and_replaced_and_costs_one_episode(collected, tmp_path, fault, said):
    faulty = {"STANDIN_FAULT": fault, "STANDIN_EPISODE": reset_seed(0, 2), "STANDIN_MARK": tmp_path / "mark"}
    given = options(tmp_path / "data", workers=2, **{"ground-truth": True, "episode-timeout": 8})
    code, _, err = call("collect-rollouts", given, **faulty)
    assert code == 0, err
    lost = [line for line in err.replace("\r", "\n").splitlines() if " lost episode " in line]
    assert len(lost) == 1 and "worker " in lost[0] and "pid " in lost[0], err
    assert "lost episode 2: " in lost[0] and said in lost[0]
    assert RGBDDataset(tmp_path / "data").content_hash == RGBDDataset(collected).content_hash


class Silent(Worker):
    """Says nothing."""

    def news(self):
        return None

    def stop(self):
        pass


def test_a_worker_that_hangs_is_told_with_the_time_it_had():
    worker = Silent("worker 0", 8.0, 0)
    assert worker.hung() == ("failed", "hung: it was not ready in 300 s")
    worker.begin(1)
    assert worker.hung() == ("failed", "hung: the episode was not done in 8 s")


def test_episode_that_always_fails_stops_the_run(tmp_path):
    faulty = {"STANDIN_FAULT": "raise", "STANDIN_EPISODE": reset_seed(0, 1)}
    result = call("collect-rollouts", options(tmp_path), **faulty)
    assert_one_line_error(result, "episode 1 failed 3 times", "fell off the plane", "same command")
    assert "RuntimeError: the square fell off the plane" in (tmp_path / "errors.log").read_text()
    assert len(RGBDDataset(tmp_path)) == 1


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_signals_end_it_cleanly(tmp_path, number, code):
    process = start("collect-rollouts", options(tmp_path, episodes=50), STANDIN_SLEEP=0.02)
    wait_for(lambda: list(tmp_path.glob("*.h5")))
    process.send_signal(number)
    returned, _, err = finish(process)
    assert returned == code and "Traceback" not in err, err
    assert find_damage(tmp_path) == [] and not list(tmp_path.glob("*.tmp"))
    with locked(tmp_path):
        pass


def test_sigkill_at_random_moments_costs_the_episodes_in_flight(collected, tmp_path):
    """Whatever was there stays, what is there is whole, and the same command ends with the same dataset."""
    rng = np.random.default_rng(int(time.time()))
    command = options(tmp_path, workers=2, **{"ground-truth": True})
    for _ in range(4):
        before = {path.name: path.read_bytes() for path in tmp_path.glob("*.h5")}
        process = start("collect-rollouts", command, STANDIN_SLEEP=0.05)
        time.sleep(rng.uniform(0.2, 2.5))
        process.kill()
        finish(process)
        for name, content in before.items():
            assert (tmp_path / name).read_bytes() == content
        assert find_damage(tmp_path) == []
    code, _, err = call("collect-rollouts", command)
    assert code == 0, err
    assert RGBDDataset(tmp_path).content_hash == RGBDDataset(collected).content_hash
    assert not list(tmp_path.glob("*.tmp"))


def test_workers_end_when_the_collector_is_killed(tmp_path):
    process = start("collect-rollouts", options(tmp_path, episodes=50, workers=2), STANDIN_SLEEP=0.02)
    wait_for(lambda: list(tmp_path.glob("*.h5")))
    listed = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text()
    children = [int(pid) for pid in listed.split()]
    process.kill()
    finish(process)
    assert children
    wait_for(lambda: not any(os.path.exists(f"/proc/{pid}") for pid in children))


def wait_for(condition, seconds=240.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.05)


def test_two_collectors_in_one_folder(tmp_path):
    with locked(tmp_path), pytest.raises(UsageError, match="another process is writing to"):
        main(Config(**arguments(tmp_path)))


def test_an_environments_own_keywords_are_part_of_what_episodes_are(tmp_path):
    given = {"env": "standin:standin/Paced-v0", "image-size": None, "env-kwargs": '{"pace": 0.5}'}
    code, _, err = call("collect-rollouts", options(tmp_path, episodes=1, **given))
    assert code == 0, err
    dataset = RGBDDataset(tmp_path)
    assert dataset.attrs["env_kwargs"] == {"pace": 0.5} and dataset.camera.width == 16
    moves = np.diff(dataset.load("proprio")[:, :2], axis=0)
    np.testing.assert_allclose(moves, 0.5 * 0.1 * dataset.load("action")[:-1, :2], atol=1e-6)
    assert call("collect-rollouts", options(tmp_path, episodes=1, **given))[0] == 0
    result = call("collect-rollouts", options(tmp_path, episodes=1, **{**given, "env-kwargs": '{"pace": 0.1}'}))
    assert_one_line_error(result, "was collected with env_kwargs = {'pace': 0.5}", "choose another --out")


@pytest.mark.parametrize(
    ("changed", "kwargs"),
    [
        ({"env": "tabletop"}, {"image_size": 64}),
        ({"env": "t3vip/TabletopD-v0", "image_size": 32}, {"image_size": 32}),
        ({"env": "planar-push"}, {"split": "train", "image_size": 64}),
        ({"env": "t3vip/PlanarPush-v0", "env_kwargs": '{"split": "all"}'}, {"split": "all", "image_size": 64}),
        (
            {"env": "planar-push", "scene": "test", "env_kwargs": '{"depth_noise": 0.002}'},
            {"split": "test", "image_size": 64, "depth_noise": 0.002},
        ),
        ({"env": "dexhand"}, {"new_goals": True, "image_size": 64}),
        ({"env": "dexhand", "env_kwargs": '{"new_goals": false}'}, {"new_goals": False, "image_size": 64}),
        ({"env": "envs:t3vip/DexHand-v0"}, {"new_goals": True, "image_size": 64}),
        ({"env": "my/Env-v0"}, {}),
        ({"env": "my/Env-v0", "image_size": 64, "env_kwargs": '{"scene": "D"}'}, {"image_size": 64, "scene": "D"}),
    ],
)
def test_keyword_arguments_that_environments_get(tmp_path, changed, kwargs):
    assert Config(tmp_path, **changed).manifest().env_kwargs == kwargs


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"env-kwargs": "pace=2"}, ("--env-kwargs is 'pace=2'", "JSON object")),
        ({"env-kwargs": "[1]"}, ("--env-kwargs is '[1]'", "it is a list")),
        ({"env-kwargs": '{"pace": NaN}'}, ("--env-kwargs", "NaN is no number")),
        ({"env-kwargs": '{"image_size": 8}'}, ("'image_size'", "--image-size")),
        ({"env": "tabletop", "env-kwargs": '{"scene": "D"}'}, ("'scene'", "--scene")),
        ({"env": "t3vip/TabletopC-v0", "env-kwargs": '{"scene": "D"}'}, ("'scene'", "--env")),
        ({"env": "planar-push", "env-kwargs": '{"split": "test"}'}, ("'split'", "--scene")),
        ({"env-kwargs": '{"speed": 2}'}, ("'speed'", "check --env and --env-kwargs")),
        ({"env": "kitchen"}, ("'kitchen'", "tabletop", "module:Name-v0")),
        ({"env": "CartPole-v1", "image-size": None}, ("environment 'CartPole-v1' has no attribute 'camera'",)),
        ({"env": "tabletop", "scene": "E"}, ("'E'", "A, B, C, D")),
        ({"env": "no_such_module:x/Y-v0"}, ("no_such_module:x/Y-v0",)),
        ({"env": "CartPole-v1", "episodes": 0}, ("--episodes", "0")),
        ({"workers": 0}, ("--workers", "0")),
        ({"episode-timeout": "inf"}, ("--episode-timeout is inf", "at most 1000000")),
        ({"episode-timeout": 3e6}, ("--episode-timeout is 3000000.0", "at most 1000000")),
        ({"image-size": 2}, ("--image-size", "2")),
        ({"env": "standin:standin/Nothing-v0"}, ("standin/Nothing-v0",)),
        ({"env": "planar-push", "env-kwargs": '{"supersample": 1.5}'}, ("supersample is 1.5", "odd number")),
        ({"env": "planar-push", "env-kwargs": '{"supersample": 6001}'}, ("96016 x 96016", "smaller image size")),
    ],
)
def test_bad_options_are_one_line(tmp_path, changed, words):
    assert_one_line_error(call("collect-rollouts", options(tmp_path / "data", **changed)), *words)


def test_a_place_below_a_file_is_one_line(tmp_path):
    file = tmp_path / "file"
    file.touch()
    assert_one_line_error(
        call("collect-rollouts", options(file / "data")), f"cannot read or write {file}", "another place"
    )


def test_policy_of_another_environment_is_told_at_once_and_leaves_the_folder_free(tmp_path):
    result = call("collect-rollouts", options(tmp_path, policy="play"))
    assert_one_line_error(result, "policy 'play' cannot act in StandIn", "--env tabletop")
    assert "lost episode" not in result[2] and not list(tmp_path.glob("*.h5"))
    code, _, err = call("collect-rollouts", options(tmp_path, episodes=1))
    assert code == 0, err
    assert json.loads((tmp_path / "dataset.json").read_text())["policy"] == "noise"


def test_options_that_cannot_work_leave_no_folder_behind(tmp_path):
    assert_one_line_error(call("collect-rollouts", options(tmp_path / "data", policy="play")), "'play' cannot act")
    assert not (tmp_path / "data").exists()
    (tmp_path / "mine").mkdir()
    assert_one_line_error(call("collect-rollouts", options(tmp_path / "mine", policy="play")), "'play' cannot act")
    assert (tmp_path / "mine").exists()


def test_environment_that_does_not_observe_depth(tmp_path):
    with pytest.raises(UsageError, match="has no attribute 'camera'"):
        main(Config(**arguments(tmp_path, env="standin:standin/Blind-v0")))


def test_going_on_with_other_programs_is_told(tmp_path, monkeypatch):
    call("collect-rollouts", options(tmp_path, episodes=1))
    assert "other versions" not in call("collect-rollouts", options(tmp_path, episodes=1))[2]
    monkeypatch.setattr("data_collection.collect.versions", lambda: {"source": "changed"})
    assert "made by other versions" in call("collect-rollouts", options(tmp_path, episodes=1))[2]


def test_going_on_reads_the_source_once_however_many_episodes_there_are(collected, tmp_path, monkeypatch):
    folder, calls = shutil.copytree(collected, tmp_path / "data"), []
    monkeypatch.setattr("data_collection.collect.versions", lambda: calls.append(1) or versions())
    main(Config(**arguments(folder, ground_truth=True)))
    assert len(calls) == 1


def test_damaged_shard_stops_resuming(collected, tmp_path):
    main(Config(**arguments(tmp_path, episodes=1)))
    (tmp_path / "shard-00000.h5").write_bytes(b"")
    result = call("collect-rollouts", options(tmp_path, episodes=2))
    assert_one_line_error(result, "shard-00000.h5 is damaged", "inspect-dataset", "--repair")


@pytest.mark.parametrize("terminates", [True, False])
def test_the_environment_may_end_an_episode_and_the_dataset_says_how(tmp_path, terminates):
    what = {"image_size": 16, "terminates": terminates}
    manifest = Manifest("standin:standin/Ending-v0", what, "noise", seed=0, steps=8, ground_truth=False, episodes=1)
    EpisodeMaker(manifest).write(0, tmp_path / "shard-00000.h5")
    dataset = RGBDDataset(tmp_path)
    assert dataset.episode_lengths.tolist() == [4]
    assert dataset.episode_terminated.tolist() == [terminates]


def test_episodes_whose_steps_are_up_have_not_terminated(collected):
    assert not RGBDDataset(collected).episode_terminated.any()


class _NanPolicy(RandomPolicy):
    def act(self, obs):
        return np.full(3, np.nan)


def test_actions_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="finite"):
        collect_episode(StandIn(), _NanPolicy(), 4, seed=0, episode=0)
