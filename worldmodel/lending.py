"""Weights in the precision that a network runs in, cast once for all frames of a clip.

Autocast casts every weight at every frame, and on the way back every gradient to float32, to add it to those of the
other frames: three small operations a weight and frame. Here a clip's frames borrow weights that were cast once, and
each frame's gradients are added up in float32 all together. The numbers are the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from worldmodel.blocks import Upsample

LENT = (nn.Conv2d, nn.Linear, Upsample)
"""Layers that autocast runs in low precision. What derives from them, such as `PreciseLinear`, keeps its own."""


class WeightLoan:
    """A network's weights in another precision, for as long as they do not change.

    Args:
        network: whose convolutions and linear layers are lent to.
        precision: what they are cast to.
    """

    def __init__(self, network: nn.Module, precision: torch.dtype) -> None:
        layers = [layer for layer in network.modules() if type(layer) in LENT]
        self._places: list[tuple[dict[str, Any], str]] = [
            (layer._parameters, name) for layer in layers for name in ("weight", "bias")
        ]
        self.own: list[Tensor] = [parameters[name] for parameters, name in self._places]
        with torch.no_grad():
            self.cast = [weight.to(precision) for weight in self.own]
        self._sum: Tensor | None = None

    def open(self) -> Tensor:
        """The account that `frame` borrows on."""
        account: Tensor = _Account.apply(self, *self.own)
        return account  # not kept here: it refers to the loan, and neither would ever be freed

    @contextmanager
    def frame(self, account: Tensor) -> Iterator[None]:
        """Within the block the layers work with the cast weights."""
        borrowed = _Borrow.apply(self, account)
        try:
            self._put(borrowed)
            yield
        finally:
            self._put(self.own)

    def _put(self, weights: Sequence[Tensor]) -> None:
        for (parameters, name), weight in zip(self._places, weights, strict=True):
            parameters[name] = weight

    def take_in(self, gradients: tuple[Tensor | None, ...]) -> None:
        """A frame's gradients."""
        pairs = zip(self.cast, gradients, strict=True)
        together = torch.cat([_flat(torch.zeros_like(w) if g is None else g) for w, g in pairs])
        self._sum = together.float() if self._sum is None else self._sum.add_(together)

    def settle(self) -> list[Tensor]:
        """The sum of all gradients taken in, float32, one for each weight; 0 for one that no frame used."""
        assert self._sum is not None
        parts, self._sum = self._sum.split([weight.numel() for weight in self.cast]), None
        return [_unflat(part, weight) for part, weight in zip(parts, self.cast, strict=True)]


class _Account(torch.autograd.Function):
    """Stands between the weights and those who borrow them: on the way back it comes after all of these."""

    @staticmethod
    def forward(ctx: Any, loan: WeightLoan, *weights: Tensor) -> Tensor:
        ctx.loan = loan
        return weights[0].new_zeros(())

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return None, *ctx.loan.settle()


class _Borrow(torch.autograd.Function):
    """One frame's loan."""

    @staticmethod
    def forward(ctx: Any, loan: WeightLoan, account: Tensor) -> tuple[Tensor, ...]:
        ctx.loan = loan
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(account)
        return tuple(weight.detach() for weight in loan.cast)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[None, Tensor]:
        ctx.loan.take_in(gradients)
        (account,) = ctx.saved_tensors
        return None, torch.zeros_like(account)


def _flat(x: Tensor) -> Tensor:
    """In the order of memory, for a convolution's weights with channels last."""
    return x.permute(0, 2, 3, 1).reshape(-1) if x.ndim == 4 else x.reshape(-1)


def _unflat(flat: Tensor, like: Tensor) -> Tensor:
    if like.ndim != 4:
        return flat.view_as(like)
    outputs, inputs, height, width = like.shape
    return flat.view(outputs, height, width, inputs).permute(0, 3, 1, 2)
