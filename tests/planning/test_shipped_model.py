"""The shipped model servoes on the unseen table, and it is the model that does it."""

from __future__ import annotations

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch

from planning.controllers.base import Goal
from planning.controllers.t3vip import T3VIPController
from planning.costs import env_action
from planning.episode import run_episode
from planning.icem import ICEM
from planning.setups import CLEARANCE, make_setup
from planning.tasks import TASKS
from worldmodel import load_model

SETUPS = (0, 1, 2)
STEPS = 24  # twice what the model needs to be there
NEAR = 0.1  # of the initial distance


class Shuffled(torch.nn.Module):
    """The shipped model with the action's translation channels exchanged before it sees them."""

    def __init__(self, model) -> None:
        super().__init__()
        self.model = model
        self.kind, self.camera, self.context = model.kind, model.camera, model.context
        self.frame_gap, self.action_dim = model.frame_gap, model.action_dim

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
    """The usual search with fewer sequences, 40 a plan: what suffices for them is the model's doing."""
    config = replace(TASKS["tabletop", "hand"].planner, population=20, iterations=2)
    return ICEM(config, -np.ones(3), np.ones(3), np.random.default_rng(0))


def left(env, controller, index: int) -> float:
    """Least share of the way that was left at any time of a servo episode."""
    record = run_episode(env, make_setup(env, index, seed=99), "any", controller, steps=STEPS)
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


class Witness:
    """Keeps what it is shown, and stands still."""

    def __init__(self) -> None:
        self.plan_seconds = [0.0]
        self.shown: list[dict] = []

    def reset(self, observation, goal) -> None:
        pass

    def act(self, observation):
        self.shown.append(observation)
        return env_action(np.zeros(3), observation["proprio"][-1])


def test_neither_pictures_nor_scene_show_the_goal(env):
    camera, data = env.unwrapped.camera, env.unwrapped.mj_data
    setup, witnesses = make_setup(env, 0, seed=99), []
    for shift in (0.0, -0.05):
        point = setup.goal.point_world + shift
        goal = Goal(point, camera.project(camera.to_camera(point)))
        witnesses.append(Witness())
        run_episode(env, replace(setup, goal=goal), "witness", witnesses[-1], steps=3)
        things = np.concatenate([data.xpos, data.geom_xpos, data.site_xpos, data.light_xpos])
        assert np.linalg.norm(things - point, axis=1).min() > CLEARANCE
    for one, other in zip(*(witness.shown for witness in witnesses), strict=True):
        assert one.keys() == other.keys() == env.observation_space.spaces.keys()
        assert all(np.array_equal(one[key], other[key]) for key in one)
