"""`torch.compile` where there is a compiler, and the plain function where there is none."""

from __future__ import annotations

import functools
import importlib.util
import logging
import os
import shutil
import sys
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor
from tqdm import tqdm

Function = TypeVar("Function", bound=Callable[..., Any])
logger = logging.getLogger(__name__)
SHAPES = 64
"""For so many sets of shapes a function is compiled before it runs as it is. PyTorch's 8 are soon used up by a
curriculum of several clip lengths."""
OLDEST_GPU = (7, 0)
"""Compute capability from which on Triton makes kernels."""
ONE_LOOP = {"realize_reads_threshold": 1000, "realize_opcount_threshold": 10_000, "realize_acc_reads_threshold": 10_000}
"""Settings under which TorchInductor keeps what a long chain of pointwise operators computes in registers. By default
most of it goes to memory, lest the C++ compiler be given too much; nearest neighbours take twice as long then."""


@functools.cache
def can_compile(device: str = "cpu") -> bool:
    """Whether TorchInductor can build kernels for a kind of device: it needs a C++ compiler, on a GPU C and Triton."""
    if sys.platform == "win32":
        return False
    if device == "cpu":
        missing = "" if _found("CXX", "g++", "clang++", "c++") else "C++ compiler"
    elif device == "cuda":
        missing = "" if importlib.util.find_spec("triton") else "Triton"
        missing = missing or ("" if _found("CC", "gcc", "clang", "cc") else "C compiler")
        missing = missing or ("" if torch.cuda.get_device_capability() >= OLDEST_GPU else "GPU new enough for Triton")
    else:
        missing = f"backend for {device}"
    if missing:
        _warn("no %s found: running without torch.compile, which is slower; results are the same", missing)
    return not missing


def _found(variable: str, *names: str) -> bool:
    return any(shutil.which(name) for name in (os.environ.get(variable, ""), *names) if name)


def _warn(message: str, *values: str) -> None:
    """Log on a line of its own: training has begun, and its progress bar would run into the message and hide it."""
    with tqdm.external_write_mode():
        logger.warning(message, *values)


def compiled(function: Function) -> Function:
    """Compile a function on its first call, for the shapes that it is called with.

    Where there is no compiler for the device of its first tensor, or the compiler fails, the function runs as it is.
    Called from within another compiled function it becomes a part of that.
    """
    fast: Callable[..., Any] | None = None
    failed = False

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal fast, failed
        device = _device_of(args)
        if failed or torch.compiler.is_compiling() or not can_compile(device):
            return function(*args, **kwargs)
        if fast is None:
            _allow_shapes()
            fast = torch.compile(function, dynamic=False, options=_one_loop() if device == "cpu" else None)
        try:
            return fast(*args, **kwargs)
        except RuntimeError as error:
            from torch._dynamo.exc import BackendCompilerFailed

            if not isinstance(error, BackendCompilerFailed):
                raise
            failed = True
            reason = str(error).strip().splitlines()[0]
            _warn("%s runs without torch.compile, which failed (%s)", function.__name__, reason)
            return function(*args, **kwargs)

    return call  # type: ignore[return-value]


def _allow_shapes() -> None:
    from torch._dynamo import config

    limit = "recompile_limit" if hasattr(config, "recompile_limit") else "cache_size_limit"  # before PyTorch 2.7
    setattr(config, limit, max(getattr(config, limit), SHAPES))


def _one_loop() -> dict[str, Any]:
    """What this version of PyTorch has of these settings."""
    known = torch._inductor.list_options()
    return {name: value for name, value in ONE_LOOP.items() if name in known}


def _device_of(args: tuple[Any, ...]) -> str:
    return next((argument.device.type for argument in args if isinstance(argument, Tensor)), "cpu")
