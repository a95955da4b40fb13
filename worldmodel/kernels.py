"""The rivals that move pixels in the picture: CDNA, SNA and SV2P.

All three predict the next RGB frame as a blend, by masks that sum to 1, of the current frame, the current frame
convolved with K predicted kernels, a generated picture, and (SNA, SV2P) the first frame of the clip. They share trunk,
recurrent states, trainer, data and metrics with T3VIP and know nothing of depth.

Followed in all of them, and why not:
- Kernels are rectified and normalised to sum 1, as in Finn et al. (2016). Their released code pairs 11 transformed
  pictures with 10 masks, so that its last kernel is never used, and T3VIP's released code counts one mask twice, so
  that its pictures come out too bright; here every source has one mask.
- Kernels start with more weight on the pixel itself than on any other (of 5 x 5 a third, of 15 x 15 a sixteenth), and
  the action enters their head as it enters T3VIP's, so that motion emerges soon: no rival shall lose for want of it.
  As the identity alone they learn later: all are alike then, and a mask between them has nothing to choose from.
- 5 x 5 kernels, as in the originals, move a pixel by 2 at the most. Over a frame gap of 3 an arm goes farther than 4 in
  13 % of the data, farther than 7 in 0.7 % (and in 16 % of the moves that a plan samples), so 15 x 15, which reach 7,
  is the default here; `kernel_size` 5 gives the originals'.
- The originals feed the robot's state and predict it again; no model here sees proprioception.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from worldmodel.advection import advect
from worldmodel.blocks import LSTMState, PreciseLinear
from worldmodel.config import ModelConfig, ModelContext
from worldmodel.trunk import Decoder, scaled
from worldmodel.world_model import Prediction, WorldModel

LEAST_WEIGHT = 1e-6
"""Of a kernel before it is normalised, so that its sum is never 0."""


@dataclass(frozen=True)
class KernelPrediction(Prediction):
    """What a kernel model predicts. Its masks are those of the current frame, the K kernels, the generated picture and,
    where the model copies from it, the first frame, in this order."""

    kernels: Tensor
    """(B, K, S, S), each sums to 1; entry (i, j) is the weight of the pixel i - S // 2 rows down, j - S // 2 columns
    to the right of the one that is made."""


class KernelHeads(NamedTuple):
    """What the network says about the next frame."""

    logits: Tensor
    """(B, sources, H, W) of the masks."""
    generated: Tensor
    """(B, 3, H, W) logits of the generated picture."""
    kernels: Tensor
    """(B, K, S, S), normalised."""


class KernelHead(nn.Module):
    """Motion embedding and action to K normalised kernels, at first random but for the pixel itself, which has most."""

    def __init__(self, inputs: int, action_dim: int, count: int, size: int, width: float) -> None:
        super().__init__()
        wide, narrow = scaled(256, width), scaled(128, width)
        self.count, self.size = count, size
        self.first = nn.Linear(inputs, wide)
        self.second = nn.Linear(wide + action_dim, narrow)
        self.last = PreciseLinear(narrow + action_dim, count * size**2)
        with torch.no_grad():
            self.last.bias.view(count, size, size)[:, size // 2, size // 2] += 1.0

    def forward(self, embedding: Tensor, action: Tensor) -> Tensor:
        """Returns (B, K, S, S) float32."""
        x = F.relu(self.first(embedding.flatten(1)))
        x = F.relu(self.second(torch.cat((x, action.to(x.dtype)), dim=1)))
        x = self.last(torch.cat((x.float(), action.float()), dim=1)).unflatten(1, (self.count, -1))
        with torch.autocast(x.device.type, enabled=False):
            x = F.relu(x - LEAST_WEIGHT) + LEAST_WEIGHT
            return (x / x.sum(-1, keepdim=True)).unflatten(-1, (self.size, self.size))


class KernelModel(WorldModel):
    """What CDNA, SNA and SV2P have in common."""

    frame_channels = 3
    decoders = 1

    def __init__(self, config: ModelConfig, context: ModelContext) -> None:
        super().__init__(config, context)
        self.kernel_count = config.masks
        self.sources = self.kernel_count + (3 if self.copies_first else 2)
        self.decoder = Decoder(self.sources + 3, config)
        self.kernel_head = KernelHead(
            self.embedding_size, self.action_dim, self.kernel_count, config.kernel_size, config.width
        )
        nn.init.normal_(self.decoder.head.weight[: self.sources], std=config.mask_head_std)

    def network(
        self, frame: Tensor, action: Tensor, latent: Tensor | None, states: list[LSTMState], paint: bool
    ) -> tuple[KernelHeads, list[LSTMState]]:
        embedding, skips, seen, states = self.embed(frame, action, latent, states)
        decoded, states = self.decoder(embedding, skips, states)
        logits, generated = decoded.split((self.sources, 3), dim=1)
        return KernelHeads(logits, generated, self.kernel_head(embedding, action)), [*seen, *states]

    def render(
        self, rgb: Tensor, depth: Tensor, heads: KernelHeads, first: Tensor | None, still: bool, picture: bool = True
    ) -> KernelPrediction:
        """Blend the sources by their masks; `still` makes every kernel a copy."""
        kernels = heads.kernels
        if still:
            kernels = torch.zeros_like(kernels)
            kernels[..., kernels.shape[-2] // 2, kernels.shape[-1] // 2] = 1
        masks = torch.softmax(heads.logits.float(), dim=1)
        if not picture:
            return KernelPrediction(rgb, masks, None, kernels)
        now, moving, generated = masks[:, :1], masks[:, 1 : 1 + self.kernel_count], masks[:, 1 + self.kernel_count :]
        blend = now * rgb + generated[:, :1] * torch.sigmoid(heads.generated.float())
        blend = blend + advect(rgb, moving, kernels)
        if first is not None:
            blend = blend + generated[:, 1:] * first
        return KernelPrediction(blend, masks, None, kernels)


class CDNA(KernelModel):
    """Convolutional dynamic neural advection (Finn, Goodfellow and Levine 2016): deterministic, 10 kernels, one
    generated picture. Both are the original's; T3VIP's released code has 9 kernels and generates nothing."""

    kind = "cdna"


class SNA(KernelModel):
    """Skip-connection neural advection (Ebert et al. 2017): CDNA that may copy from the first frame, so that what was
    hidden for a while comes back. The original lets the first frame take the place of the current one as background;
    here, as in T3VIP's released code, it is one more source: it can do all that the original can."""

    kind = "sna"
    copies_first = True


class SV2P(KernelModel):
    """Stochastic variational video prediction (Babaeizadeh et al. 2018): a latent map joins the motion embedding,
    inferred from the whole clip in training, reparameterised as in the paper (T3VIP's released code cuts that gradient
    off). At test time the paper draws it from N(0, I); here it is 0 unless one is given. Copies from the first frame as
    in T3VIP's released code, where the original does not; it does SV2P no harm and helps against static cameras. One
    latent a step by default; the original's one a clip is `latents` clip."""

    kind = "sv2p"
    copies_first = True
