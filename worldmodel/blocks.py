"""The layers that every model is made of: layer norm over a picture and the convolutional LSTM."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from worldmodel.compilation import compiled

LSTMState = tuple[Tensor, Tensor]
"""Hidden state in the precision that the network runs in and cell state in float32, each (B, C, H, W)."""


def layer_norm(channels: int) -> nn.Module:
    """Layer norm over (C, H, W) with one gain and bias a channel, as in CDNA's original code."""
    return nn.GroupNorm(1, channels)


class _Join(torch.autograd.Function):
    """`torch.cat` hands back slices, strided in memory, on which whatever comes next on the way back crawls: a ReLU's
    backward took 9 ms instead of 1. Copied out, each is dense."""

    @staticmethod
    def forward(ctx: Any, *features: Tensor) -> Tensor:
        ctx.channels = [f.shape[1] for f in features]
        return torch.cat(features, dim=1)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        parts = gradients[0].split(ctx.channels, dim=1)
        wanted = zip(parts, ctx.needs_input_grad, strict=True)
        return tuple(part.contiguous(memory_format=torch.channels_last) if needed else None for part, needed in wanted)


def join(*features: Tensor) -> Tensor:
    """Features (B, C_i, H, W) of one precision, side by side: (B, sum of C_i, H, W)."""
    joined: Tensor = _Join.apply(*features)
    return joined


class _Up(torch.autograd.Function):
    """A transposed convolution whose way back is made of plain ones: oneDNN's own for the gradient of its weights takes
    several times as long as the convolution's that computes the same."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight)
        return F.conv_transpose2d(x, weight, bias, stride=2, padding=1)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, weight = ctx.saved_tensors
        (gradient,) = gradients
        of_x = F.conv2d(gradient, weight, stride=2, padding=1)
        geometry = ((2, 2), (1, 1), (1, 1), False, (0, 0), 1)  # stride, padding, dilation; not transposed; one group
        wanted = (False, True, False)
        _, of_weight, _ = torch.ops.aten.convolution_backward(x, gradient, weight, None, *geometry, wanted)
        return of_x, of_weight, gradient.sum((0, 2, 3))


class Upsample(nn.ConvTranspose2d):
    """Transposed convolution 4 x 4 to twice the size."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, 4, stride=2, padding=1)

    def forward(self, x: Tensor, output_size: list[int] | None = None) -> Tensor:
        """`(B, inputs, H, W)` to `(B, outputs, 2H, 2W)`."""
        device = x.device.type
        weight, bias = self.weight, self.bias
        assert bias is not None
        if torch.is_autocast_enabled(device):  # which does not look into a function of one's own
            precision = torch.get_autocast_dtype(device)
            x, weight, bias = x.to(precision), weight.to(precision), bias.to(precision)
        return _Up.apply(x, weight, bias)


class PreciseLinear(nn.Linear):
    """A linear layer that runs in float32 whatever autocast says."""

    def forward(self, x: Tensor) -> Tensor:
        """`(..., inputs)` to `(..., outputs)`, float32."""
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.float())


def _tanh(x: Tensor) -> Tensor:
    """As a sigmoid, which is exact to 2e-7 and compiles to an exponential, three times as fast as C's tanh."""
    return 2 * torch.sigmoid(2 * x) - 1


def _activate(gates: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gates (B, 4C, H, W) to enter, candidate, forget, leave; float32.

    With channels last, a slice of the channels is strided in memory, and sigmoid and tanh crawl on it: eagerly they run
    on whole tensors.
    """
    gates = gates.float()
    enter, _, forget, leave = torch.sigmoid(gates).chunk(4, dim=1)
    candidate = gates.chunk(4, dim=1)[1].contiguous(memory_format=torch.channels_last)
    return enter, torch.tanh(candidate), forget, leave


def _activate_in_pieces(gates: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`_activate` as the compiler likes it: no tensor of all gates between, nothing is stored on the way."""
    pieces = (piece.contiguous(memory_format=torch.channels_last) for piece in gates.float().chunk(4, dim=1))
    enter, candidate, forget, leave = pieces
    return torch.sigmoid(enter), _tanh(candidate), torch.sigmoid(forget), torch.sigmoid(leave)


def _gates_forward(gates: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
    enter, candidate, forget, leave = _activate(gates)
    cell = forget * cell + enter * candidate
    return (leave * torch.tanh(cell)).to(gates.dtype), cell


@compiled
def _compiled_forward(gates: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
    enter, candidate, forget, leave = _activate_in_pieces(gates)
    cell = forget * cell + enter * candidate
    return (leave * _tanh(cell)).to(gates.dtype), cell


@compiled
def _gates_backward(gates: Tensor, cell: Tensor, of_hidden: Tensor, of_cell: Tensor) -> tuple[Tensor, Tensor]:
    enter, candidate, forget, leave = _activate_in_pieces(gates)
    shown = _tanh(forget * cell + enter * candidate)
    of_hidden = of_hidden.float()
    through = of_cell + of_hidden * leave * (1 - shown * shown)
    of_gates = (
        through * candidate * enter * (1 - enter),
        through * enter * (1 - candidate * candidate),
        through * cell * forget * (1 - forget),
        of_hidden * shown * leave * (1 - leave),
    )
    return torch.cat([piece.to(gates.dtype) for piece in of_gates], dim=1), through * forget


class _Gates(torch.autograd.Function):
    """Keeps gates and cell only and activates them again on the way back: less memory to write and read."""

    @staticmethod
    def forward(ctx: Any, gates: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(gates, cell)
        return _compiled_forward(gates, cell)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        gates, cell = ctx.saved_tensors
        of_hidden, of_cell = (g.contiguous(memory_format=torch.channels_last) for g in gradients)
        return _gates_backward(gates, cell, of_hidden, of_cell)


def lstm_gates(gates: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
    """The pointwise half of an LSTM.

    Args:
        gates: (B, 4C, H, W): input, candidate, forget, output.
        cell: (B, C, H, W) float32.

    Returns:
        The new hidden state, of the gates' precision, and the new cell state, float32.
    """
    if torch.is_grad_enabled() and (gates.requires_grad or cell.requires_grad):
        return _Gates.apply(gates, cell)
    return _gates_forward(gates, cell)


class ConvLSTM(nn.Module):
    """Convolutional LSTM (Shi et al. 2015), all gates from one convolution; at first it forgets little."""

    def __init__(self, inputs: int, channels: int, kernel: int = 5) -> None:
        super().__init__()
        self.channels = channels
        self.gates = nn.Conv2d(inputs + channels, 4 * channels, kernel, padding=kernel // 2)
        with torch.no_grad():  # remember, until training says otherwise
            self.gates.bias[2 * channels : 3 * channels] += 1.0  # type: ignore[index]

    def forward(self, x: Tensor, state: LSTMState) -> tuple[Tensor, LSTMState]:
        """One step: `(B, inputs, H, W)` to `(B, channels, H, W)` and the new state."""
        state = lstm_gates(self.gates(join(x, state[0])), state[1])
        return state[0], state
