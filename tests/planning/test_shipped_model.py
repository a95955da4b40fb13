"""The shipped model servoes on the unseen table, and it is the model that does it."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch

from planning.controllers.base import Goal
from planning.controllers.t3vip import T3VIPController
from planning.episode import run_episode
from planning.icem import ICEM, ICEMConfig
from planning.setups import make_setup
from worldmodel import load_model

SETUPS = (0, 1, 2)
NEAR = 0.1  # of the initial distance


class Shuffled(torch.nn.Module):
    """The shipped model with the action's translation channels exchanged before it sees them."""

    def __init__(self, model) -> None:
        super().__init__()
        self.model = model
        self.frame_gap, self.action_dim, self.context = model.frame_gap, model.action_dim, model.context

    def observe(self, rgb, depth, actions):
        return self.model.observe(rgb, depth, self.exchanged(actions))

    def step(self, state, action, **options):
        return self.model.step(state, self.exchanged(action), **options)

    @staticmethod
    def exchanged(actions):
        return torch.cat((actions[..., [1, 2, 0]], actions[..., 3:]), dim=-1)


class ElsewhereController(T3VIPController):
    """Sees the pictures of another episode; everything else is as it should be."""

    def __init__(self, frame, *parts) -> None:
        super().__init__(*parts)
        self.frame = frame

    def act(self, observation):
        return super().act({**observation, **self.frame})


@pytest.fixture(scope="module")
def env():
    env = gym.make("envs:t3vip/TabletopD-v0", max_episode_steps=-1, disable_env_checker=True)
    yield env
    env.close()


@pytest.fixture(scope="module")
def model():
    return load_model("t3vip")


def planner() -> ICEM:
    return ICEM(ICEMConfig(), -np.ones(3), np.ones(3), np.random.default_rng(0))


def left(env, controller, index: int) -> float:
    """Least share of the way that was left at any time of a servo episode."""
    record = run_episode(env, make_setup(env, index, seed=99), controller, steps=60)
    return record.least_distance / record.initial_distance


def test_reaches_3d_goals_on_the_unseen_table(env, model):
    shares = [left(env, T3VIPController(model, env.unwrapped.camera, planner()), i) for i in SETUPS]
    assert sum(share < NEAR for share in shares) >= len(SETUPS) - 1, shares


def test_fails_when_the_model_sees_another_episode(env, model):
    observation, _ = env.reset(seed=12345)
    frame = {"rgb": observation["rgb"], "depth": observation["depth"]}
    camera = env.unwrapped.camera
    shares = [left(env, ElsewhereController(frame, model, camera, planner()), i) for i in SETUPS]
    assert sum(share < NEAR for share in shares) <= 1, shares


def test_fails_when_action_channels_are_shuffled_before_the_model(env, model):
    camera = env.unwrapped.camera
    shares = [left(env, T3VIPController(Shuffled(model), camera, planner()), i) for i in SETUPS]
    assert sum(share < NEAR for share in shares) <= 1, shares


def test_pictures_do_not_show_the_goal(env):
    setup = make_setup(env, 0, seed=99)
    first = setup.start(env)
    other = Goal(setup.goal.point_world + 0.1, setup.goal.pixel + 5)
    controller = T3VIPController(load_model("t3vip"), env.unwrapped.camera, planner())
    controller.reset(first, other)
    again = setup.start(env)
    assert np.array_equal(first["rgb"], again["rgb"]) and np.array_equal(first["depth"], again["depth"])
