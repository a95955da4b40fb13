"""How every command starts: options from a dataclass, mistakes as one line and exit code 2."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import TypeVar

import tyro

from envs.errors import UsageError

Config = TypeVar("Config")


def run(config: type[Config], main: Callable[[Config], None], args: Sequence[str] | None = None) -> None:
    """Parse the command line into `config` and hand it to `main`.

    A `UsageError`, from the options' own checks or from `main`, ends the process with one line on stderr and exit
    code 2; Ctrl-C ends it with 130. Anything else is a bug and keeps its traceback.

    Args:
        config: a dataclass whose field docstrings are the help text.
        main: what the command does.
        args: the arguments; those of the process when None.
    """
    try:
        main(tyro.cli(config, args=args, description=config.__doc__))
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
