"""Planar pushing: the objects' shapes, Gymnasium's contract, friction that holds, exact restoring, what-if."""

from __future__ import annotations

import copy
import gc
import itertools
import pickle

import gymnasium
import mujoco
import numpy as np
import pytest
import stable_baselines3.common.env_checker as sb3
from gymnasium.utils.env_checker import check_env

import envs  # noqa: F401  (registers)
from envs.errors import UsageError
from envs.gl import OffscreenContext
from envs.planar_push import PlanarPushEnv, control, objects, pieces
from envs.planar_push.hidden import Hidden
from envs.planar_push.scene import TIP_RADIUS
from envs.planar_push.simulate import BatchSimulator

PLAIN = Hidden(mass=0.5, weights=(0, 0, 0, 0), table_friction=0.3, tip_friction=0.2)


@pytest.fixture(scope="module")
def blind():
    """An environment without pictures."""
    env = PlanarPushEnv("all", images=False)
    yield env
    env.close()


def place(env: PlanarPushEnv, name="3333", pose=(0, 0, 0), tip=(-0.12, 0), hidden=PLAIN) -> None:
    env.reset(seed=0, options={"object": name, "pose": pose, "tip": tip, "hidden": hidden})


def push(env: PlanarPushEnv, move=(0.08, 0.0), steps=12) -> np.ndarray:
    """Push by `move` metres in all; where the object goes: x, y, yaw."""
    before = env.object_pose
    for _ in range(steps):
        env.step(np.append(np.asarray(move) / steps / control.ACTION_SCALE[:2], 0))
    return env.object_pose - before


# --- Objects -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("digit", objects.SHAPES)
def test_what_one_sees_is_what_one_touches(digit):
    """The picture, the collisions and the outlines agree on where the object ends."""
    env = PlanarPushEnv(image_size=96, supersample=1)
    place(env, digit * 4, tip=(-0.2, -0.2))
    camera = env.camera
    ids, depth = env.segmentation(), env.observation()["depth"]
    points = camera.to_world(camera.unproject(depth))
    body = env.mj_model.body("object").id
    top = points[(ids == body) & (points[..., 2] > 0.035)][:, :2]
    assert len(top) > 50
    assert (pieces.clearance(env.object_name, top) < 1e-3).all()
    table = points[(ids == 0)]
    assert (np.abs(table[:, 2]) < 1e-3).all()  # depth is metric: the table is at 0
    around = np.array([[0.09 * np.cos(a), 0.09 * np.sin(a)] for a in np.linspace(0, np.pi / 2, 12)])
    for start in around:
        steps = start * np.linspace(1, 0, 200)[:, None]
        expected = steps[np.argmax(pieces.clearance(env.object_name, steps) < TIP_RADIUS)]
        for step in steps:
            env.mj_data.qpos[env.tip_qpos] = step
            mujoco.mj_fwdPosition(env.mj_model, env.mj_data)
            if any("tip" in (env.mj_model.geom(g).name for g in contact.geom) for contact in env.mj_data.contact):
                break
        np.testing.assert_allclose(step, expected, atol=1.5e-3)
    env.close()


# --- Gymnasium -----------------------------------------------------------------------------------------------------


def test_registered_and_passes_both_checkers():
    env = gymnasium.make("envs:t3vip/PlanarPush-v0")
    check_env(env.unwrapped)
    sb3.check_env(env, warn=False)
    assert env.spec.max_episode_steps == 60
    assert env.unwrapped.camera.width == 64
    env.close()


def test_render_modes_and_sizes():
    for mode in ("rgb_array", "depth_array", "rgbd_tuple"):
        env = gymnasium.make("t3vip/PlanarPush-v0", image_size=32, render_mode=mode).unwrapped
        observation, _ = env.reset(seed=0)
        picture = env.render()
        rgb, depth = {"rgb_array": (picture, None), "depth_array": (None, picture)}.get(mode, picture)
        if rgb is not None:
            np.testing.assert_array_equal(rgb, observation["rgb"])
        if depth is not None:
            np.testing.assert_array_equal(depth, observation["depth"])
            assert 0.35 < depth.min() < depth.max() < 1.2  # everything in view lies inside the working range
        assert set(np.unique(env.segmentation())) == {0, *env.hand_body_ids, env.mj_model.body("object").id}
        env.close()


def test_views_of_many_sizes_hold_one_context():
    env = PlanarPushEnv(images=False)
    env.reset(seed=0)
    gc.collect()
    before = len(OffscreenContext._alive)
    assert [env.view("side", size).shape for size in (32, 48, 32)] == [(32, 32, 3), (48, 48, 3), (32, 32, 3)]
    assert len(OffscreenContext._alive) == before + 1
    env.close()
    assert len(OffscreenContext._alive) == before


def test_an_environment_that_has_drawn_can_be_copied_and_pickled():
    env = PlanarPushEnv()
    env.reset(seed=3)
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    observation = env.step([1, 0, 0])[0]
    for other in copies:
        for name, values in other.step([1, 0, 0])[0].items():
            np.testing.assert_array_equal(values, observation[name])
        other.close()
    env.close()


def test_the_tip_is_where_the_camera_sees_it():
    env = PlanarPushEnv(image_size=96, supersample=1)
    for corner in itertools.product((-0.24, 0.24), repeat=2):
        place(env, tip=corner)
        camera, ids = env.camera, env.segmentation() == env.hand_body_ids[0]
        points = camera.to_world(camera.unproject(env.observation()["depth"]))[ids]
        assert np.linalg.norm(points[:, :2] - env.tcp_position[:2], axis=1).max() < 2 * TIP_RADIUS + 1e-3
        u, v = camera.project(camera.to_camera(env.tcp_position))
        assert 2 < u < 93
        assert 2 < v < 93
    env.close()


def test_seeds_are_exact_and_starts_are_varied_and_free(blind):
    first, again = blind.reset(seed=7), blind.reset(seed=7)
    np.testing.assert_array_equal(first[0]["proprio"], again[0]["proprio"])
    np.testing.assert_array_equal(first[1]["scene_obs"], again[1]["scene_obs"])
    seen = []
    for seed in range(12):
        _, info = blind.reset(seed=seed)
        seen.append(info["scene_obs"])
        assert not any(blind.mj_model.geom("tip").id in contact.geom for contact in blind.mj_data.contact)
        assert np.abs(blind.mj_data.qvel).max() < 5e-3  # everything stands
    assert (np.ptp(seen, axis=0) > [0.05, 0.05, 1, 20, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1]).all()


def test_a_pose_of_ones_choice_gets_a_tip_beside_it(blind):
    redrawn = 0
    for seed in range(40):
        blind.reset(seed=seed)
        drawn = blind.tip_position - blind.object_pose[:2]
        blind.reset(seed=seed, options={"pose": [0.15, 0.1, 0.5]})
        offset = blind.tip_position - [0.15, 0.1]
        assert np.abs(blind.tip_position).max() <= 0.24 + 1e-6
        assert np.linalg.norm(offset) == pytest.approx(np.linalg.norm(drawn), abs=1e-3)
        np.testing.assert_allclose(blind.object_pose, [0.15, 0.1, 0.5], atol=1e-3)
        redrawn += not np.allclose(offset, drawn, atol=1e-3)
        tip = blind.tip_position
        blind.reset(seed=seed, options={"pose": [0.15, 0.1, 0.5]})
        np.testing.assert_array_equal(blind.tip_position, tip)
    assert 5 < redrawn < 35  # where the tip that was drawn fits, it stays


def test_a_restored_state_goes_on_to_the_last_bit_also_on_another_object(blind):
    place(blind, "1243", tip=(-0.1, 0.01), hidden=Hidden(0.4, (0.2, 0, 0, 0.1), 0.3, 0.4))
    push(blind, (0.04, 0))
    state = blind.get_state()

    def onward():
        rows = [np.append(blind.step(a)[0]["proprio"], blind.scene_obs()) for a in np.tile([0.4, 0.1, 0.2], (10, 1))]
        return np.array(rows)

    expected, end = onward(), blind.get_state()
    assert np.ptp(expected[:, 3]) > 0.01  # it was pushed
    blind.reset(seed=99)
    blind.set_state(state)
    np.testing.assert_array_equal(blind.get_state(), state)
    np.testing.assert_array_equal(onward(), expected)
    np.testing.assert_array_equal(blind.get_state(), end)


def test_noise_is_an_option_and_is_restored_too():
    noisy = PlanarPushEnv(image_size=32, depth_noise=0.004, action_noise=0.002)
    clean = PlanarPushEnv(image_size=32)
    for env in (noisy, clean):
        env.reset(seed=3)
    error = noisy.observation()["depth"] - clean.observation()["depth"]
    assert error.std() == pytest.approx(0.004, rel=0.25)  # at about 1 m
    np.testing.assert_array_equal(noisy.observation()["rgb"], clean.observation()["rgb"])
    state = noisy.get_state()
    tips = np.array([noisy.step([0.0, 0.0, 0.0])[0]["proprio"][:2] for _ in range(40)])
    assert np.diff(tips, axis=0).std() == pytest.approx(0.002, rel=0.25)
    depth = noisy.observation()["depth"]
    noisy.set_state(state)
    again = [noisy.step([0.0, 0.0, 0.0])[0] for _ in range(40)]
    np.testing.assert_array_equal([frame["proprio"][:2] for frame in again], tips)
    np.testing.assert_array_equal(again[-1]["depth"], depth)
    for env in (noisy, clean):
        env.close()


# --- Control and physics ---------------------------------------------------------------------------------------------


def test_actions_are_increments_and_the_heading_is_reported(blind):
    place(blind, tip=(-0.2, -0.2))
    for _ in range(4):
        observation = blind.step([0.5, -0.25, 0.5])[0]
    np.testing.assert_allclose(blind.tip_position, [-0.2 + 4 * 0.0125, -0.2 - 4 * 0.00625], atol=1e-4)
    np.testing.assert_allclose(observation["proprio"], [*blind.tip_position, np.pi / 2], atol=1e-6)
    for _ in range(10):
        blind.step([-5.0, -5.0, 0.0])
    np.testing.assert_allclose(blind.tip_position, control.WORKSPACE_LOW, atol=1e-4)


def test_absolute_actions_convert_there_and_back(blind):
    rng = np.random.default_rng(0)
    tip, heading = np.cumsum(rng.uniform(-0.01, 0.01, (9, 2)), axis=0), rng.uniform(-3, 3, 8)
    relative = control.from_absolute(tip, heading)
    place(blind, pose=(0.2, 0.2, 0), tip=tip[0])
    for action, after in zip(relative, tip[1:], strict=True):
        blind.step(action)
        np.testing.assert_allclose(blind.tip_position, after, atol=1e-4)
    back = control.to_absolute(tip[0], relative)
    np.testing.assert_allclose(back[0], tip, atol=1e-12)
    np.testing.assert_allclose(back[1], heading, atol=1e-12)


@pytest.mark.parametrize("angle", (0.0, 2.5))
def test_a_push_through_the_middle_moves_the_object_straight(blind, angle):
    direction = np.array([np.cos(angle), np.sin(angle)])
    place(blind, "3333", pose=(0, 0, angle), tip=-0.09 * direction)
    moved = push(blind, 0.08 * direction)
    free = 0.09 - 2 * 0.035 - TIP_RADIUS
    np.testing.assert_allclose(moved[:2], (0.08 - free) * direction, atol=2e-3)
    assert abs(moved[2]) < 0.02
    blind.step([0, 0, 0])
    before = blind.object_pose
    for _ in range(24):
        blind.step(np.append(-0.2 * direction, 0))
    np.testing.assert_allclose(blind.object_pose, before, atol=1e-4)  # friction holds; nothing pulls, nothing creeps


def test_a_push_beside_the_middle_turns_it(blind):
    turns = []
    for side in (-1, 1):
        place(blind, "3333", tip=(-0.09, 0.03 * side))
        turns.append(push(blind)[2])
    assert turns[0] > 0.1
    np.testing.assert_allclose(turns[0], -turns[1], atol=0.02)


def test_the_object_stays_on_its_feet(blind):
    for name in ("1111", "2222", "1234"):
        place(blind, name, tip=(-0.12, 0.02))
        push(blind, (0.2, 0), steps=9)  # as fast as the tip can
        pose = blind.mj_data.qpos[blind.object_qpos]
        assert abs(pose[2]) < 1e-3
        assert np.abs(pose[4:6]).max() < 0.01


def test_hidden_variables_show_in_the_motion_only(blind):
    def moved(**changes) -> np.ndarray:
        values = {"mass": 0.5, "weights": (0, 0, 0, 0), "table_friction": 0.3, "tip_friction": 0.2, **changes}
        place(blind, "3333", tip=(-0.09, 0.02), hidden=Hidden(**values))
        np.testing.assert_allclose(blind.observation()["proprio"], [-0.09, 0.02, 0], atol=1e-6)
        return push(blind)

    plain = moved()
    assert abs(moved(weights=(0, 0.2, 0, 0)) - plain)[2] > 0.1
    assert abs(moved(tip_friction=0.6) - plain).max() > 0.005
    slides = []
    for friction in (0.15, 0.6):  # let go at full speed
        place(blind, "3333", tip=(-0.12, 0), hidden=Hidden(0.5, (0, 0, 0, 0), friction, 0.2))
        push(blind, (0.1, 0), steps=4)
        slides.append(push(blind, (0, 0), steps=6)[0])
    assert slides[0] > 2 * slides[1] > 0


def test_mass_properties_are_those_of_the_outlines():
    mass, centre, spread = pieces.mass_properties("3333", 2.0, (0, 0, 0, 0))
    assert mass == pytest.approx(2.0)
    np.testing.assert_allclose(centre, 0, atol=1e-12)
    # a square of 7 cm with four rectangles of 7 x 3.5 cm
    square, sides = 2.0 * 0.07**2 / 12 / 3, 2.0 / 6 * (0.035**2 / 12 + 0.0525**2) * 2 + 2.0 / 6 * 0.07**2 / 12 * 2
    np.testing.assert_allclose(spread, square + sides, rtol=1e-9)
    mass, centre, _ = pieces.mass_properties("3333", 0.4, (0.1, 0, 0, 0))
    np.testing.assert_allclose(centre, [0.1 * 0.0525 / 0.5, 0], atol=1e-12)
    area = pieces.side_area_and_centroid("circular")[0]
    assert area == pytest.approx(np.pi * 0.035**2 / 2, rel=0.01)


def test_batch_simulation_is_what_the_environment_does(blind):
    place(blind, "1432", tip=(-0.1, 0.0), hidden=Hidden(0.4, (0, 0.2, 0, 0), 0.3, 0.4))
    actions = np.clip(np.random.default_rng(0).normal([0.4, 0, 0], 0.2, (3, 8, 3)), -1, 1)
    state = blind.get_state()
    simulator = BatchSimulator(blind, threads=2)
    paths = simulator.rollout(state, actions)
    np.testing.assert_array_equal(blind.get_state(), state)
    for sequence, tip, pose in zip(actions, paths.tip, paths.object_pose, strict=True):
        blind.set_state(state)
        for action, tip_there, pose_there in zip(sequence, tip, pose, strict=True):
            blind.step(action)
            np.testing.assert_allclose(blind.tip_position, tip_there, atol=1e-9)
            np.testing.assert_allclose(blind.object_pose, pose_there, atol=1e-9)
    blind.reset(seed=1)
    with pytest.raises(UsageError, match="another object"):
        simulator.rollout(state, actions)
    simulator.close()


def test_bad_input_is_named(blind):
    blind.reset(seed=0)
    cases = [
        (lambda: blind.step(np.full(3, np.nan)), "nan"),
        (lambda: blind.step(np.zeros(2)), r"\(2,\)"),
        (lambda: PlanarPushEnv("dev"), "'dev'"),
        (lambda: PlanarPushEnv(object="125"), "'125'"),
        (lambda: PlanarPushEnv(object="1235"), "'1235'"),
        (lambda: PlanarPushEnv(render_mode="human"), "human"),
        (lambda: PlanarPushEnv(image_size=0), "0"),
        (lambda: PlanarPushEnv(depth_noise=-1.0), "depth_noise is -1.0"),
        (lambda: objects.from_omnipush("1132"), "1132"),
        (lambda: blind.set_state(np.zeros(3)), r"\(3,\)"),
        (lambda: blind.reset(options={"arm": 1}), "arm"),
        (lambda: blind.reset(options={"pose": [0, 0]}), "pose"),
        (lambda: blind.reset(options={"pose": [0.5, 0, 0]}), r"pose \[0.5, 0.0, 0.0\] leaves the tip no place"),
        (lambda: blind.reset(options={"tip": [0.3, 0]}), "0.3"),
        (lambda: blind.reset(options={"pose": [0, 0, 0], "tip": [0.01, 0]}), "inside"),
        (lambda: blind.reset(options={"hidden": [1, 2]}), r"option hidden is \[1, 2\]; give 7 finite numbers"),
        (lambda: blind.reset(options={"hidden": "heavy"}), "option hidden is 'heavy'; give 7 numbers"),
        (lambda: blind.reset(options={"hidden": [0, 0, 0, 0, 0, 1, 1]}), "mass"),
        (lambda: blind.view("top"), "top"),
    ]
    for act, named in cases:
        with pytest.raises(UsageError, match=named):
            act()
