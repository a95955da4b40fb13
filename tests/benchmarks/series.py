"""Measurements of many sizes, which take long and compare with no other program: they run only when they are named."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from tests.benchmarks.child import BenchmarkFailed, measure
from tests.benchmarks.result import Result, cost
from worldmodel.devices import best_precision
from worldmodel.options import PRESETS

Point = dict[str, Any]
SIZES: dict[str, tuple[Any, ...]] = {
    "batch": (4, 8, 16, 32),
    "width": (0.25, 0.5, 1.0),
    "frames": (4, 8, 12, 20),
    "precision": ("bfloat16", "float32"),
}
"""What is varied, one at a time, about the `cpu` preset at the end of its curriculum."""
PAPERS_NETWORK: Point = {"width": 1.0, "kernel": 5}
GPU_CHANGES: tuple[Point, ...] = (
    {},
    {"compiled": False},
    {"graphs": False},
    {"graphs": False, "compiled": False},
    {"precision": "float32"},
    {"batch": 4},
    {"batch": 64},
    {"frames": 4},
    {"width": 1.0},
    {"width": 1.0, "preset": "paper"},
)
"""What differs, on a GPU, from the same, replayed and compiled."""
GPU_PEAKS = (("float32", "TFLOP/s"), ("bfloat16", "TFLOP/s"), ("copy", "GB/s"))
HELD_S = 0.1
"""How long an action of the servo is held."""


def scaling(quick: bool) -> list[Result]:
    """Seconds of a training step over batch, width, clip length and precision, against the floor from arithmetic."""
    preset = "tiny" if quick else "cpu"
    size: Point = (
        {"size": 64, "megabytes": 1, "repeats": 1} if quick else {"size": 2048, "megabytes": 256, "repeats": 9}
    )
    peaks = measure("scaling.peaks", **size)
    results = [
        Result(f"peak_{name}", value, "GB/s" if name == "copy" else "GFLOP/s", "what these cores can do", 1.0)
        for name, value in peaks.items()
    ]
    for name, point in _points(preset, quick).items():
        found = measure("scaling.step", preset=preset, repeats=1 if quick else 5, **point)
        arithmetic, traffic = found["gflop"] / peaks[point["precision"]], found["gb_least"] / peaks["copy"]
        what = (
            f"the floor: {found['gflop']:.4g} GFLOP take {arithmetic:.3g} s at the peak, operands of convolutions and "
            f"matrix products ({found['gb_least']:.3g} GB) {traffic:.3g} s; unfused, all operators move "
            f"{found['gb_all']:.3g} GB"
        )
        results.append(cost(name, found["seconds"], "s", max(arithmetic, traffic), what))
    base = _base(preset)
    for name, share in measure("scaling.shares", preset=preset, repeats=1 if quick else 3, **base).items():
        results.append(Result(f"time: {name}", 100 * share, "%", "of the operators' own time in a step", 1.0))
    return results


def _base(preset: str) -> Point:
    options = PRESETS[preset]
    frames = options.schedule.clip_lengths[-1][1]
    return {
        "batch": options.batch,
        "width": options.architecture.width,
        "frames": frames,
        "kernel": options.architecture.lstm_kernel,
        "precision": str(best_precision(torch.device("cpu"))).removeprefix("torch.")
        if options.precision == "auto"
        else options.precision,
    }


def _points(preset: str, quick: bool) -> dict[str, Point]:
    """Name -> sizes; no point twice."""
    changes = [{axis: value} for axis, values in SIZES.items() for value in (values[:1] if quick else values)]
    points: dict[str, Point] = {}
    for change in changes if quick else (*changes, PAPERS_NETWORK):
        point = {**_base(preset), **change}
        sizes = "batch {batch}, width {width:g}, {frames} frames, LSTMs {kernel} x {kernel}, {precision}"
        points[f"step: {sizes.format(**point)}"] = point
    return points


def gpu(quick: bool) -> list[Result]:
    """Seconds of a training step on a GPU (replayed or launched, compiled or not, over sizes), and of a plan."""
    if not torch.cuda.is_available():
        raise BenchmarkFailed("no GPU that PyTorch can use is here, and this measures one")
    repeats = 2 if quick else 15
    peaks = measure("gpu.peaks", repeats=repeats)
    base = _base("tiny" if quick else "cpu") | {"preset": "cpu", "precision": "bfloat16"}
    base |= {"graphs": True, "compiled": True}
    points = [base | change for change in GPU_CHANGES[: 2 if quick else None]]
    results = [
        Result(f"peak_{name}", peaks[name], unit, f"what {peaks['name']} can do", 1.0) for name, unit in GPU_PEAKS
    ]
    for found in measure("gpu.steps", points=points, repeats=repeats):
        floor = 1e-3 * found["gflop"] / peaks[found["precision"]]
        what = (
            f"the floor: {found['gflop']:.4g} GFLOP at the peak; the first step took {found['first']:.3g} s, "
            f"{found['gib']:.2g} GiB"
        )
        how = "replayed" if found["graphs"] else "launched"
        compiled = "compiled" if found["compiled"] else "not compiled"
        sizes = "batch {batch}, width {width:g}, {frames} frames, {precision}, preset {preset}".format(**found)
        results.append(cost(f"step: {sizes}, {how}, {compiled}", found["seconds"], "s", floor, what))
    plan = measure("planning.action_seconds", decisions=repeats, search={}, device="cuda")
    results.append(cost("plan", plan["seconds"], "s", HELD_S, f"how long it is held; {plan['rollouts']} rollouts"))
    return results


SERIES: dict[str, Callable[[bool], list[Result]]] = {"scaling": scaling, "gpu": gpu}
