"""A point on a thing is servoed like the hand's: followed by its looks, moved by what the model says of its pixels."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.nn.functional import pad

from envs.camera import CameraModel
from envs.errors import UsageError
from planning.controllers.baselines import LinearController, ProportionalController
from planning.controllers.pixel import PixelController
from planning.controllers.t3vip import T3VIPController
from planning.costs import Reach
from planning.effectors import Tip
from planning.followers import EffectorFollower, Surface, SurfaceFollower
from planning.goals import Goal
from planning.icem import ICEM, ICEMConfig
from planning.point_tracker import PointTracker

HEIGHT, HALF = 0.04, 0.06  # m, of a square block on the table
SURFACE = Surface(extent=0.08, step=0.01, colour=1.0, radius=0.03)
POINT = np.array([0.02, 0.03, HEIGHT])  # on the block, which starts in the middle


class SlidingWorld:
    """A chequered block on a table, seen from 1 m above; as long as `glued`, it goes wherever the tip goes."""

    def __init__(self, glued: bool = True) -> None:
        pose = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]])
        self.camera = CameraModel.from_fovy(64, 64, 33.0, pose, 0.35, 1.2)
        self.glued, self.tip, self.pose, self.hidden = (
            glued,
            np.array([0.1, 0.0]),
            np.zeros(3),
            np.zeros((64, 64), bool),
        )

    def local(self, points: np.ndarray) -> np.ndarray:
        cos, sin = np.cos(self.pose[2]), np.sin(self.pose[2])
        return (points - self.pose[:2]) @ np.array([[cos, -sin], [sin, cos]])

    def point(self) -> np.ndarray:
        cos, sin = np.cos(self.pose[2]), np.sin(self.pose[2])
        return np.append(self.pose[:2] + np.array([[cos, -sin], [sin, cos]]) @ POINT[:2], HEIGHT)

    def observation(self) -> dict[str, np.ndarray]:
        """Four samples a pixel, so that edges are soft."""
        rgb, depth = np.zeros((64, 64, 3)), np.ones((64, 64), np.float32)
        for shift in np.array([[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]]):
            rays = (self.camera.pixels() + shift - 31.5) / self.camera.K[0, 0] * [1, -1]
            places = self.local(rays * (1 - HEIGHT))
            on = (np.abs(places) < HALF).all(-1)
            dark = (np.floor(places / 0.03).sum(-1) % 2 == 0) ^ (places[..., 0] > 0.03)
            rgb += np.where(on[..., None], np.where(dark[..., None], [0.2, 0.2, 0.6], [0.9, 0.8, 0.2]), 0.7) / 4
            depth[on] = 1 - HEIGHT
        rgb[self.hidden], depth[self.hidden] = [0.6, 0.1, 0.1], 0.85
        proprio = np.append(self.tip, 0.0).astype(np.float32)
        return {"rgb": (255 * rgb).astype(np.uint8), "depth": depth, "proprio": proprio}

    def step(self, action: np.ndarray) -> dict[str, np.ndarray]:
        assert action.shape == (3,) and np.abs(action[:2]).max() <= Tip.limit + 1e-6
        self.tip = self.tip + 0.025 * action[:2]
        if self.glued:
            self.pose[:2] += 0.025 * action[:2]
        return self.observation()


@pytest.fixture
def block() -> SlidingWorld:
    return SlidingWorld()


@pytest.fixture
def far(block) -> Goal:
    end = POINT + np.array([-0.07, 0.05, 0])
    return Goal(end, block.camera.project(block.camera.to_camera(end)), POINT)


def taught(model, camera, channels=(0, 1, 2)):
    """One of the exact models, of moves of the tip; `channels` spoil it."""
    rotation = torch.tensor(camera.world_T_camera[:3, :3].tolist())
    model.context = SimpleNamespace(
        action_aggregation=("sum", "sum", "last"), action_scale=(0.025, 0.025, np.pi), frame_gap=3
    )
    model.frame_gap = 3
    model.shift = lambda action: pad(0.025 * action[:, channels][:, :2], (0, 1)) @ rotation
    return model


def planner(axes=2):
    config = ICEMConfig(horizon=3, population=24, elites=6, iterations=2)
    return ICEM(config, -np.full(axes, Tip.limit), np.full(axes, Tip.limit), np.random.default_rng(0))


def parts(world):
    return {"effector": Tip(), "follower": SurfaceFollower(world.camera, SURFACE)}


def servo(controller, world, goal, steps=24):
    """How far the point is from the goal after each step."""
    observation = world.observation()
    controller.reset(observation, goal)
    distances = []
    for _ in range(steps):
        observation = world.step(controller.act(observation))
        distances.append(np.linalg.norm(world.point() - goal.point_world))
    return np.array(distances)


def test_a_point_is_followed_through_turns_and_behind_things(block):
    observation = block.observation()
    tracker = PointTracker(block.camera, SURFACE.extent, SURFACE.step)
    tracker.reset(observation["rgb"], observation["depth"], POINT)
    errors = []
    for step in range(30):
        block.pose += [0.004, -0.002, 0.05 if step < 15 else 0.0]
        if step == 8:
            block.pose += [0.02, 0.01, 0.5]  # all at once
        block.hidden[20:34, 28:36] = 12 <= step < 20  # a third of the block
        observation = block.observation()
        tracker.update(observation["rgb"], observation["depth"])
        errors.append(np.linalg.norm(tracker.point - block.point()))
    assert np.linalg.norm(block.point() - POINT) > 0.1
    assert max(errors) < 0.005 and np.mean(errors) < 0.002
    near = tracker.around(0.03)
    assert len(near) > 10 and np.linalg.norm(near - block.point(), axis=-1).max() < 0.035


def test_t3vip_brings_a_point_of_a_thing_to_its_goal_and_it_is_the_model_that_does(block, far, make_exact_model):
    model = taught(make_exact_model(block.camera, action_dim=3), block.camera)
    distances = servo(T3VIPController(model, block.camera, planner(), **parts(block)), block, far)
    assert distances[0] > 0.06 and distances[-5:].max() < 0.01

    other = SlidingWorld()
    spoiled = taught(make_exact_model(block.camera, action_dim=3), block.camera, channels=(1, 0, 2))
    assert servo(T3VIPController(spoiled, block.camera, planner(), **parts(other)), other, far).min() > 0.02


def test_a_model_of_pictures_brings_it_to_the_pixel(block, far, make_pixel_model):
    model = taught(make_pixel_model(block.camera, action_dim=3), block.camera)
    shift = model.shift
    model.shift = lambda action: 4.2 * shift(action)  # it divides by the distance of another camera; here it is 1 m
    withheld = replace(far, point_world=far.point_world * np.nan)
    controller = PixelController(model, block.camera, planner(), **parts(block))
    controller.reset(block.observation(), withheld)
    np.testing.assert_allclose(controller.way(), far.point_world - POINT, atol=1e-3)  # a thing stays on the table
    servo(controller, block, withheld)
    pixel = block.camera.project(block.camera.to_camera(block.point()))
    assert np.linalg.norm(pixel - far.pixel) < 1.0


def test_what_is_not_touched_is_reached_for(far, make_exact_model):
    """Nothing moves in what this model predicts: only where the tip can push from tells plans apart."""
    way = (far.point_world - POINT)[:2]
    behind = POINT[:2] - 0.08 * way / (np.linalg.norm(way) + 0.02)
    left = []
    for reach in (None, Reach(0.1, 0.08)):
        world = SlidingWorld(glued=False)
        world.tip = np.array([-0.08, 0.0])
        model = taught(make_exact_model(world.camera, action_dim=3), world.camera)
        model.shift = lambda action: torch.zeros(len(action), 3)
        servo(T3VIPController(model, world.camera, planner(), reach=reach, **parts(world)), world, far, steps=21)
        left.append(np.linalg.norm(world.tip - behind))
    assert left[1] < 0.02 < left[0]


def test_reaching_is_for_the_far_side():
    reach, goal = Reach(0.5, beyond=0.1, fade=0.02), np.zeros(2)
    points = np.array([[0.08, 0.0], [0.08, 0.0], [0.02, 0.0], [0.0, 0.0]])
    effectors = np.array([[0.16, 0.0], [0.0, 0.0], [0.07, 0.04], [0.3, 0.4]])
    costs = [0.0, 0.5 * 0.8 * 0.16, 0.5 * 0.5 * 0.04, 0.0]  # half as much 2 cm from the goal, nothing at it
    np.testing.assert_allclose(reach.cost(effectors, points, goal), costs, atol=1e-12)
    pixels = reach.cost(torch.as_tensor(50 * effectors), torch.as_tensor(50 * points), torch.zeros(2), per_metre=50)
    np.testing.assert_allclose(pixels, 50 * np.array(costs), atol=1e-12)


def test_without_a_model_a_thing_moves_only_if_it_is_glued(block, far):
    assert servo(ProportionalController(**parts(block)), block, far)[-1] < 0.003
    assert servo(LinearController(planner=planner(), hold=3, **parts(block)), SlidingWorld(), far, 36)[-1] < 0.02
    loose = SlidingWorld(glued=False)
    assert servo(ProportionalController(**parts(loose)), loose, far).min() > 0.08


def test_whose_point_is_meant_must_be_said(block, far):
    with pytest.raises(UsageError, match="designated"):
        ProportionalController(Tip(), EffectorFollower(Tip())).reset(block.observation(), far)
    with pytest.raises(UsageError, match="designated"):
        ProportionalController(**parts(block)).reset(block.observation(), replace(far, designated=None))
