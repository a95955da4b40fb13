"""What is and what is not taken for actions."""

from __future__ import annotations

import numpy as np
import pytest

from envs.actions import clip_action, clip_sequences
from envs.errors import UsageError


def test_numbers_beyond_the_range_are_clipped():
    np.testing.assert_array_equal(clip_action([2.0, -3.0, 0.5], 3, "x, y, z"), [1.0, -1.0, 0.5])
    np.testing.assert_array_equal(clip_sequences([[[2.0], [-3.0]]], 1), [[[1.0], [-1.0]]])


@pytest.mark.parametrize("action", ([0.0, 0.0], [0.0, 0.0, np.nan], [[0.0, 0.0, 0.0]]))
def test_an_action_of_another_kind_is_refused(action):
    with pytest.raises(UsageError, match=r"x, y, z|not finite"):
        clip_action(action, 3, "x, y, z")


@pytest.mark.parametrize("shape", ((2, 4, 2), (4, 3), (0, 4, 3), (2, 0, 3)))
def test_sequences_of_another_shape_are_refused(shape):
    """None at all, too: the simulator's threads would end the process."""
    with pytest.raises(UsageError, match=r"\(N, T, 3\)"):
        clip_sequences(np.zeros(shape), 3)
