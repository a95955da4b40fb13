"""A controller of pictures reaches pixels, and cannot know what lies behind them."""

import dataclasses

import numpy as np
import pytest
import torch

from planning.controllers import CONTROLLERS, LEARNED, PIXEL_MODELS
from planning.controllers.pixel import PixelController
from planning.costs import Reach
from planning.icem import ICEM, ICEMConfig


def planner():
    config = ICEMConfig(population=24, elites=6, iterations=2)
    return ICEM(config, -np.ones(3), np.ones(3), np.random.default_rng(0))


def pixel_of(world):
    return world.camera.project(world.camera.to_camera(world.tcp))


def servo(controller, world, goal, steps=30):
    """Runs the controller; returns its actions and, after each, the distance in the picture."""
    observation = world.observation()
    controller.reset(observation, goal)
    actions, distances = [], []
    for _ in range(steps):
        actions.append(controller.act(observation))
        observation = world.step(actions[-1])
        distances.append(np.linalg.norm(pixel_of(world) - goal.pixel))
    return np.array(actions), np.array(distances)


def test_reaches_the_pixel_with_an_exact_model(pixel_model, camera, world, goal):
    way = np.linalg.norm(pixel_of(world) - goal.pixel)
    _, distances = servo(PixelController(pixel_model, camera, planner()), world, goal)
    assert way > 15 and (distances <= 0.1 * way).sum() >= 5 and distances[-8:].max() < 0.15 * way


def test_needs_its_model(make_pixel_model, camera, world, goal):
    """With the action's numbers mixed up before the model, the TCP misses the pixel."""
    model = make_pixel_model(camera, channels=(1, 2, 0, 3, 4, 5, 6))
    way = np.linalg.norm(pixel_of(world) - goal.pixel)
    _, distances = servo(PixelController(model, camera, planner()), world, goal)
    assert (distances <= 0.1 * way).sum() < 5


def test_does_not_know_how_far_away_the_goal_is(pixel_model, camera, world, goal):
    """Bitwise: another goal on the same ray, and a goal that is nowhere, change no action."""
    start = world.tcp.copy()
    runs = []
    for along in (0.0, 0.3, -0.2, np.nan):
        world.tcp, world.steps = start.copy(), 0
        point = goal.point_world + along * (goal.point_world - camera.world_T_camera[:3, 3])
        moved = dataclasses.replace(goal, point_world=point)
        runs.append(servo(PixelController(pixel_model, camera, planner()), world, moved, steps=12)[0])
    for other in runs[1:]:
        np.testing.assert_array_equal(runs[0], other)


def hand_of(world, *boxes):
    """Observations in which the hand shows in some boxes of pixels about the TCP's (rows, then columns, from and to)
    and nowhere else; the rest is far behind."""
    seen = world.observation

    def observation():
        now = seen()
        u, v = np.rint(pixel_of(world)).astype(int)
        hand = np.zeros_like(now["depth"], bool)
        for top, bottom, left, right in boxes:
            hand[v + top : v + bottom + 1, u + left : u + right + 1] = True
        now["depth"] = np.where(hand, now["depth"], now["depth"] + 0.5).astype(np.float32)
        return now

    return observation


def test_it_is_the_tcp_that_goes_to_the_pixel_not_the_hand(pixel_model, camera, world, goal):
    world.observation = hand_of(world, (-2, 2, -5, 0))
    _, distances = servo(PixelController(pixel_model, camera, planner()), world, goal)
    assert np.median(distances[-8:]) < 1.0  # the hand's mean is 2.5 pixels beside


def test_at_the_goal_nothing_is_better_than_to_stay_however_the_hand_is_shaped(pixel_model, camera, world, goal):
    world.observation = hand_of(world, (-2, 2, -2, -1), (0, 0, 0, 5))  # most of its pixels on one side, a thumb
    controller = PixelController(pixel_model, camera, planner())
    observation = world.observation()
    controller.reset(observation, dataclasses.replace(goal, pixel=pixel_of(world)))
    controller.act(observation)
    moves = 0.5 * np.random.default_rng(0).uniform(-1, 1, (50, 2, 3))
    moves[0] = 0
    costs = controller.imagine(observation)(moves)
    assert costs[0] < 0.01 and costs.argmin() == 0


def test_designated_are_the_pixels_of_the_hand_in_both_frames(pixel_model, camera, world, goal):
    world.observation = hand_of(world, (-2, 2, 0, 5))
    controller = PixelController(pixel_model, camera, planner())
    observation = world.observation()
    controller.reset(observation, goal)
    for _ in range(4):
        observation = world.step(controller.act(observation))
    before, now = (controller.distribution(pixels) for pixels in controller.designated)
    assert now.sum() == pytest.approx(1) and 15 <= (now > 0).sum() <= 30
    assert not torch.equal(before, now)

    # A model that copies the first frame only: its kernels move nothing, so that the hand stands still; a thing will be
    # where it was then.
    predict = pixel_model.predict

    def first_only(shift):
        prediction = predict(shift)
        masks = torch.zeros(len(shift), 4, camera.height, camera.width)
        masks[:, 3] = 1
        return dataclasses.replace(prediction, masks=masks)

    pixel_model.predict = first_only
    moves = np.random.default_rng(0).uniform(-1, 1, (5, 2, 3))
    costs = controller.imagine(controller.frames[1])(moves)
    tcp = camera.project(camera.to_camera(np.float32(controller.frames[1]["proprio"][:3])))
    np.testing.assert_allclose(costs, (1 + 0.95) * np.linalg.norm(tcp - goal.pixel), rtol=1e-4)
    controller.reach = Reach(weight=0.0, beyond=0.0)
    costs = controller.imagine(controller.frames[1])(moves)
    grid = np.stack(np.meshgrid(np.arange(64), np.arange(64)), axis=-1)
    offset = tcp - np.array((now[..., None] * torch.from_numpy(grid)).sum((0, 1)))
    distances = np.linalg.norm(grid + offset - goal.pixel, axis=-1)
    np.testing.assert_allclose(costs, (1 + 0.95) * (before.numpy() * distances).sum(), rtol=1e-4)


def test_a_hand_lost_from_the_picture_costs_infinitely(pixel_model, camera, world, goal):
    """A future without a place must not look like a good one."""
    controller = PixelController(pixel_model, camera, planner())
    observation = world.observation()
    controller.reset(observation, goal)
    controller.act(observation)
    predict = pixel_model.predict
    pixel_model.predict = lambda shift: dataclasses.replace(predict(shift), masks=torch.zeros(len(shift), 3, 64, 64))
    costs = controller.imagine(observation)(np.zeros((3, 2, 3)))
    assert not np.isfinite(costs).any()


def test_all_pixel_models_have_a_controller():
    assert set(PIXEL_MODELS) == {"sv2p", "sna", "cdna"} and set(LEARNED) <= set(CONTROLLERS)
