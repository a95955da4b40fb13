"""Depth on the disk: uint16 over the camera's range, and what is no depth in metres."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_collection.schema import DEPTH_STEPS, dequantise_depth, quantise_depth
from envs.errors import UsageError


@given(st.lists(st.floats(0.5, 6.0), min_size=1), st.floats(0.5, 2.0), st.floats(0.01, 4.0))
def test_depth_comes_back_to_half_a_step(metres, near, span):
    far = near + span
    depth = np.array(metres, np.float32)
    back = dequantise_depth(quantise_depth(depth, near, far), near, far)
    assert back.dtype == np.float32
    half_step = span / DEPTH_STEPS / 2
    np.testing.assert_allclose(back, np.clip(depth, near, far), atol=half_step + 1e-6, rtol=0)


def test_depth_with_holes_is_refused_and_what_is_too_near_or_far_is_clipped():
    with pytest.raises(UsageError, match="depth has NaN in 2 of 6 pixels; fill such holes"):
        quantise_depth(np.array([[1.0, np.nan, 2.0], [np.nan, 1.0, 1.0]], np.float32), 0.5, 3.0)
    clipped = quantise_depth(np.array([0.0, 0.5, 3.0, np.inf]), 0.5, 3.0)
    assert clipped.tolist() == [0, 0, DEPTH_STEPS, DEPTH_STEPS]


@pytest.mark.parametrize(
    ("depth", "near", "far", "words"),
    [
        (np.array([1200, 1300], np.uint16), 0.5, 3.0, "depth is uint16; give metres as floats"),
        (np.array([1200.0, 1300.0]), 0.5, 3.0, "most of the depth is about 1250, but the camera's range ends at 3 m"),
        (np.array([1.2, 1.3]), 3.0, 0.5, "depth range is near=3.0, far=0.5"),
    ],
)
def test_depth_that_is_not_in_metres_is_refused(depth, near, far, words):
    with pytest.raises(UsageError, match=words):
        quantise_depth(depth, near, far)
