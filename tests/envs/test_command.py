"""How commands end."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass

import pytest

from envs.command import run

PROGRAM = """
from dataclasses import dataclass
from envs.command import run

@dataclass
class Config:
    '''Prints numbers.'''
    numbers: int

run(Config, lambda config: print(*range(config.numbers)))
"""


@pytest.mark.parametrize("argument", ["--help", "--numbers=3", "--numbers=100000"])
def test_a_reader_that_has_gone_is_no_error(argument):
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, argument], stdout=writer, stderr=subprocess.PIPE, text=True, timeout=300
        )
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr) == (141, "")


def test_another_broken_pipe_keeps_its_traceback():
    @dataclass
    class Config:
        """Nothing."""

    def main(config: Config) -> None:
        raise BrokenPipeError

    with pytest.raises(BrokenPipeError):
        run(Config, main, [])


def test_paragraphs_of_the_help_begin_at_the_margin(capsys):
    @dataclass
    class Config:
        """One thing.

        And another.
        """

    with pytest.raises(SystemExit):
        run(Config, lambda config: None, ["--help"])
    assert "\nOne thing.\n\nAnd another.\n" in capsys.readouterr().out
