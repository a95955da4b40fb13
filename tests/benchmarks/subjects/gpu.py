"""What a training step takes on a GPU: launched kernel by kernel or replayed, compiled or not, over sizes."""

from __future__ import annotations

import contextlib
import time
from dataclasses import replace
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from envs.errors import UsageError
from tests.benchmarks.subjects.training import make_trainer
from worldmodel.devices import prepare_devices
from worldmodel.options import PRESETS

Point = dict[str, Any]
PEAK_SIZE = 8192
COPIED = 2**30  # bytes


def peaks(repeats: int) -> dict[str, float]:
    """What the GPU can do: TFLOP/s of a square matrix product by precision, GB/s read and written by a copy."""
    _needs_gpu()
    found: dict[str, float] = {"name": torch.cuda.get_device_name()}  # type: ignore[dict-item]
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
        Each point with `seconds`, `gflop` of a step and `gib`, the most memory that was reserved.
    """
    _needs_gpu()
    prepare_devices(deterministic=False)
    return [point | _step(point, repeats) for point in points]


def _step(point: Point, repeats: int) -> Point:
    torch.compiler.reset()  # or the sizes before count as recompilations
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    options = PRESETS[point["preset"]]
    trainer = make_trainer(
        "ours",
        point["preset"],
        "cuda",
        batch=point["batch"],
        schedule=replace(options.schedule, clip_lengths=((1.0, point["frames"]),)),
        architecture=replace(options.architecture, width=point["width"]),
        precision=point["precision"],
        cuda_graphs=point["graphs"],
    )
    trainer.model.train()
    clips = trainer.next_clips()
    how = contextlib.nullcontext() if point["compiled"] else torch.compiler.set_stance("force_eager")
    with how:
        begun = time.perf_counter()
        trainer.update(clips)
        torch.cuda.synchronize()
        first = time.perf_counter() - begun
        seconds = _seconds(lambda: trainer.update(clips), repeats)
    gib = torch.cuda.max_memory_reserved() / 2**30
    with torch.compiler.set_stance("force_eager"), FlopCounterMode(display=False) as flops:
        trainer._differentiate(trainer.inputs(clips))
    return {"seconds": seconds, "first": first, "gflop": 1e-9 * flops.get_total_flops(), "gib": gib}


def _seconds(work: Any, repeats: int) -> float:
    """Median seconds of a call and all that it makes the GPU do."""
    times = []
    work()
    for _ in range(repeats):
        torch.cuda.synchronize()
        start = time.perf_counter()
        work()
        torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return sorted(times)[len(times) // 2]


def _needs_gpu() -> None:
    if not torch.cuda.is_available():
        raise UsageError("no GPU that PyTorch can use is here, and this measures one")
