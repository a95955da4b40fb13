"""The layers that every model is made of: layer norm over a picture and the convolutional LSTM."""

from __future__ import annotations

import torch
from torch import Tensor, nn

LSTMState = tuple[Tensor, Tensor]
"""Hidden state in the precision that the network runs in and cell state in float32, each (B, C, H, W)."""


def layer_norm(channels: int) -> nn.Module:
    """Layer norm over (C, H, W) with one gain and bias a channel, as in CDNA's original code."""
    return nn.GroupNorm(1, channels)


def lstm_gates(gates: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
    """The pointwise half of an LSTM.

    With channels last, a slice of the channels is strided in memory, and sigmoid and tanh crawl on it: they run on
    whole tensors here.

    Args:
        gates: (B, 4C, H, W): input, candidate, forget, output.
        cell: (B, C, H, W) float32.

    Returns:
        New hidden and cell state, float32.
    """
    gates = gates.float()
    channels = cell.shape[1]
    enter, _, forget, leave = torch.sigmoid(gates).chunk(4, dim=1)
    candidate = gates[:, channels : 2 * channels].contiguous(memory_format=torch.channels_last)
    cell = forget * cell + enter * torch.tanh(candidate)
    return leave * torch.tanh(cell), cell


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
        hidden, cell = lstm_gates(self.gates(torch.cat((x, state[0]), dim=1)), state[1])
        hidden = hidden.to(state[0].dtype)
        return hidden, (hidden, cell)
