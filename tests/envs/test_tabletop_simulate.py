"""What-if on the play table: many futures at once, and where the hand is in each."""

from __future__ import annotations

import numpy as np
import pytest

from envs.tabletop import TabletopEnv
from envs.tabletop.env import FIXTURES
from envs.tabletop.simulate import BatchSimulator


@pytest.fixture(scope="module")
def blind_c():
    env = TabletopEnv("C", images=False)
    yield env
    env.close()


def test_batch_simulation_is_what_the_environment_does(blind_c):
    blind_c.reset(seed=4, options={"tcp": [0.0, -0.1, 0.5]})
    rng = np.random.default_rng(0)
    actions = np.clip(rng.normal(0, 0.7, (3, 8, 7)) - [0, 0, 0.3, 0, 0, 0, 0], -1, 1)  # down on blocks and table
    blind_c.mj_data.joint("door").qvel[0] = 0.2  # m/s: a fixture that moves
    state = blind_c.get_state()
    simulator = BatchSimulator(blind_c, threads=2)
    paths = simulator.rollout(state, actions)
    simulator.close()
    np.testing.assert_array_equal(blind_c.get_state(), state)
    assert np.ptp(paths.fixtures[0, :, FIXTURES.index("door")]) > 1e-3
    for sequence, places, fixtures in zip(actions, paths.tcp, paths.fixtures, strict=True):
        blind_c.set_state(state)
        for action, place, fixture in zip(sequence, places, fixtures, strict=True):
            blind_c.step(action)
            np.testing.assert_allclose(blind_c.tcp_position, place, atol=1e-6)
            np.testing.assert_allclose(blind_c.scene_obs()[:4], fixture, atol=1e-6)


def test_forward_kinematics_agree_with_mujoco(blind_c):
    blind_c.reset(seed=1)
    pose = blind_c.kinematics.tcp(blind_c.mj_data.qpos[blind_c.kinematics.qpos_index])
    np.testing.assert_allclose(pose.position, blind_c.tcp_position, atol=1e-9)
    np.testing.assert_allclose(abs(pose.quaternion @ blind_c.tcp_pose.quaternion), 1, atol=1e-9)
