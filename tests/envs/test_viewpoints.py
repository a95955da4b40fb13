"""Where cameras stand and what they look at."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from envs.viewpoints import look_at, orbit, quaternion

TARGET = np.array([0.2, -0.1, 0.5])


@pytest.mark.parametrize(("elevation", "azimuth"), [(0, 0), (30, -35), (70, 135)])
def test_an_orbiting_camera_looks_at_its_target_and_is_upright(elevation, azimuth):
    eye, axes = orbit(TARGET, 1.2, elevation, azimuth)
    np.testing.assert_allclose(axes.T @ (TARGET - eye), [0, 0, -1.2], atol=1e-12)
    np.testing.assert_allclose(axes, look_at(eye, TARGET, [0, 0, 3]), atol=1e-12)
    height, aside = np.sin(np.radians(elevation)), np.cos(np.radians(elevation))
    away = [aside * np.cos(np.radians(azimuth)), aside * np.sin(np.radians(azimuth)), height]
    np.testing.assert_allclose(eye - TARGET, 1.2 * np.array(away), atol=1e-12)


def test_from_straight_above_the_azimuth_says_what_is_up():
    axes = orbit(TARGET, 1.0, 90, -90)[1]
    np.testing.assert_allclose(axes, np.eye(3), atol=1e-12)  # +x is right, +y up in the picture


def test_the_quaternion_is_that_of_the_axes():
    axes = look_at([1, 2, 3], TARGET, [0.4, 0.2, 0.9])
    np.testing.assert_allclose(np.linalg.det(axes), 1)
    np.testing.assert_allclose(Rotation.from_quat(np.roll(quaternion(axes), -1)).as_matrix(), axes, atol=1e-12)
