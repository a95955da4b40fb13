"""The layers that every model is made of: layer norm over a picture and the convolutional LSTM."""

from __future__ import annotations

import torch
from torch import Tensor, nn

LSTMState = tuple[Tensor, Tensor]
"""Hidden and cell state, each (B, C, H, W)."""


def layer_norm(channels: int) -> nn.Module:
    """Layer norm over (C, H, W) with one gain and bias a channel, as in CDNA's original code."""
    return nn.GroupNorm(1, channels)


def lstm_gates(gates: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
    """The pointwise half of an LSTM; the forget gate has a bias of one.

    Args:
        gates: (B, 4C, H, W): input, candidate, forget, output.
        cell: (B, C, H, W).

    Returns:
        New hidden and cell state.
    """
    enter, candidate, forget, leave = gates.chunk(4, dim=1)
    cell = torch.sigmoid(forget + 1.0) * cell + torch.sigmoid(enter) * torch.tanh(candidate)
    return torch.sigmoid(leave) * torch.tanh(cell), cell


class ConvLSTM(nn.Module):
    """Convolutional LSTM (Shi et al. 2015), all gates from one convolution over input and hidden state."""

    def __init__(self, inputs: int, channels: int, kernel: int = 5) -> None:
        super().__init__()
        self.channels = channels
        self.gates = nn.Conv2d(inputs + channels, 4 * channels, kernel, padding=kernel // 2)

    def forward(self, x: Tensor, state: LSTMState) -> tuple[Tensor, LSTMState]:
        """One step: `(B, inputs, H, W)` to `(B, channels, H, W)` and the new state."""
        hidden, cell = lstm_gates(self.gates(torch.cat((x, state[0]), dim=1)), state[1])
        return hidden, (hidden, cell)
