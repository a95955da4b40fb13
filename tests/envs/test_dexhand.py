"""`t3vip/DexHand-v0`: the hand, the cube, goals, pictures, and exact restoring."""

from __future__ import annotations

import gymnasium
import mujoco
import numpy as np
import pytest
import stable_baselines3.common.env_checker as sb3
from gymnasium.utils.env_checker import check_env
from scipy.spatial.transform import Rotation

import envs  # noqa: F401  (registers)
from envs import rotations
from envs.dexhand import DexHandEnv, control, goals
from envs.dexhand.simulate import BatchSimulator
from envs.errors import UsageError

OPEN_HAND = np.full(20, -1.0)


@pytest.fixture(scope="module")
def blind():
    """An environment without pictures."""
    env = DexHandEnv(images=False)
    yield env
    env.close()


@pytest.fixture(scope="module")
def seeing():
    env = DexHandEnv(image_size=64, supersample=1)
    yield env
    env.close()


def test_registered_and_passes_both_checkers():
    env = gymnasium.make("envs:t3vip/DexHand-v0", image_size=32)
    assert env.spec.max_episode_steps == 100
    check_env(env.unwrapped)
    sb3.check_env(
        env.unwrapped, warn=False
    )  # also checks that rewards are what `compute_reward` says, alone and in batches
    env.close()


def test_render_modes_agree_with_observations():
    for mode in ("rgb_array", "depth_array", "rgbd_tuple"):
        env = DexHandEnv(image_size=32, supersample=1, render_mode=mode)
        observation, _ = env.reset(seed=0)
        picture = env.render()
        rgb, depth = {"rgb_array": (picture, None), "depth_array": (None, picture)}.get(mode, picture)
        if rgb is not None:
            np.testing.assert_array_equal(rgb, observation["rgb"])
        if depth is not None:
            np.testing.assert_array_equal(depth, observation["depth"])
        for image in (rgb, depth):
            if image is not None:  # drawing on it changes no other picture
                image[:] = 0
        np.testing.assert_array_equal(env.observation()["rgb"], observation["rgb"])
        np.testing.assert_array_equal(env.observation()["depth"], observation["depth"])
        env.close()


def test_the_cube_is_where_the_camera_sees_it_and_lies_in_the_depth_range(seeing):
    observation, _ = seeing.reset(seed=1)
    camera, ids, depth = seeing.camera, seeing.segmentation(), observation["depth"]
    points = camera.to_world(camera.unproject(depth))[ids == seeing.mj_model.body("object").id]
    assert len(points) > 60
    local = Rotation.from_quat(np.roll(seeing.cube_pose[3:], -1)).inv().apply(points - seeing.cube_pose[:3])
    np.testing.assert_allclose(np.abs(local).max(axis=1), 0.025, atol=1e-3)  # on the surface of the cube
    assert (depth[ids == 0] == np.float32(camera.far)).all()  # the background is clipped
    seen = depth[ids > 0]
    assert camera.near + 0.03 < seen.min() < seen.max() < camera.far - 0.03
    assert set(seeing.hand_body_ids) & set(np.unique(ids))


def test_the_goal_is_hidden_from_the_camera_but_not_from_people(seeing):
    seeing.reset(seed=2, options={"goal": [1, 0, 0, 0]})
    static, side = seeing.view("static", 64), seeing.view("side", 64)
    state = seeing.get_state()
    seeing.mj_data.mocap_quat[0] = [0, 0.6, 0.8, 0]
    assert np.array_equal(seeing.view("static", 64), static)
    assert (seeing.view("side", 64) != side).any()
    seeing.set_state(state)
    assert np.array_equal(seeing.view("side", 64), side)
    assert seeing.mj_model.body("goal").id not in seeing.segmentation()


def test_seeds_are_exact_and_starts_are_varied_and_at_rest(blind):
    first, again = blind.reset(seed=7), blind.reset(seed=7)
    for key in first[0]:
        np.testing.assert_array_equal(first[0][key], again[0][key])
    seen, errors = [], []
    for seed in range(12):
        observation, info = blind.reset(seed=seed)
        assert not info["is_dropped"]
        assert np.abs(observation["observation"][48:54]).max() < 1  # the cube's velocity, m/s and rad/s
        seen.append(np.concatenate([observation["proprio"], observation["achieved_goal"]]))
        errors.append(info["rotation_error"])
    assert (np.ptp(seen, axis=0)[-4:] > 0.5).all()
    assert np.ptp(np.array(seen)[:, :24], axis=0).min() > 0.01
    assert np.ptp(errors) > 1


def test_goals_are_no_further_than_asked():
    env = DexHandEnv(goal_angle=90, images=False)
    errors = np.array([env.reset(seed=seed)[1]["rotation_error"] for seed in range(10)])
    assert errors.max() < np.pi / 2 + 1e-6
    assert errors.max() > 0.9
    turns = np.array([goals.random_turn(np.pi, np.random.default_rng(seed)) for seed in range(400)])
    assert np.abs(Rotation.from_quat(turns).as_matrix().mean(0)).max() < 0.15  # uniform: the mean matrix is 0
    env.close()


def test_a_restored_state_goes_on_to_the_last_bit(blind):
    blind.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(5):
        blind.step(rng.normal(0, 0.4, 20))
    state, actions = blind.get_state(), rng.normal(0, 0.4, (10, 20))
    expected = [blind.step(action)[0]["observation"] for action in actions]
    end, goal = blind.get_state(), blind.goal
    blind.reset(seed=99)
    blind.set_state(state)
    np.testing.assert_array_equal(blind.get_state(), state)
    np.testing.assert_array_equal([blind.step(action)[0]["observation"] for action in actions], expected)
    np.testing.assert_array_equal(blind.get_state(), end)
    np.testing.assert_array_equal(blind.goal, goal)


def test_a_new_goal_follows_one_that_is_reached_also_after_restoring():
    env = DexHandEnv(new_goals=True, images=False)
    env.reset(seed=0)
    env._set_goal(np.concatenate([goals.HOME, env.cube_pose[3:]]))
    state = env.get_state()
    hold = env.last_action
    observation, reward, _, _, info = env.step(hold)
    assert info["is_success"]
    assert reward == 0
    assert info["goals_reached"] == 1
    np.testing.assert_array_equal(info["scene_obs"][7:10], goals.HOME)
    np.testing.assert_allclose(goals.rotation_distance(info["scene_obs"][10:], info["scene_obs"][3:7]), 0, atol=0.2)
    assert goals.rotation_distance(observation["desired_goal"][3:], observation["achieved_goal"][3:]) > 0.2
    (shown,) = np.flatnonzero(env.mj_model.body_mocapid == 0)
    np.testing.assert_allclose(env.body_poses()[shown], env.goal)
    env.set_state(state)
    np.testing.assert_array_equal(env.step(hold)[0]["desired_goal"], observation["desired_goal"])
    assert env.step(hold)[4]["goals_reached"] == 1
    env.close()


def test_a_dropped_cube_ends_the_episode(blind):
    blind.reset(seed=0)
    for _ in range(60):
        # the wrist bends down and to the side, the fingers stretch
        _, reward, terminated, truncated, info = blind.step(OPEN_HAND * np.r_[1, 1, np.ones(18)])
        if terminated:
            break
        blind.mj_data.qvel[blind.cube_qvel] += [0.3, 0, 0.2, 0, 0, 0]  # and somebody knocks it off
    assert terminated
    assert not truncated
    assert info["is_dropped"]
    assert reward == goals.DROP_REWARD


def test_actions_take_the_joints_to_shares_of_their_ranges(blind):
    blind.reset(seed=0)
    np.testing.assert_allclose(control.actions_of(blind.mj_model, blind.mj_data.ctrl), blind.last_action)
    before = blind.joint_angles
    action = np.linspace(-0.2, 0.2, 20)
    info = blind.step(action)[4]
    np.testing.assert_allclose(blind.last_action, action, atol=1e-12)
    np.testing.assert_allclose(info["joint_delta"], blind.joint_angles - before)
    mujoco.mj_resetData(blind.mj_model, blind.mj_data)
    blind.mj_data.qpos[blind.cube_qpos] = [1, 0.2, 0.1, 1, 0, 0, 0]  # out of the way
    for _ in range(50):
        blind.step(action)
    low, high = blind.mj_model.actuator_ctrlrange.T
    driven = blind.mj_data.qpos[blind.mj_model.jnt_qposadr[blind.mj_model.actuator_trnid[:, 0]]]
    away = np.abs((driven - low) / (high - low) * 2 - 1 - action)
    assert np.median(away) < 0.1  # servos are soft: gravity and neighbours bend them


def test_rewards_over_batches():
    cube = np.tile([*goals.HOME, 1, 0, 0, 0], (3, 2, 1)).astype(np.float32)
    goal = cube.copy()
    goal[0, 0, 3:] = [np.cos(0.15), np.sin(0.15), 0, 0]  # turned by 0.3 rad
    goal[1, 0, 3:] *= -1  # the same rotation
    goal[2, 0, 0] += 0.06
    cube[2, 1, 2] = 0.03
    sparse, dense = goals.reward(cube, goal, False), goals.reward(cube, goal, True)
    np.testing.assert_array_equal(sparse, [[-1, 0], [0, 0], [-1, goals.DROP_REWARD]])
    np.testing.assert_allclose(dense, [[-0.3, 0], [0, 0], [-0.6, goals.DROP_REWARD]], atol=1e-5)


def test_distances_and_products_of_rotations():
    rng = np.random.default_rng(0)
    one, other = (Rotation.random(50, random_state=seed) for seed in (0, 1))
    a, b = (np.roll(r.as_quat(), 1, axis=1) * rng.choice([-1, 1], (50, 1)) for r in (one, other))
    np.testing.assert_allclose(goals.rotation_distance(a, b), (one * other.inv()).magnitude(), atol=1e-9)
    both = np.roll((one * other).as_quat(), 1, axis=1)
    np.testing.assert_allclose(goals.rotation_distance(rotations.multiply(a, b), both), 0, atol=1e-7)


def test_batch_simulation_is_what_the_environment_does(blind):
    blind.reset(seed=5)
    state, actions = blind.get_state(), np.random.default_rng(0).normal(0, 0.4, (3, 6, 20))
    simulator = BatchSimulator(blind, threads=2)
    paths = simulator.rollout(state, actions)
    np.testing.assert_array_equal(blind.get_state(), state)
    for sequence, poses, joints in zip(actions, paths.cube_pose, paths.joint_angles, strict=True):
        blind.set_state(state)
        for action, pose, angles in zip(sequence, poses, joints, strict=True):
            blind.step(action)
            np.testing.assert_array_equal(blind.cube_pose, pose)
            np.testing.assert_array_equal(blind.joint_angles, angles)
    simulator.close()


def test_bad_input_is_named(blind):
    blind.reset(seed=0)
    cases = [
        (lambda: blind.step(np.full(20, np.nan)), "nan"),
        (lambda: blind.step(np.zeros(24)), r"\(24,\)"),
        (lambda: DexHandEnv(goal_angle=0), "goal_angle is 0"),
        (lambda: DexHandEnv(reward_type="none"), "'none'"),
        (lambda: DexHandEnv(render_mode="human"), "human"),
        (lambda: blind.set_state(np.zeros(3)), r"\(3,\)"),
        (lambda: blind.reset(options={"arm": 1}), "arm"),
        (lambda: blind.reset(options={"cube": [0, 0, 0, 0]}), "cube"),
        (lambda: blind.reset(options={"goal": [1, 0, 0]}), "goal"),
        (lambda: blind.reset(options={"goal": "up"}), "option goal is 'up'; give 4 numbers"),
        (lambda: blind.reset(options={"hand": np.zeros(3)}), "option hand is .*; give 20 finite numbers"),
        (lambda: blind.reset(options={"hand": "fist"}), "option hand is 'fist'; give 20 numbers"),
        (lambda: blind.step("up"), "the action is 'up'"),
        (lambda: blind.view("top"), "top"),
        (lambda: BatchSimulator(blind, 1).rollout(blind.get_state(), np.zeros((2, 3, 3))), r"\(2, 3, 3\)"),
    ]
    for act, named in cases:
        with pytest.raises(UsageError, match=named):
            act()
