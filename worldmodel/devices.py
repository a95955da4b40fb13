"""Which device a model runs on."""

from __future__ import annotations

import torch

from envs.errors import UsageError


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


def best_precision(device: torch.device) -> torch.dtype:
    """bfloat16 where the device has instructions for it; where it would be emulated, it is slower than float32."""
    if device.type == "cuda":
        native = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        native = getattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)()
    return torch.bfloat16 if native else torch.float32
