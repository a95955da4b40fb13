"""CDNA's trunk, shared by all models: an encoder to the motion embedding and decoders back to pictures.

One thing is added to the paper's: its decoders see the frame at half of its resolution at best, so that no mask can
follow a silhouette to the pixel, and nearly all false motion lies on the rim of what moves. Here a few features of the
frame at full resolution join the last layer (`fine_skip`), of T3VIP and of its rivals.
"""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional as F

from worldmodel.blocks import ConvLSTM, LSTMState, Upsample, join, layer_norm
from worldmodel.config import ModelConfig

STRIDE = 8
"""The motion embedding is this much smaller than the picture."""


Skips = list[Tensor]
"""What a decoder sees of the frame besides the motion embedding, the finest first."""


def scaled(channels: int, width: float) -> int:
    """A layer's channels under the width multiplier, a multiple of 8."""
    return max(8, round(channels * width / 8) * 8)


def fine_channels(config: ModelConfig) -> int:
    """Of the skip at full resolution."""
    return scaled(16, config.width)


class Encoder(nn.Module):
    """Frame, action and latent to the motion embedding (Finn et al. 2016, with T3VIP's channel counts).

    conv 5x5/2 -> 32; ConvLSTM 32, 32; conv 3x3/2 -> 64; ConvLSTM 64, 64; conv 3x3/2 -> 128; the action and the latent
    are tiled and joined by a 1x1 conv; ConvLSTM 128. A layer norm follows the first convolution and every LSTM.
    """

    def __init__(self, inputs: int, action_dim: int, latent_channels: int, config: ModelConfig) -> None:
        super().__init__()
        lstm_kernel = config.lstm_kernel
        small, middle, large = (scaled(c, config.width) for c in (32, 64, 128))
        self.fine = nn.Conv2d(inputs, fine_channels(config), 3, padding=1) if config.fine_skip else None
        self.channels = (small, middle, large)
        self.conv0 = nn.Conv2d(inputs, small, 5, stride=2, padding=2)
        self.norm0 = layer_norm(small)
        self.lstm1 = ConvLSTM(small, small, lstm_kernel)
        self.lstm2 = ConvLSTM(small, small, lstm_kernel)
        self.conv1 = nn.Conv2d(small, middle, 3, stride=2, padding=1)
        self.lstm3 = ConvLSTM(middle, middle, lstm_kernel)
        self.lstm4 = ConvLSTM(middle, middle, lstm_kernel)
        self.conv2 = nn.Conv2d(middle, large, 3, stride=2, padding=1)
        self.join = nn.Conv2d(large + action_dim + latent_channels, large, 1)
        self.lstm5 = ConvLSTM(large, large, lstm_kernel)
        self.norm1, self.norm2 = layer_norm(small), layer_norm(small)
        self.norm3, self.norm4 = layer_norm(middle), layer_norm(middle)
        self.norm5 = layer_norm(large)

    def look(self, frame: Tensor, states: list[LSTMState]) -> tuple[Tensor, Skips, list[LSTMState]]:
        """The part that knows no action yet, and so is the same for all futures of a frame.

        Args:
            frame: (B, inputs, H, W), H and W multiples of 8.
            states: of the first four LSTMs.

        Returns:
            Features (B, 128w, H/8, W/8), the skips at the full size (if any), 1/2 and 1/4 of it, the new states.
        """
        fine = [] if self.fine is None else [F.relu(self.fine(frame))]
        skip0 = self.norm0(F.relu(self.conv0(frame)))
        x, state1 = self.lstm1(skip0, states[0])
        x, state2 = self.lstm2(self.norm1(x), states[1])
        skip1 = F.relu(self.conv1(self.norm2(x)))
        x, state3 = self.lstm3(skip1, states[2])
        x, state4 = self.lstm4(self.norm3(x), states[3])
        x = F.relu(self.conv2(self.norm4(x)))
        return x, [*fine, skip0, skip1], [state1, state2, state3, state4]

    def act(
        self, features: Tensor, action: Tensor, latent: Tensor | None, state: LSTMState
    ) -> tuple[Tensor, LSTMState]:
        """Join what was seen with what is done.

        Args:
            features: (B, 128w, H/8, W/8), from `look`.
            action: (B, A), normalised; A may be 0.
            latent: (B, Z, H/8, W/8) or None for a model without latents.
            state: of the fifth LSTM.

        Returns:
            The motion embedding (B, 128w, H/8, W/8) and the new state.
        """
        tiled = action[:, :, None, None].to(features.dtype).expand(-1, -1, *features.shape[2:])
        joined = [features, tiled] if latent is None else [features, tiled, latent.to(features.dtype)]
        x, state = self.lstm5(F.relu(self.join(join(*joined))), state)
        return self.norm5(x), state


class Decoder(nn.Module):
    """Motion embedding back to a picture: deconv, ConvLSTM 64, skip, deconv, ConvLSTM 32, skip, deconv, 1x1 conv.

    With `fine_skip` a skip and a conv 3x3 come before the last.
    """

    def __init__(self, outputs: int, config: ModelConfig) -> None:
        super().__init__()
        lstm_kernel = config.lstm_kernel
        small, middle, large = (scaled(c, config.width) for c in (32, 64, 128))
        self.up1 = Upsample(large, middle)
        self.lstm6 = ConvLSTM(middle, middle, lstm_kernel)
        self.norm6 = layer_norm(middle)
        self.up2 = Upsample(2 * middle, small)
        self.lstm7 = ConvLSTM(small, small, lstm_kernel)
        self.norm7 = layer_norm(small)
        self.up3 = Upsample(2 * small, small)
        self.refine = nn.Conv2d(small + fine_channels(config), small, 3, padding=1) if config.fine_skip else None
        self.norm8 = layer_norm(small)
        self.head = nn.Conv2d(small, outputs, 1)

    def forward(self, embedding: Tensor, skips: Skips, states: list[LSTMState]) -> tuple[Tensor, list[LSTMState]]:
        """Decode to `(B, outputs, H, W)`, no activation; `states` are those of the two LSTMs."""
        *fine, skip0, skip1 = skips
        x, state6 = self.lstm6(F.relu(self.up1(embedding)), states[0])
        x = join(self.norm6(x), skip1)
        x, state7 = self.lstm7(F.relu(self.up2(x)), states[1])
        x = join(self.norm7(x), skip0)
        x = F.relu(self.up3(x))
        if self.refine is not None:
            x = F.relu(self.refine(join(x, *fine)))
        return self.head(self.norm8(x)), [state6, state7]
