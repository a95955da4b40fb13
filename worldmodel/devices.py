"""Which device a model runs on, and in what precision."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any, Literal, get_args

import torch

from envs.errors import UsageError

Precision = Literal["auto", "float32", "bfloat16"]


def find_device(name: str | torch.device) -> torch.device:
    """`cpu`, `cuda`, `cuda:1`, ..., or `auto` for a GPU where there is one.

    Raises:
        UsageError: there is no such device here.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise UsageError(f"device '{name}' is not to be had here ({reason}); give cpu or cuda") from error


def prepare_devices(deterministic: bool) -> None:
    """Set PyTorch up for this process, before it computes anything.

    Shapes hardly ever change here, so that a GPU may try its convolution algorithms once and keep the fastest. Which
    one that is may differ from run to run.

    Args:
        deterministic: have the same program on the same machine give the same bits, also on a GPU, at some cost in
            speed; an operation that cannot do so then raises a RuntimeError.
    """
    torch.backends.cudnn.benchmark = not deterministic
    if deterministic:
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # or cuBLAS shares buffers between streams
        torch.backends.cudnn.deterministic = True
        torch.use_deterministic_algorithms(True)
        torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]  # nothing reads it


def find_precision(name: Precision, device: torch.device) -> Literal["float32", "bfloat16"]:
    """The name of a precision; of `auto`, that of the best there is.

    Raises:
        UsageError: there is no such precision.
    """
    if name not in get_args(Precision):
        raise UsageError(f"precision is '{name}'; give one of {', '.join(get_args(Precision))}")
    if name != "auto":
        return name
    return "bfloat16" if best_precision(device) == torch.bfloat16 else "float32"


def best_precision(device: torch.device) -> torch.dtype:
    """bfloat16 where the device has instructions for it; where it would be emulated, it is slower than float32."""
    if device.type == "cuda":
        native = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        native = getattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)()
    return torch.bfloat16 if native else torch.float32


def describe(device: torch.device) -> dict[str, Any]:
    """This machine, for people: `cpu` (its name), `cores`, and `gpu` (its name, None where the device is none)."""
    cpu, info = platform.processor() or platform.machine(), Path("/proc/cpuinfo")
    if info.exists():
        names = [line.partition(":")[2].strip() for line in info.read_text().splitlines() if "model name" in line]
        cpu = names[0] if names else cpu
    gpu = torch.cuda.get_device_name(device) if device.type == "cuda" else None
    return {"cpu": cpu, "cores": os.cpu_count(), "gpu": gpu}
