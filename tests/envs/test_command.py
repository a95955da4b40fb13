"""How commands end."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import pytest
import tyro

from envs.command import parse, run
from envs.errors import UsageError

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


@dataclass
class Group:
    """Nested options."""

    some_paths: tuple[Path, ...] = ()
    pair: tuple[int, int] = (0, 0)


@dataclass
class Lists:
    """Options of several values."""

    models: Annotated[tuple[str, ...], tyro.conf.arg(aliases=("--model",))] = ()
    gap: list[int] = field(default_factory=list)
    seed: int = 0
    group: Group = field(default_factory=Group)


@pytest.mark.parametrize(
    ("line", "option"),
    [
        ("--models a --models b", "--models"),
        ("--model a --models b c", "--models"),
        ("--gap=1 --seed 3 --gap 2 --gap 3", "--gap"),
        ("--group.some-paths a --group.some_paths=b", "--group.some-paths"),
    ],
)
def test_a_list_that_is_given_in_pieces_is_refused(line, option):
    with pytest.raises(UsageError, match=f"^{option} is given [23] times, .* give all values at once: {option} "):
        parse(Lists, line.split())


def test_a_list_is_given_at_once_and_of_other_options_the_last_counts():
    line = "--model a b --gap 1 2 --seed 1 --seed 2 --group.some-paths x y --group.pair 1 2 --group.pair 3 4"
    assert parse(Lists, line.split()) == Lists(("a", "b"), [1, 2], 2, Group((Path("x"), Path("y")), (3, 4)))


@dataclass
class Nothing:
    """No options."""


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (PermissionError(errno.EACCES, "Permission denied", "a/b"), "cannot read or write a/b (Permission denied); "),
        (NotADirectoryError(errno.ENOTDIR, "Not a directory", "f/x"), "cannot read or write f/x (Not a directory); "),
        (FileExistsError(errno.EEXIST, "File exists", "f"), "cannot read or write f (File exists); "),
        (OSError(errno.EROFS, "Read-only file system", "a.h5"), "cannot write a.h5 (Read-only file system); "),
        (OSError(errno.ENOSPC, "No space left on device"), "cannot write a file (No space left on device); "),
    ],
)
def test_places_that_cannot_be_used_are_one_line(error, said, capsys):
    def main(config: Nothing) -> None:
        raise error

    with pytest.raises(SystemExit) as stop:
        run(Nothing, main, [])
    err = capsys.readouterr().err
    assert stop.value.code == 2 and err.startswith(f"error: {said}") and err.count("\n") == 1


def test_a_folder_where_none_can_be_made_is_one_line(capsys):
    with pytest.raises(SystemExit) as stop:
        run(Nothing, lambda config: Path("/proc/there/is/none").mkdir(parents=True, exist_ok=True), [])
    assert stop.value.code == 2
    said = "error: cannot read or write /proc/there (No such file or directory); choose another place, "
    err = capsys.readouterr().err
    assert err.startswith(said) and err.count("\n") == 1


@pytest.mark.parametrize(
    "look", [lambda path: path.mkdir(), lambda path: path.read_text(), lambda path: path.open("w")]
)
def test_a_missing_folder_that_nobody_made_keeps_its_traceback(look, tmp_path):
    with pytest.raises(FileNotFoundError):
        run(Nothing, lambda config: look(tmp_path / "never" / "made"), [])


@pytest.mark.parametrize(
    "error", [PermissionError(errno.EPERM, "no such right"), FileNotFoundError(errno.ENOENT, "no", "a")]
)
def test_errors_that_are_bugs_keep_their_traceback(error):
    def main(config: Nothing) -> None:
        raise error

    with pytest.raises(type(error)):
        run(Nothing, main, [])
