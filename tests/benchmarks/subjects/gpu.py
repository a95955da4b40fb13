"""What a training step takes on a GPU: launched kernel by kernel or replayed, compiled or not, over sizes."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Callable
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from tests.benchmarks.subjects.scaling import sized_trainer
from tests.benchmarks.timing import median_seconds
from worldmodel.devices import prepare_devices

Point = dict[str, Any]
PEAK_SIZE = 8192
COPIED = 2**30  # bytes


def peaks(repeats: int) -> dict[str, Any]:
    """Name of the GPU and what it can do: TFLOP/s of a large matrix product by precision, GB/s (both ways) of a copy.

    In float32 the product may use TF32, as PyTorch lets convolutions do.
    """
    torch.backends.cuda.matmul.allow_tf32 = True
    found: dict[str, Any] = {"name": torch.cuda.get_device_name()}
    for precision in ("float32", "bfloat16"):
        left, right = torch.randn((2, PEAK_SIZE, PEAK_SIZE), device="cuda").to(getattr(torch, precision))
        found[precision] = 2e-12 * PEAK_SIZE**3 / _seconds(lambda a=left, b=right: a @ b, repeats)  # type: ignore[misc]
    source = torch.empty(COPIED // 4, device="cuda").normal_()
    target = torch.empty_like(source)
    found["copy"] = 2e-9 * COPIED / _seconds(lambda: target.copy_(source), repeats)
    return found


def steps(points: list[Point], repeats: int) -> list[Point]:
    """Median seconds of a step at several sizes, one after the other in one process.

    Args:
        points: of `preset`, `batch`, `width`, `frames`, `precision`, `graphs` (whether steps are replayed) and
            `compiled`.
        repeats: steps that are timed.

    Returns:
        Each point with `seconds`, those of the `first` step, `gflop` of a step and `gib`, the most memory reserved.
    """
    prepare_devices(deterministic=False)
    return [point | _step(point, repeats) for point in points]


def _step(point: Point, repeats: int) -> Point:
    torch.compiler.reset()  # or the sizes before count as recompilations
    gc.collect()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    sizes = {name: point[name] for name in ("preset", "batch", "width", "frames", "precision")}
    trainer = sized_trainer(**sizes, device="cuda", cuda_graphs=point["graphs"])
    clips = trainer.next_clips()
    with contextlib.nullcontext() if point["compiled"] else torch.compiler.set_stance("force_eager"):
        first = _seconds(lambda: trainer.update(clips), 1, warmup=0)
        seconds = _seconds(lambda: trainer.update(clips), repeats)
    gib = torch.cuda.max_memory_reserved() / 2**30
    with torch.compiler.set_stance("force_eager"), FlopCounterMode(display=False) as flops:
        trainer.differentiate(trainer.inputs(clips))
    return {"seconds": seconds, "first": first, "gflop": 1e-9 * flops.get_total_flops(), "gib": gib}


def _seconds(work: Callable[[], Any], repeats: int, warmup: int = 1) -> float:
    """Median seconds of a call and of all that it makes the GPU do."""

    def whole() -> None:
        work()
        torch.cuda.synchronize()

    torch.cuda.synchronize()
    return median_seconds(whole, repeats, warmup)
