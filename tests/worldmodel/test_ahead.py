"""Reading ahead gives what reading would give."""

import threading

import pytest

from worldmodel.ahead import Ahead


def test_the_next_step_is_read_in_another_thread_and_no_more_than_that():
    calls = []

    def read(step):
        calls.append((step, threading.current_thread() is threading.main_thread()))
        return 10 * step

    ahead = Ahead(read, end=4)
    assert [ahead(step) for step in (0, 1, 2, 3)] == [0, 10, 20, 30]
    assert calls == [(0, True), (1, False), (2, False), (3, False)]
    assert ahead(1) == 10 and ahead(2) == 20  # from another place


def test_what_goes_wrong_is_raised_where_it_is_asked_for():
    def read(step):
        if step == 1:
            raise OSError("gone")
        return step

    ahead = Ahead(read, end=9)
    assert ahead(0) == 0
    with pytest.raises(OSError, match="gone"):
        ahead(1)
