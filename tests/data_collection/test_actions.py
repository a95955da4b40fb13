"""Skipping frames keeps what the actions do."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from data_collection.actions import aggregate_actions

AGGREGATION = ("sum",) * 3 + ("rotate",) * 3 + ("last",)
SCALE = (0.02,) * 3 + (0.05,) * 3 + (1.0,)


def actions(shape):
    return hnp.arrays(np.float64, shape, elements=st.floats(-1, 1))


def turn_of(action, scale=SCALE):
    return Rotation.from_euler("xyz", action[..., 3:6] * scale[3])


@given(actions((5, 7)))
def test_positions_sum_and_the_gripper_takes_the_last(steps):
    total = aggregate_actions(steps, AGGREGATION, SCALE)
    np.testing.assert_allclose(total[:3], steps[:, :3].sum(axis=0), atol=1e-12)
    assert total[6] == steps[-1, 6]


@given(actions((6, 7)))
def test_rotations_compose_in_order_about_world_axes(steps):
    total = aggregate_actions(steps, AGGREGATION, SCALE)
    whole = Rotation.identity()
    for step in steps:
        whole = turn_of(step) * whole
    assert (turn_of(total).inv() * whole).magnitude() < 1e-9


@given(actions((6, 7)), st.integers(1, 5))
def test_aggregating_in_two_stages_is_aggregating_at_once(steps, cut):
    stages = np.stack([aggregate_actions(part, AGGREGATION, SCALE) for part in (steps[:cut], steps[cut:])])
    at_once = aggregate_actions(steps, AGGREGATION, SCALE)
    np.testing.assert_allclose(aggregate_actions(stages, AGGREGATION, SCALE), at_once, atol=1e-9)


@given(actions((2, 3, 4, 7)))
def test_leading_axes_are_independent(batch):
    together = aggregate_actions(batch, AGGREGATION, SCALE)
    assert together.shape == (2, 3, 7)
    np.testing.assert_allclose(together[1, 2], aggregate_actions(batch[1, 2], AGGREGATION, SCALE), atol=1e-12)


@given(actions((1, 7)))
def test_one_action_is_itself(steps):
    np.testing.assert_array_equal(aggregate_actions(steps, AGGREGATION, SCALE), steps[0])


def test_turns_about_one_axis_add_up_and_order_matters_otherwise():
    steps = np.zeros((4, 7))
    steps[:, 5] = 1.0
    np.testing.assert_allclose(aggregate_actions(steps, AGGREGATION, SCALE)[3:6], [0, 0, 4.0], atol=1e-9)
    scale = (1.0,) * 7
    quarter = np.zeros((2, 7))
    quarter[0, 3] = quarter[1, 5] = 1.0
    swapped = aggregate_actions(quarter[::-1], AGGREGATION, scale)
    assert not np.allclose(aggregate_actions(quarter, AGGREGATION, scale), swapped, atol=0.1)


def test_dtype_is_kept_and_input_untouched():
    steps = np.ones((3, 7), np.float32)
    total = aggregate_actions(steps, AGGREGATION, SCALE)
    assert total.dtype == np.float32
    total[:] = 5
    assert (steps == 1).all()


@pytest.mark.parametrize(
    ("shape", "aggregation", "scale"),
    [
        ((3, 6), AGGREGATION, SCALE),
        ((7,), AGGREGATION, SCALE),
        ((0, 7), AGGREGATION, SCALE),
        ((3, 2), ("rotate", "rotate"), (1, 1)),
        ((3, 4), ("rotate", "rotate", "sum", "rotate"), (1,) * 4),
        ((3, 1), ("mean",), (1,)),
        ((3, 7), AGGREGATION, None),
    ],
)
def test_what_does_not_fit_is_refused(shape, aggregation, scale):
    with pytest.raises(ValueError):
        aggregate_actions(np.zeros(shape), aggregation, scale)
