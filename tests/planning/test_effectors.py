"""Moves as actions of the environments, where they lead, and what they cost: by numbers that can be checked by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from envs.camera import CameraModel
from planning.costs import discounted_distance
from planning.effectors import Arm, Tip
from planning.followers import Surface, SurfaceFollower


def at(*position, gripper=0.0):
    return {"proprio": np.array([*position, *np.zeros(14 - len(position)), gripper], np.float32)}


def test_the_tip_heads_where_the_point_has_to_go():
    tip = Tip()
    tip.aim(np.array([0.0, -0.3, 0.1]))
    moves = np.array([[0.1, 0.2], [0.5, -0.5]])
    expected = [[0.1, 0.2, -0.5], [0.5, -0.5, -0.5]]  # a quarter turn to the right, in half turns
    np.testing.assert_allclose(tip.action(moves), expected, rtol=1e-6)


@pytest.mark.parametrize(("before", "held"), [(1.0, 1.0), (0.0, 1.0), (-1.0, -1.0)])
def test_the_arm_keeps_its_gripper_and_turns_nothing(before, held):
    arm = Arm()
    arm.reset(at(0.0, -0.1, 0.5, gripper=before))
    np.testing.assert_array_equal(arm.action(np.array([1.0, -1.0, 0.5])), [1, -1, 0.5, 0, 0, 0, held])


def test_a_path_adds_moves_up_and_ends_at_the_walls_of_the_box():
    moves = np.array([[[1.0, 0.0, -0.5], [1.0, 0.5, 0.0]]])
    path = Arm().path(at(0.1, -0.1, 0.5), moves, hold=3)
    np.testing.assert_allclose(path, [[[0.16, -0.1, 0.47], [0.22, -0.07, 0.47]]], atol=1e-6)
    far = Tip().path(at(0.2, 0.0), np.array([[[0.5, 0.0], [0.5, -0.5]]]), hold=2)
    np.testing.assert_allclose(far[..., :2], [[[0.225, 0.0], [0.24, -0.025]]], atol=1e-6)


def test_a_thing_at_the_edge_of_a_wide_picture_has_its_pixels_in_it():
    camera = CameraModel.from_fovy(20, 10, 40.0, np.eye(4), 0.5, 2.0)
    follower = SurfaceFollower(camera, Surface(0.1, 0.01, 1.0, 0.03))
    u, v = np.array([3, 18, 18, 22]), np.array([4, 7, 7, -2])  # one twice, one beyond the corner
    rays = np.column_stack([(u - 9.5) / camera.K[0, 0], (v - 4.5) / camera.K[1, 1], np.ones(4)])
    follower.tracker = SimpleNamespace(around=lambda radius: camera.to_world(rays))
    assert follower.pixels({}, camera).tolist() == [19, 4 * 20 + 3, 7 * 20 + 18]


def test_later_distances_count_less():
    assert discounted_distance(np.array([[1.0, 2.0, 4.0], [4.0, 2.0, 1.0]]), 0.5).tolist() == [3.0, 5.25]
