"""How every command starts: options from a dataclass, mistakes as one line and exit code 2."""

from __future__ import annotations

import contextlib
import errno
import inspect
import io
import os
import select
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import is_dataclass
from types import FrameType
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import tyro

from envs.errors import UsageError

Config = TypeVar("Config")

WRONG_PLACE = (PermissionError, NotADirectoryError, IsADirectoryError, FileExistsError)
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


def end_on_sigterm(said: str) -> None:
    """Have SIGTERM end this process as Ctrl-C does, so that what is under way is cleared up, with exit code 143.

    Args:
        said: on stderr, about what becomes of the work.
    """

    def stop(number: int, frame: FrameType | None) -> None:
        print(f"terminated; {said}", file=sys.stderr)
        sys.exit(128 + number)

    signal.signal(signal.SIGTERM, stop)


def run(
    config: type[Config],
    main: Callable[[Config], None],
    args: Sequence[str] | None = None,
    default: Callable[[Sequence[str]], Config] | None = None,
) -> None:
    """Parse the command line into `config` and hand it to `main`.

    A `UsageError`, from the options' own checks or from `main`, ends the process with one line on stderr and exit
    code 2; so does an option that cannot be parsed, a file or folder that cannot be where it shall be, and a full disk.
    Ctrl-C ends it with 130. Where nobody reads on, as after `| head`, it ends quietly with 141, as others do that
    SIGPIPE kills. Anything else is a bug and keeps its traceback.

    Args:
        config: a dataclass whose field docstrings are the help text.
        main: what the command does.
        args: the arguments; those of the process when None.
        default: makes, from the arguments, the options that hold where the command line is silent (a preset).
    """
    try:
        try:
            main(parse(config, args, default))
        finally:
            sys.stdout.flush()  # here rather than when Python ends, where it is too late to be quiet
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:
        if not _reader_is_gone():
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what Python flushes when it ends
        sys.exit(128 + signal.SIGPIPE)
    except OSError as error:
        told = _tell(error)
        if told is None:
            raise
        print(f"error: {told}", file=sys.stderr)
        sys.exit(2)


def parse(
    config: type[Config],
    args: Sequence[str] | None = None,
    default: Callable[[Sequence[str]], Config] | None = None,
) -> Config:
    """The options of a command.

    Raises:
        UsageError: they do not parse, one that takes several values is given more than once, or `config` refuses them.
    """
    box, about = io.StringIO(), inspect.getdoc(config)
    words = sys.argv[1:] if args is None else args
    _refuse_repeats(config, words)
    try:
        with contextlib.redirect_stderr(box):
            if default is None:
                return tyro.cli(config, args=words, description=about)
            return tyro.cli(config, args=words, description=about, default=default(words))
    except SystemExit as stop:
        if stop.code != 2:  # --help
            raise
        cause: BaseException | None = stop
        while cause is not None and not isinstance(cause, UsageError):
            cause = cause.__context__
    raise cause or UsageError(_one_line(box.getvalue()))


def given(arguments: Sequence[str], option: str) -> str | None:
    """What follows an option on a command line that is not parsed yet; None where it does not stand."""
    value = None
    for here, following in zip(arguments, [*arguments[1:], ""], strict=True):
        name, separator, joined = here.partition("=")
        if name == option:
            value = joined if separator else following
    return value


def _refuse_repeats(config: type[Any], given: Sequence[str]) -> None:
    """Refuse a list that is given piece by piece: of an option that comes twice the last one counts."""
    spellings = _list_options(config)
    words = [word.partition("=")[0].replace("_", "-") for word in given]
    lists = [spellings[word] for word in words if word in spellings]
    for option in lists:
        if lists.count(option) > 1:
            raise UsageError(
                f"{option} is given {lists.count(option)} times, of which only the last would count; "
                f"give all values at once: {option} VALUE VALUE"
            )


def _list_options(config: type[Any], prefix: str = "--") -> dict[str, str]:
    """Every spelling of an option that takes any number of values, nested groups' too -> the option's own name."""
    found: dict[str, str] = {}
    for name, hint in get_type_hints(config, include_extras=True).items():
        option = prefix + name.replace("_", "-")
        kind, *notes = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        if is_dataclass(kind):
            found |= _list_options(kind, f"{option}.")  # type: ignore[arg-type]
        elif get_origin(kind) is list or ... in get_args(kind):
            aliases = [alias for note in notes for alias in getattr(note, "aliases", None) or ()]
            found |= dict.fromkeys((option, *aliases), option)
    return found


def _reader_is_gone() -> bool:
    """Whether stdout is a pipe that nobody reads from any more; other pipes may break as well, and that is a bug."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    return bool(poll.poll(0))  # errors are told unasked


def _tell(error: OSError) -> str | None:
    """What the user can do about an error of the file system; None for one that is a bug."""
    place, why = error.filename, error.strerror
    if error.errno in NO_ROOM:
        return f"cannot write {place or 'a file'} ({why}); make room, or choose a place that can be written to"
    if place is None:  # it is about a process or a socket
        return None
    if isinstance(error, WRONG_PLACE) or _is_of_mkdir(error):
        return f"cannot read or write {place} ({why}); choose another place, or change what is there"
    return None


def _is_of_mkdir(error: OSError) -> bool:
    """Whether a folder that is not found is one that was to be made where none can be, as in /proc.

    Where its parent is missing as well, or a file was to be opened, it is a bug.
    """
    if not isinstance(error, FileNotFoundError):
        return False
    raiser = traceback.extract_tb(error.__traceback__)[-1]
    return raiser.name == "mkdir" and os.path.isdir(os.path.dirname(os.path.abspath(error.filename)))


def _one_line(box: str) -> str:
    """What tyro says in a frame, drawn or (where the terminal knows no more) in ASCII: its message, as one line."""
    paragraphs: list[list[str]] = [[]]
    for line in (line.strip("│╭╮╰╯ ") for line in box.splitlines()):
        if line.startswith(("─", "--- ", "----")):
            paragraphs.append([])
        elif line:
            paragraphs[-1].append(line)
    drawn = "│" in box  # then the title is in the frame, else a paragraph of its own
    message = [" ".join(paragraph) for paragraph in paragraphs if paragraph][0 if drawn else 1]
    return f"{message.rstrip('.')}; --help lists the options"
