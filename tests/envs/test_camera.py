"""The pinhole camera: conventions, round trips, and what it refuses."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from envs.camera import CameraModel
from envs.errors import UsageError


def make_camera(width=64, height=48, fovy=40.0, pose=None, near=0.5, far=6.0):
    return CameraModel.from_fovy(width, height, fovy, np.eye(4) if pose is None else pose, near, far)


def some_pose(seed):
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    pose[:3, 3] = rng.uniform(-3, 3, 3)
    return pose


def test_conventions_of_the_camera_frame():
    camera = make_camera(width=101, height=51, fovy=90.0)
    assert camera.K[0, 0] == camera.K[1, 1] == pytest.approx(25.5)
    np.testing.assert_array_equal(camera.K[:2, 2], [50, 25])
    points = camera.unproject(np.full((51, 101), 2.0))
    np.testing.assert_allclose(points[25, 50], [0, 0, 2])
    # the upper left pixel centre is half a pixel inside of the 45 degree edge of the field of view
    np.testing.assert_allclose(points[0, 0], [-2 * 50 / 25.5, -2 * 25 / 25.5, 2])
    assert (points[..., 2] == 2).all()


def test_edges_of_the_field_of_view_are_half_a_pixel_outside_of_the_last_centres():
    camera = make_camera(width=64, height=64, fovy=10.0)
    top = [0, -np.tan(np.radians(5)), 1]
    np.testing.assert_allclose(camera.project(top), [31.5, -0.5], atol=1e-9)


@given(
    st.integers(1, 40),
    st.integers(1, 40),
    st.floats(2.0, 150.0),
    st.floats(0.05, 50.0),
    st.integers(0, 2**32 - 1),
)
def test_projecting_what_was_unprojected_gives_the_pixel(width, height, fovy, scale, seed):
    camera = make_camera(width, height, fovy)
    depth = scale * np.random.default_rng(seed).uniform(0.5, 1.0, (2, height, width))
    points = camera.unproject(depth)
    assert points.shape == (2, height, width, 3)
    np.testing.assert_allclose(
        camera.project(points), np.broadcast_to(camera.pixels(), (2, height, width, 2)), atol=1e-6
    )


@given(st.integers(0, 2**32 - 1))
def test_world_and_camera_frames_are_inverse(seed):
    camera = make_camera(pose=some_pose(seed))
    points = np.random.default_rng(seed).normal(size=(4, 5, 3))
    np.testing.assert_allclose(camera.to_camera(camera.to_world(points)), points, atol=1e-9)
    homogeneous = np.append(points[1, 2], 1.0)
    np.testing.assert_allclose(camera.to_world(points)[1, 2], (camera.world_T_camera @ homogeneous)[:3], atol=1e-9)


def test_points_behind_the_camera_project_to_nan():
    assert np.isnan(make_camera().project([[0.1, 0.1, -1.0], [0.0, 0.0, 0.0], [0.1, -0.1, 0.0]])).all()


def test_json_is_exact():
    camera = make_camera(pose=some_pose(3), near=0.1, far=1 / 3)
    back = CameraModel.from_json(camera.to_json())
    assert (back.width, back.height, back.near, back.far) == (64, 48, 0.1, 1 / 3)
    assert np.array_equal(back.K, camera.K) and np.array_equal(back.world_T_camera, camera.world_T_camera)
    assert CameraModel.from_dict(camera.to_dict()).to_dict() == back.to_dict() == json.loads(camera.to_json())


def test_matrices_are_read_only_copies():
    pose = np.eye(4)
    camera = make_camera(pose=pose)
    pose[0, 3] = 7.0
    assert camera.world_T_camera[0, 3] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        camera.K[0, 0] = 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "width is 0"),
        ({"height": 2.5}, "height is 2.5"),
        ({"near": -1.0}, "near=-1.0"),
        ({"far": 0.2}, "far=0.2"),
        ({"far": float("nan")}, "far=nan"),
        ({"K": np.zeros((3, 3))}, "positive fx"),
        ({"K": np.array([[9.0, 0.5, 3.5], [0, 9, 3.5], [0, 0, 1]])}, r"\[\[fx, 0, cx\]"),
        ({"K": np.eye(4)}, r"shape \(4, 4\)"),
        ({"K": "abc"}, "'abc'"),
        ({"world_T_camera": 2 * np.eye(4)}, "rigid transform"),
        ({"world_T_camera": np.diag([1.0, 1.0, -1.0, 1.0])}, "rigid transform"),
        ({"world_T_camera": np.eye(4) + np.eye(4)[[3]].T @ np.eye(4)[[0]]}, "rigid transform"),
        ({"world_T_camera": np.full((4, 4), np.nan)}, "finite"),
    ],
)
def test_bad_fields_are_named(change, message):
    fields = {"width": 8, "height": 8, "K": make_camera(8, 8).K, "world_T_camera": np.eye(4), "near": 0.5, "far": 6.0}
    with pytest.raises(UsageError, match=message):
        CameraModel(**(fields | change))


@pytest.mark.parametrize("text", ["", "nonsense", "[1, 2]", json.dumps({"width": 8}), None])
def test_bad_json_is_refused(text):
    with pytest.raises(UsageError, match="to_json"):
        CameraModel.from_json(text)


def test_bad_arguments_are_named():
    with pytest.raises(UsageError, match="180"):
        make_camera(fovy=180.0)
    with pytest.raises(UsageError, match=r"\(64, 48\).*\(48, 64\)"):
        make_camera().unproject(np.ones((64, 48)))
