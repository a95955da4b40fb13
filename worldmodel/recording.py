"""What a GPU does in a step, recorded once for each kind of step and then replayed by a single call.

A recurrent model's step is many thousand small kernels. Launched one by one from Python they keep the GPU waiting;
replayed as a CUDA graph they follow each other at once.
"""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor, nn
from tqdm import tqdm

logger = logging.getLogger(__name__)
Inputs = TypeVar("Inputs")
"""A frozen dataclass of tensors, and of plain values that say which way the function goes."""
WARM_UPS = 3
"""Runs before a recording: they compile, choose convolution algorithms and allocate, which cannot be recorded."""


@dataclass(frozen=True)
class Recording(Generic[Inputs]):
    """A CUDA graph, the tensors it reads and writes, and the gradients it leaves."""

    graph: torch.cuda.CUDAGraph
    inputs: Inputs
    outputs: dict[str, Tensor]
    gradients: list[Tensor | None]


class Recorder(Generic[Inputs]):
    """Calls a function that computes gradients; from the first call of a kind on by replaying a recording of it.

    The function is to work on the GPU alone, wait for nothing from it, draw no random numbers, and do the same whenever
    the shapes and the plain values among its inputs are the same. Where it cannot be recorded, it runs as it is, and a
    warning says so once.

    Args:
        function: of its inputs; sets the gradients of `parameters` anew and returns tensors that need none.
        parameters: whose gradients it sets.
    """

    def __init__(self, function: Callable[[Inputs], dict[str, Tensor]], parameters: Sequence[nn.Parameter]) -> None:
        self._function, self._parameters = function, parameters
        self._recordings: dict[Hashable, Recording[Inputs]] = {}
        self._memory: Any = None  # recordings share it: only one of them runs at a time
        self._failed = False

    def __call__(self, inputs: Inputs) -> dict[str, Tensor]:
        """The function's outputs and gradients, which hold until the next call."""
        with torch.cuda.device_of(self._parameters[0]):
            recording = self._recording(inputs)
            if recording is None:
                return self._function(inputs)
            for name, tensor in _tensors(inputs).items():
                getattr(recording.inputs, name).copy_(tensor)
            recording.graph.replay()
        for parameter, gradient in zip(self._parameters, recording.gradients, strict=True):
            parameter.grad = gradient
        return recording.outputs

    def _recording(self, inputs: Inputs) -> Recording[Inputs] | None:
        """That of the inputs' kind, made if need be; None once one could not be made."""
        kind = _kind(inputs)
        if kind not in self._recordings and not self._failed:
            try:
                self._recordings[kind] = self._record(inputs)
            except RuntimeError as error:  # what it holds is free again once this block is left
                self._failed = True
                self._recordings.clear()
                reason = (str(error).strip() or type(error).__name__).splitlines()[0]
                with tqdm.external_write_mode():
                    logger.warning("steps run without CUDA graphs, which is slower: recording failed (%s)", reason)
        return None if self._failed else self._recordings[kind]

    def _record(self, inputs: Inputs) -> Recording[Inputs]:
        gc.collect()  # now, lest it free the recordings of a trainer that is gone while this one is being made
        own: Any = replace(inputs, **{name: t.clone() for name, t in _tensors(inputs).items()})  # type: ignore[type-var]
        here, aside = torch.cuda.current_stream(), torch.cuda.Stream()
        aside.wait_stream(here)
        with torch.cuda.stream(aside):
            for _ in range(WARM_UPS):
                self._function(own)
        here.wait_stream(aside)
        graph = torch.cuda.CUDAGraph()
        try:
            # Other threads may go on meanwhile: the next step's clips are being copied into pinned memory.
            with torch.cuda.graph(graph, pool=self._memory, capture_error_mode="thread_local"):
                outputs = self._function(own)
        finally:
            torch.cuda.set_stream(here)  # a recording that fails does not go back by itself
        self._memory = graph.pool()
        return Recording(graph, own, outputs, [parameter.grad for parameter in self._parameters])


def _tensors(inputs: Any) -> dict[str, Tensor]:
    values = {field.name: getattr(inputs, field.name) for field in fields(inputs)}
    return {name: value for name, value in values.items() if isinstance(value, Tensor)}


def _kind(inputs: Any) -> Hashable:
    """What makes a recording fit: shapes and types of tensors, and plain values themselves."""
    values = (getattr(inputs, field.name) for field in fields(inputs))
    return tuple((tuple(v.shape), v.dtype) if isinstance(v, Tensor) else v for v in values)
