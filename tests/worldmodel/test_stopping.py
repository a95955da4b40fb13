"""Signals while training is asked to stop: one is noted, a second one is no longer held back, ignored ones stay so."""

import signal
import threading

import pytest

from worldmodel.stopping import stop_signals


@pytest.fixture
def met():
    """The SIGTERMs that reach the handler that was there before; SIGINT is ignored, as under nohup."""
    numbers = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: numbers.append(number))
    ignored = signal.signal(signal.SIGINT, signal.SIG_IGN)
    yield numbers
    signal.signal(signal.SIGTERM, before)
    signal.signal(signal.SIGINT, ignored)


def test_the_first_signal_is_noted_and_the_second_one_gets_through(met):
    with stop_signals() as stops:
        signal.raise_signal(signal.SIGTERM)
        assert stops == [signal.SIGTERM] and met == []
        signal.raise_signal(signal.SIGTERM)
        assert stops == met == [signal.SIGTERM]


def test_what_is_ignored_stays_ignored_and_afterwards_all_is_as_before(met):
    with stop_signals() as stops:
        signal.raise_signal(signal.SIGINT)
    assert stops == []
    signal.raise_signal(signal.SIGTERM)
    assert stops == [] and met == [signal.SIGTERM]


def test_another_thread_trains_without_being_asked(met):
    answers = []

    def train():
        with stop_signals() as stops:
            answers.append(stops)

    thread = threading.Thread(target=train)
    thread.start()
    thread.join()
    assert answers == [[]]
