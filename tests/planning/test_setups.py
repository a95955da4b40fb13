"""Setups are the same for everybody, can be reached, and are seen by the camera."""

import gymnasium as gym
import numpy as np
import pytest

from planning.setups import CLEARANCE, FARTHEST, NEAREST, NEAREST_PIXELS, SEED_OFFSET, make_setup


@pytest.fixture(scope="module")
def env():
    env = gym.make("envs:t3vip/TabletopD-v0", max_episode_steps=-1, disable_env_checker=True)
    yield env
    env.close()


def test_same_index_same_setup_whatever_came_before(env):
    first = make_setup(env, 3)
    env.reset(seed=11)
    env.step(np.ones(7, np.float32))
    again = make_setup(env, 3)
    assert first.env_seed == again.env_seed
    np.testing.assert_array_equal(first.state, again.state)
    np.testing.assert_array_equal(first.goal.point_world, again.goal.point_world)
    other_seed, other_index = make_setup(env, 3, seed=1), make_setup(env, 4)
    assert len({first.env_seed, other_seed.env_seed, other_index.env_seed}) == 3


def test_setups_are_what_they_promise(env):
    tabletop, camera = env.unwrapped, env.unwrapped.camera
    low, high = tabletop.workspace
    for index in range(6):
        setup = make_setup(env, index)
        observation = setup.start(env)
        np.testing.assert_array_equal(tabletop.get_state(), setup.state)
        goal, tcp = setup.goal, tabletop.tcp_position
        assert np.all(goal.point_world >= low) and np.all(goal.point_world <= high)
        assert NEAREST <= setup.distance <= FARTHEST
        assert setup.distance == pytest.approx(np.linalg.norm(goal.point_world - tcp))
        np.testing.assert_allclose(goal.pixel, camera.project(camera.to_camera(goal.point_world)))
        assert setup.pixel_distance >= NEAREST_PIXELS
        u, v = np.rint(goal.pixel).astype(int)
        assert observation["depth"][v, u] > camera.to_camera(goal.point_world)[2] + CLEARANCE
        axis = camera.world_T_camera[:3, 2]
        assert setup.axis_share == pytest.approx(abs(axis @ (goal.point_world - tcp)) / setup.distance)


def test_seeds_are_out_of_reach_of_training(env):
    """Training data is seeded below 2 ** 31 (`data_collection.rollout`)."""
    assert make_setup(env, 0).env_seed >= SEED_OFFSET >= 2**31
