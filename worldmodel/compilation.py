"""`torch.compile` where there is a compiler, and the plain function where there is none."""

from __future__ import annotations

import functools
import logging
import shutil
import sys
from collections.abc import Callable
from typing import Any, TypeVar

import torch

Function = TypeVar("Function", bound=Callable[..., Any])
logger = logging.getLogger(__name__)


@functools.cache
def can_compile() -> bool:
    """Whether TorchInductor can build CPU kernels here: it needs a C++ compiler."""
    if sys.platform == "win32" or not any(shutil.which(name) for name in ("g++", "clang++", "c++")):
        logger.info("no C++ compiler found: running without torch.compile, which is slower; results are the same")
        return False
    return True


def compiled(function: Function) -> Function:
    """Compile a function on its first call, for the shapes it is called with."""
    if not can_compile():
        return function
    return torch.compile(function, dynamic=False)  # type: ignore[return-value]
