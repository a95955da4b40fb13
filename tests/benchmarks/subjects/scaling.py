"""What a training step takes at other sizes, what arithmetic and memory say it must take, and where its time goes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from tests.benchmarks.subjects.training import make_trainer
from tests.benchmarks.timing import median_seconds
from worldmodel.options import PRESETS
from worldmodel.trainer import Trainer

COMPUTE = ("convolution", "mm", "linear", "addmm")
"""In the name of an operator whose operands no fusion keeps out of memory."""
SHARES: dict[str, tuple[str, ...]] = {
    "compiled (gates, nearest neighbours)": ("CompiledFxGraph", "Torch-Compiled", "TorchDynamo", "_Gates"),
    "convolutions, backward": ("convolution_backward", "ConvolutionBackward"),
    "convolutions, forward": ("convolution", "conv2d", "conv_transpose2d"),
    "layer norms": ("group_norm",),
    "splatting": ("grid_sampler", "_BilinearSplat"),
    "matrix products": ("aten::mm", "aten::bmm", "addmm", "aten::linear", "matmul"),
    "copies, casts, joins": (
        "copy_",
        "_to_copy",
        "aten::cat",
        "_Join",
        "contiguous",
        "clone",
        "empty",
        "fill_",
        "zero",
    ),
    "Adam": ("_foreach", "_fused_adam", "Optimizer"),
}
"""What an operator's own time counts as: the first whose words are in its name. The rest, small operators for each
pixel above all, is `other`."""


def step(preset: str, repeats: int, **sizes: Any) -> dict[str, float]:
    """A step of training: median seconds, and of an eager step GFLOP, GB moved by convolutions and matrix products
    alone, and GB moved by all operators."""
    trainer = sized_trainer(preset, **sizes)
    clips = trainer.next_clips()
    seconds = median_seconds(lambda: trainer.update(clips), repeats)
    with torch.compiler.set_stance("force_eager"):
        with FlopCounterMode(display=False) as flops:
            trainer.update(clips)
        with Traffic() as traffic:
            trainer.update(clips)
    return {
        "seconds": seconds,
        "gflop": 1e-9 * flops.get_total_flops(),
        "gb_least": 1e-9 * traffic.of_compute,
        "gb_all": 1e-9 * traffic.of_all,
    }


def shares(preset: str, repeats: int, **sizes: Any) -> dict[str, float]:
    """Where the time of a step goes: shares of the operators' own CPU time that add up to 1."""
    trainer = sized_trainer(preset, **sizes)
    clips = trainer.next_clips()
    trainer.update(clips)
    with profile(activities=[ProfilerActivity.CPU]) as profiled:
        for _ in range(repeats):
            trainer.update(clips)
    spent = {name: 0.0 for name in (*SHARES, "other")}
    for event in profiled.key_averages():
        spent[_kind(event.key)] += float(event.self_cpu_time_total)
    total = sum(spent.values())
    return {name: value / total for name, value in spent.items()}


def peaks(size: int, megabytes: int, repeats: int) -> dict[str, float]:
    """What the cores can do: GFLOP/s of a square matrix product by precision, GB/s read and written by a copy."""
    found = {}
    for precision in ("float32", "bfloat16"):
        left, right = torch.rand((2, size, size), dtype=torch.float32).to(getattr(torch, precision))
        found[precision] = 2e-9 * size**3 / _fastest(lambda a=left, b=right: a @ b, repeats)  # type: ignore[misc]
    source = torch.zeros(megabytes * 250_000)
    target = torch.zeros_like(source)
    found["copy"] = 2e-3 * megabytes / _fastest(lambda: target.copy_(source), repeats)
    return found


class Traffic(TorchDispatchMode):
    """Adds up the bytes that every operator run within it reads and writes, as if nothing stayed in a cache."""

    def __init__(self) -> None:
        super().__init__()
        self.of_compute = self.of_all = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = function(*args, **(kwargs or {}))
        returns = function._schema.returns
        if any(r.alias_info is not None and not r.alias_info.is_write for r in returns):  # a view moves nothing
            return out
        tensors = [x for x in tree_leaves((args, kwargs, out)) if isinstance(x, torch.Tensor)]
        moved = sum(min(t.nbytes, t.untyped_storage().nbytes()) for t in tensors)
        self.of_all += moved
        if any(word in function.name() for word in COMPUTE):
            self.of_compute += moved
        return out


def sized_trainer(
    preset: str, batch: int, width: float, frames: int, precision: str, kernel: int | None = None, **more: Any
) -> Trainer:
    """Our trainer late in a run of these sizes; `kernel` is that of the LSTMs, by default the preset's."""
    options = PRESETS[preset]
    schedule = replace(options.schedule, clip_lengths=((1.0, frames),))
    architecture = replace(options.architecture, width=width, lstm_kernel=kernel or options.architecture.lstm_kernel)
    trainer = make_trainer(
        "ours", preset, batch=batch, schedule=schedule, architecture=architecture, precision=precision, **more
    )
    trainer.model.train()
    return trainer


def _kind(operator: str) -> str:
    return next((kind for kind, words in SHARES.items() if any(word in operator for word in words)), "other")


def _fastest(work: Callable[[], Any], repeats: int) -> float:
    return min(median_seconds(work, 1) for _ in range(repeats))
