"""Controllers in a world of arrays: they get observations, the camera's geometry and the goal, nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from envs.errors import UsageError
from planning.controllers.base import HoldingController, PlanningController
from planning.controllers.baselines import LinearController, ProportionalController, RandomController
from planning.controllers.pixel import PixelController
from planning.controllers.t3vip import T3VIPController
from planning.costs import Reach
from planning.effectors import Arm, Effector, Tip
from planning.icem import ICEM, ICEMConfig


def planner(seed=0, **options):
    return ICEM(ICEMConfig(**{"horizon": 4, **options}), -np.ones(3), np.ones(3), np.random.default_rng(seed))


def servo(controller, world, goal, steps=60):
    observation = world.observation()
    controller.reset(observation, goal)
    distances = []
    for _ in range(steps):
        observation = world.step(controller.act(observation))
        distances.append(np.linalg.norm(world.tcp - goal.point_world))
    return np.array(distances)


def test_t3vip_arrives_with_an_exact_model(exact_model, camera, world, goal):
    controller = T3VIPController(exact_model, camera, planner())
    distances = servo(controller, world, goal)
    assert (distances <= 0.1 * 0.27).sum() >= 5 and distances[-1] < 0.03
    assert len(controller.plan_seconds) == 20  # once per frame gap


def test_t3vip_needs_its_model(make_exact_model, camera, world, goal):
    """With the action's numbers mixed up before the model, the arm gets nowhere."""
    model = make_exact_model(camera, channels=(1, 2, 0, 3, 4, 5, 6))
    distances = servo(T3VIPController(model, camera, planner()), world, goal)
    assert distances.min() > 0.1 * 0.27


@pytest.mark.parametrize("context", [1, 2, 3])
def test_the_model_sees_frames_a_gap_apart_with_the_actions_between(exact_model, camera, world, goal, context):
    executed = []
    controller = T3VIPController(exact_model, camera, planner(), context_frames=context)
    observation = world.observation()
    controller.reset(observation, goal)
    for _ in range(10):
        action = controller.act(observation)
        executed.append(action)
        observation = world.step(action)
    assert len(exact_model.shown) == 4
    for plan, (rgb, depth, actions) in enumerate(exact_model.shown):
        frames = [max(0, 3 * (plan - back)) for back in reversed(range(context))]  # the world counts steps in grey
        np.testing.assert_allclose(255 * rgb[0, :, 0, 0, 0], frames, atol=1e-4)
        assert rgb.shape == (1, context, 3, 64, 64) and depth.shape == (1, context, 1, 64, 64)
        for back in range(context - 1):
            first = 3 * (plan - back - 1)
            total = np.sum(executed[first : first + 3], axis=0) if first >= 0 else np.zeros(7)
            total[6] = -1
            np.testing.assert_allclose(actions[0, context - 2 - back], total, atol=1e-6)


def test_planned_actions_are_translations_held_for_the_gap(exact_model, camera, world, goal):
    controller = T3VIPController(exact_model, camera, planner())
    servo(controller, world, goal, steps=1)
    assert [len(action) for action in exact_model.asked] == [40] * 4 + [32] * 4 + [25] * 4
    for action in exact_model.asked:
        assert (action[:, 3:6] == 0).all() and (action[:, 6] == -1).all()
        assert 1 < action[:, :3].abs().max() <= 3 + 1e-6


def test_model_rollouts_keep_no_gradient(exact_model, camera, world, goal):
    servo(T3VIPController(exact_model, camera, planner()), world, goal, steps=1)
    assert all(not action.requires_grad for action in exact_model.asked)


def test_proportional_arrives_and_holds_the_gripper(world, goal):
    distances = servo(ProportionalController(), world, goal)
    assert distances[-1] < 1e-3
    controller = ProportionalController()
    controller.reset(world.observation(), goal)
    assert controller.act(world.observation())[6] == -1


def test_linear_learns_the_arm_within_the_episode(world, goal):
    """Whatever the axes: here they are turned and unequal, which the controller cannot know."""
    mixed = np.array([[0, 0.8, 0], [-0.7, 0, 0.2], [0, 0, 0.9]])
    straight = world.step

    def step(action):
        return straight(np.concatenate([mixed @ action[:3], action[3:]]).astype(np.float32))

    world.step = step
    distances = servo(LinearController(planner(), hold=3), world, goal, steps=100)
    assert distances[-10:].mean() < 0.03


def test_random_is_uniform_and_held(world, goal):
    controller = RandomController(3, np.random.default_rng(0))
    observation = world.observation()
    controller.reset(observation, goal)
    actions = np.array([controller.act(observation) for _ in range(900)])
    np.testing.assert_array_equal(actions[0::3], actions[2::3])
    assert np.abs(actions[:, :3].mean()) < 0.05 and actions[:, :3].std() == pytest.approx(1 / np.sqrt(3), abs=0.03)


@pytest.mark.parametrize("bounds", [np.ones(7), np.ones(2), np.full(3, 1.5)])
def test_a_planner_searches_moves_of_the_effector(bounds):
    search = ICEM(ICEMConfig(), -bounds, bounds, np.random.default_rng(0))
    with pytest.raises(UsageError, match=r"a move of the Arm is 3 numbers from -1.0 to 1.0; give such"):
        LinearController(search, hold=3)


def test_a_model_of_another_kind_is_refused(exact_model, pixel_model, camera):
    with pytest.raises(UsageError, match="the model is a sv2p, but T3VIPController plans with t3vip;"):
        T3VIPController(pixel_model, camera, planner())
    with pytest.raises(UsageError, match="the model is a t3vip, but PixelController plans with sv2p or"):
        PixelController(exact_model, camera, planner())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda camera: {"K": camera.K * [[1.5], [1.5], [1]]}, "intrinsics"),
        (lambda camera: {"far": 2 * camera.far}, r"depth range \(3.5, 11.0\), not \(3.5, 5.5\)"),
        (lambda camera: {"width": 128, "height": 128}, r"image size \(128, 128\), not \(64, 64\)"),
    ],
)
def test_a_camera_that_the_model_does_not_know_is_refused(exact_model, camera, change, words):
    with pytest.raises(UsageError, match=f"the camera has {words}.*; give"):
        T3VIPController(exact_model, replace(camera, **change(camera)), planner())


def test_a_camera_may_stand_elsewhere(exact_model, camera):
    T3VIPController(exact_model, replace(camera, world_T_camera=np.eye(4)), planner())


def test_a_model_of_other_actions_than_the_effectors_is_refused(exact_model, camera):
    search = ICEM(ICEMConfig(), -0.5 * np.ones(2), 0.5 * np.ones(2), np.random.default_rng(0))
    with pytest.raises(UsageError, match="from actions of 7 numbers, those of the Tip have 3; give the effector of"):
        T3VIPController(exact_model, camera, search, effector=Tip())
    exact_model.context.action_aggregation = ("sum",) * 7
    with pytest.raises(UsageError, match=r"actions that add up as \('sum'.*, those of the Arm as .*'rotate'"):
        T3VIPController(exact_model, camera, planner())
    exact_model.context.action_aggregation = Arm.aggregation
    exact_model.context.action_scale = (0.01,) * 7
    with pytest.raises(UsageError, match=r"actions in units of \(0.01, .*, those of the Arm are in \(0.02,"):
        T3VIPController(exact_model, camera, planner())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda o: {"rgb": o["rgb"] / np.float32(255)}, r"\['rgb'\] is float32; give uint8 colours of 0 to 255"),
        (lambda o: {"rgb": np.zeros((64, 64, 4), np.uint8)}, r"\['rgb'\] has shape \(64, 64, 4\); give \(64, 64, 3\)"),
        (lambda o: {"depth": o["depth"][:48]}, r"\['depth'\] has shape \(48, 64\); give \(64, 64\)"),
        (lambda o: {"depth": np.where(np.eye(64) > 0, np.nan, o["depth"])}, "depth has NaN in 64 of 4096 pixels; fill"),
        (lambda o: {"depth": (1000 * o["depth"]).astype(np.uint16)}, "depth is uint16; give metres as floats"),
        (lambda o: {"depth": 1000 * o["depth"]}, "most of the depth is about .*; give metres"),
        (lambda o: {"proprio": o["proprio"] * np.nan}, r"\['proprio'\] is \[nan.*; give finite numbers"),
        (
            lambda o: {"proprio": o["proprio"][:2]},
            r"proprio has shape \(2,\), that of the tabletop's Arm \(15,\); give",
        ),
    ],
)
def test_a_model_is_shown_only_what_it_learned_from(exact_model, camera, world, goal, change, words):
    controller = T3VIPController(exact_model, camera, planner())
    observation = world.observation()
    with pytest.raises(UsageError, match=words):
        controller.reset(observation | change(observation), goal)
    if "Arm" not in words:  # it reads its numbers at the start
        controller.reset(observation, goal)
        with pytest.raises(UsageError, match=words):
            controller.act(observation | change(observation))
    with pytest.raises(UsageError, match="the observation has no 'depth', only rgb, proprio; give"):
        controller.reset({name: value for name, value in observation.items() if name != "depth"}, goal)


def test_frames_are_clipped_to_the_cameras_range_and_kept_as_they_were(exact_model, camera, world, goal):
    controller = T3VIPController(exact_model, camera, planner(), context_frames=2)
    buffers = world.observation()
    buffers["depth"][0, :2] = [np.inf, 0.0]
    controller.reset(buffers, goal)
    for step in range(4):  # the driver writes each frame where the last one is
        controller.act(buffers)
        buffers["rgb"][:] = step + 1
    rgb, depth, _ = exact_model.shown[-1]
    np.testing.assert_allclose(255 * rgb[0, :, 0, 0, 0], [0, 3], atol=1e-4)
    np.testing.assert_allclose(depth[0, :, 0, 0, :2], [[camera.far, camera.near]] * 2)


def test_the_action_that_is_held_is_the_controllers_own(exact_model, camera, world, goal):
    controller = T3VIPController(exact_model, camera, planner())
    controller.reset(world.observation(), goal)
    first = controller.act(world.observation())
    sent = first.copy()
    first *= 0.1  # to the units of some robot
    np.testing.assert_array_equal(controller.act(world.observation()), sent)


class Joints(Effector):
    """Six numbers that go nowhere in particular; an action is a move and a zero."""

    axes, action_dim, limit = 6, 7, 1.0

    def position(self, observation):
        return observation["proprio"][:3]

    def action(self, move):
        return np.concatenate([move, np.zeros((*np.shape(move)[:-1], 1))], axis=-1).astype(np.float32)


def test_a_model_plans_moves_of_any_kind(exact_model, pixel_model, camera, world, goal):
    search = ICEM(ICEMConfig(), -np.ones(6), np.ones(6), np.random.default_rng(0))
    far = np.linalg.norm(goal.pixel - camera.project(camera.to_camera(world.tcp)))
    servo(PixelController(pixel_model, camera, search, effector=Joints()), world, goal)
    assert np.linalg.norm(goal.pixel - camera.project(camera.to_camera(world.tcp))) < 0.2 * far
    assert servo(T3VIPController(exact_model, camera, search, effector=Joints()), world, goal)[-1] < 0.03
    for refused in (
        lambda: ProportionalController(Joints()),
        lambda: LinearController(search, 3, Joints()),
        lambda: T3VIPController(exact_model, camera, search, effector=Joints(), reach=Reach(0.5, 0.1)),
    ):
        with pytest.raises(UsageError, match="a move of the Joints is 6 numbers, not along x and y"):
            refused()


def test_an_effector_makes_an_action_of_each_move(exact_model, camera, world, goal):
    class Single(Joints):
        def action(self, move):
            return np.zeros(7, np.float32)

    search = ICEM(ICEMConfig(), -np.ones(6), np.ones(6), np.random.default_rng(0))
    controller = T3VIPController(exact_model, camera, search, effector=Single())
    with pytest.raises(
        UsageError, match=r"Single.action makes actions \(7,\) of moves \(2, 4, 6\); make it \(2, 4, 7\)"
    ):
        controller.reset(world.observation(), goal)


def test_a_goal_must_be_a_place_that_the_controller_can_know(exact_model, pixel_model, camera, world, goal):
    nowhere, unseen = replace(goal, point_world=np.full(3, np.nan)), replace(goal, pixel=np.array([np.inf, 3.0]))
    spatial = T3VIPController(exact_model, camera, planner())
    with pytest.raises(UsageError, match=r"the goal's point_world is \[nan, nan, nan\]; give 3 finite numbers"):
        spatial.reset(world.observation(), nowhere)
    with pytest.raises(UsageError, match=r"the goal's point_world is \[0.0, 0.0\]; give 3 finite numbers"):
        spatial.reset(world.observation(), replace(goal, point_world=np.zeros(2)))
    spatial.reset(world.observation(), unseen)
    flat = PixelController(pixel_model, camera, planner())
    with pytest.raises(UsageError, match=r"the goal's pixel is \[inf, 3.0\]"):
        flat.reset(world.observation(), unseen)
    flat.reset(world.observation(), nowhere)


@pytest.mark.parametrize("frames", [0, -1])
def test_a_model_is_shown_a_frame_at_least(exact_model, camera, frames):
    with pytest.raises(UsageError, match=f"context_frames is {frames}; show the model 1 frame or more"):
        T3VIPController(exact_model, camera, planner(), context_frames=frames)


def test_an_episode_begins_with_reset(world):
    with pytest.raises(UsageError, match=r"act\(\) before reset\(\).*call reset first"):
        ProportionalController().act(world.observation())


def test_holding_is_an_interface():
    with pytest.raises(NotImplementedError):
        HoldingController(3).decide({})


def test_plans_without_a_finite_cost_are_told(world, goal):
    class Blind(PlanningController):
        def imagine(self, observation):
            return lambda moves: np.full(len(moves), np.nan)

    controller = Blind(planner(), hold=3)
    controller.reset(world.observation(), goal)
    with pytest.warns(RuntimeWarning, match="Blind found no move of finite cost"):
        action = controller.act(world.observation())
    np.testing.assert_array_equal(action, [0, 0, 0, 0, 0, 0, -1])  # it stands still
