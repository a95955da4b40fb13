"""Points on things in the simulators: setups are what they promise, and the oracle's simulator is the environment."""

import json
import sys

import gymnasium as gym
import numpy as np
import pytest

from planning import servo_eval
from planning.controllers import CONTROLLERS, Kit
from planning.drawer_setups import gap, make_drawer_setup
from planning.episode import run_episode
from planning.icem import ICEMConfig
from planning.push_setups import FARTHEST, NEAREST, make_push_setup
from planning.tasks import TASKS
from planning.what_if import what_if
from worldmodel import checkpoint


@pytest.fixture(scope="module")
def push():
    env = gym.make("envs:t3vip/PlanarPush-v0", split="test", max_episode_steps=-1, disable_env_checker=True)
    yield env
    env.close()


@pytest.fixture(scope="module")
def table():
    env = gym.make("envs:t3vip/TabletopD-v0", max_episode_steps=-1, disable_env_checker=True)
    yield env
    env.close()


def test_push_setups_are_what_they_promise(push):
    camera = push.unwrapped.camera
    for index in range(4):
        setup = make_push_setup(push, index)
        observation = setup.start(push)
        np.testing.assert_array_equal(push.unwrapped.get_state(), setup.state)
        point, way = setup.goal.designated, setup.goal.point_world - setup.goal.designated
        assert NEAREST <= setup.distance <= FARTHEST and setup.distance == pytest.approx(np.linalg.norm(way))
        np.testing.assert_allclose(setup.mark.position(push), point, atol=1e-9)
        u, v = np.rint(camera.project(camera.to_camera(point))).astype(int)
        assert push.unwrapped.segmentation()[v, u] == push.unwrapped.body_names.index("object")
        assert observation["depth"][v, u] == pytest.approx(camera.to_camera(point)[2], abs=1e-4) and way[2] == 0
        middle = push.unwrapped.object_pose[:2]
        assert setup.part == ("behind" if (middle - push.unwrapped.tip_position) @ way[:2] > 0 else "round")
    again = make_push_setup(push, 3)
    np.testing.assert_array_equal(again.state, setup.state)
    np.testing.assert_array_equal(again.goal.point_world, setup.goal.point_world)


def test_drawer_setups_are_what_they_promise(table):
    drawer = table.unwrapped.mj_data.joint("drawer")
    for index in range(2):
        setup = make_drawer_setup(table, index)
        observation = setup.start(table)
        np.testing.assert_allclose(setup.mark.position(table), setup.goal.designated, atol=1e-9)
        way = setup.goal.point_world - setup.goal.designated
        assert np.abs(way[[0, 2]]).max() < 1e-9 and (setup.part == "open") == (way[1] < 0) == (index == 0)
        middle = gap(table.unwrapped)
        assert np.abs((table.unwrapped.tcp_position - middle)[:2]).max() < 0.03 and observation["proprio"][14] == -1

        # Lowered into the gap the hand moves the drawer, and the mark goes with it, as the simulator says beforehand.
        lower = int(np.ceil((table.unwrapped.tcp_position - middle)[2] / 0.02))
        moves = np.zeros((lower + 5, 7), np.float32)
        moves[:lower, 2], moves[lower:, 1], moves[:, 6] = -1, np.sign(way[1]), -1
        simulator = what_if(table)
        paths = simulator.paths(simulator.state(), moves[None], setup.mark)
        simulator.close()
        slid = float(drawer.qpos[0])
        marks = []
        for move in moves:
            table.step(move)
            marks.append(setup.mark.position(table))
        np.testing.assert_allclose(paths.point[0], marks, atol=1e-5)
        np.testing.assert_allclose(paths.effector[0, -1], table.unwrapped.tcp_position, atol=1e-5)
        assert (float(drawer.qpos[0]) - slid) * -np.sign(way[1]) > 0.03


def test_the_oracle_pushes_a_point_to_its_goal_as_its_simulator_says(push):
    setup = next(setup for setup in (make_push_setup(push, i) for i in range(20)) if setup.part == "behind")
    task, search = TASKS["planar-push", "object"], ICEMConfig(horizon=5, population=16, iterations=2, elites=4)
    kit = Kit(push, search, body=task.body, reach=task.reach, surface=task.surface)
    kit.begin(setup.mark, np.random.default_rng(0))
    try:
        record = run_episode(push, setup, "oracle", CONTROLLERS["oracle"](kit), 60)
        assert record.reached("3d") and record.reached("2d") and record.limits[0] == 0.02 and record.part == "behind"
        state, actions = kit.simulator.state(), np.random.default_rng(1).uniform(-1, 1, (1, 6, 3))
        paths = kit.simulator.paths(state, actions, setup.mark)
    finally:
        kit.close()
    for action in actions[0]:
        push.step(action)
    np.testing.assert_allclose(paths.point[0, -1], setup.mark.position(push), atol=5e-4)  # it may tilt
    np.testing.assert_allclose(paths.effector[0, -1], push.unwrapped.tcp_position, atol=1e-6)
    assert not run_episode(push, setup, "random", CONTROLLERS["random"](kit), 20).reached("3d")


def test_shipped_models_are_those_of_the_environment(push, table, monkeypatch):
    asked = []

    def load(name, device):
        asked.append(name)
        raise KeyError

    monkeypatch.setattr(checkpoint, "load_model", load)
    for env, given in ((push, {}), (table, {}), (push, {"t3vip": "mine"})):
        with pytest.raises(KeyError):
            Kit(env, checkpoints=given).model("t3vip")
    shipped = checkpoint.PRETRAINED
    assert asked == [shipped / "planar-push/t3vip", shipped / "t3vip", "mine"]


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["servo-eval", *map(str, arguments)])
    servo_eval.command()


def test_command_reports_by_parts(tmp_path, monkeypatch, capsys):
    options = ["--env", "planar-push", "--model", "proportional", "random", "--episodes", 2, "--out", tmp_path]
    run(monkeypatch, *options, "--steps", 5, "--video", 1)
    assert "at-10mm" in capsys.readouterr().out
    document = json.loads((tmp_path / "servo.json").read_text())
    assert (document["env"], document["point"], document["scene"]) == ("planar-push", "object", "test")
    entry = document["models"]["random"]
    assert set(entry["by_part"]) == {"behind", "round"} and "by_axis_share" not in entry
    assert set(entry["success_3d_at"]) == {"0.02", "0.01"}
    assert json.loads((tmp_path / "config.json").read_text())["planner"]["horizon"] == 6
    assert (tmp_path / "videos" / "random-setup00-0.mp4").stat().st_size > 1000
    assert (tmp_path / "success.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--env", "planar-push", "--point", "hand"], "--point object"),
        (["--env", "dexhand"], "planar-push"),
        (["--env", "planar-push", "--scene", "D"], "validation"),
        (["--scene", "E"], "A, B, C, D"),
    ],
)
def test_mistakes_are_one_line(tmp_path, monkeypatch, capsys, options, word):
    with pytest.raises(SystemExit) as stop:
        run(monkeypatch, "--out", tmp_path, *options)
    err = capsys.readouterr().err
    assert stop.value.code == 2 and word in err and err.count("\n") == 1
