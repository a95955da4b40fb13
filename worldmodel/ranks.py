"""Several processes that train one model together, as `torchrun` starts them.

Each process, a rank, works on its share of every batch, and the gradients are averaged in one exchange of one flat
tensor. PyTorch's DistributedDataParallel would begin that exchange during the backward pass, gradient by gradient. Here
there is nothing to begin early with: a recurrent model uses every weight at every frame, so no gradient is whole before
the backward pass is back at the first frame. It also wants all of training behind one `forward`, and to be told of
weights that a step leaves out, such as the inference network's early in a run.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed

from envs.errors import UsageError
from worldmodel.devices import find_device

Answer = TypeVar("Answer")
PATIENCE = timedelta(hours=1)
"""How long the others wait for the first rank, which validates and saves alone."""


@dataclass(frozen=True)
class Ranks:
    """The processes of a run, seen from one of them. Alone, everything here does nothing."""

    index: int = 0
    count: int = 1
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))

    @property
    def first(self) -> bool:
        """Whether this is the process that writes files and talks to people."""
        return self.index == 0

    def share(self, batch: int) -> slice:
        """Which clips of a batch are this process's.

        Raises:
            UsageError: the batch has no equal shares; the mean over them would not be that over the batch.
        """
        if batch % self.count:
            raise UsageError(
                f"batch is {batch}, which {self.count} processes cannot share equally; give a multiple of {self.count}"
            )
        each = batch // self.count
        return slice(self.index * each, (self.index + 1) * each)

    def mean(self, values: Tensor) -> Tensor:
        """The mean over all processes."""
        if self.count == 1:
            return values
        values = values.clone()
        distributed.all_reduce(values)
        return values / self.count

    def average_gradients(self, parameters: Iterable[torch.nn.Parameter]) -> None:
        """Give every process the mean of all processes' gradients, the same bits each."""
        if self.count == 1:
            return
        gradients = [p.grad for p in parameters if p.grad is not None]  # the same ones everywhere
        mean = self.mean(torch.cat([gradient.flatten() for gradient in gradients]))
        for gradient, part in zip(gradients, mean.split([g.numel() for g in gradients]), strict=True):
            gradient.copy_(part.view_as(gradient))

    def any(self, flag: bool) -> bool:
        """Whether it holds in any process."""
        if self.count == 1:
            return flag
        return float(self.mean(torch.tensor(float(flag), device=self.device))) > 0

    def begin_alike(self, weights: Iterable[Tensor], step: int) -> None:
        """Give every process the first one's weights, at the beginning.

        Raises:
            UsageError: the processes are at different steps.
        """
        if self.count == 1:
            return
        if self.any(step != self.decide(lambda: step)):
            raise UsageError(
                "not all processes find the run's newest checkpoint; give an --out on a filesystem that all of them see"
            )
        for tensor in weights:
            distributed.broadcast(tensor.detach(), 0)

    def decide(self, ask: Callable[[], Answer]) -> Answer:
        """Have the first process ask, and give all of them its answer, or its `UsageError`."""
        if self.count == 1:
            return ask()
        said: list[Any] = [None, None]
        if self.first:
            try:
                said[0] = ask()
            except UsageError as error:
                said[1] = str(error)
        distributed.broadcast_object_list(said, 0, device=self.device)
        if said[1] is not None:
            raise UsageError(said[1])
        answer: Answer = said[0]
        return answer


ALONE = Ranks()


def processes_here() -> int:
    """How many processes torchrun started on this machine."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", "1"))


@contextmanager
def join_ranks(device: str) -> Iterator[Ranks]:
    """Meet the other processes that `torchrun` started; without it there are none.

    Args:
        device: as for `find_device`; of several GPUs each process of a machine takes its own.

    Raises:
        UsageError: no such device, or more processes than GPUs.
    """
    count = int(os.environ.get("WORLD_SIZE", "1")) if "RANK" in os.environ else 1
    if count == 1:
        yield Ranks(device=find_device(device))
        return
    own = _own_device(device, int(os.environ.get("LOCAL_RANK", "0")))
    if own.type == "cuda":
        torch.cuda.set_device(own)
    distributed.init_process_group("nccl" if own.type == "cuda" else "gloo", timeout=PATIENCE)
    yield Ranks(distributed.get_rank(), count, own)
    distributed.destroy_process_group()  # after a failure the others may never answer: then it just ends


def _own_device(name: str, local: int) -> torch.device:
    device = find_device(name)
    if device.type != "cuda":
        return device
    if ":" in name:
        raise UsageError(f"device is '{name}' for every process of torchrun; give cuda, and each takes its own GPU")
    gpus = torch.cuda.device_count()
    if local >= gpus:
        raise UsageError(
            f"torchrun started more processes here than there are GPUs ({gpus}); give --nproc-per-node {gpus}"
        )
    return torch.device("cuda", local)
