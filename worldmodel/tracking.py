"""Following the end-effector through predicted transforms.

The end-effector's point (TCP) lies between the fingers: what the camera sees in its direction is the background, or
the table. But a rigid transform moves any point of a body. So the TCP is moved by the transform of the *hand pixels*,
the visible points near it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

HAND_RADIUS = 0.06  # metres; visible points this near to the TCP are taken for the hand
MIN_HAND_PIXELS = 6  # of the fewest that a 64 x 64 picture shows of an unoccluded hand


def hand_pixels(points: Tensor, tcp: Tensor, radius: float = HAND_RADIUS, least: int = MIN_HAND_PIXELS) -> Tensor:
    """Which pixels show the hand: those whose point is within `radius` of the TCP.

    Where fewer than `least` are (the hand is hidden, or the TCP is far from any surface), the radius grows until it
    holds `least` of them.

    Args:
        points: (3, H, W) visible points, metres, in the frame of `tcp`.
        tcp: (3,) metres.
        radius: metres.
        least: pixels.

    Returns:
        indices: (M,) int64 into the H*W pixels, row by row; M >= `least`.
    """
    distance = (points - tcp[:, None, None]).norm(dim=0).flatten()
    near = (distance <= radius).nonzero().squeeze(1)
    if len(near) >= least:
        return near
    return distance.topk(least, largest=False).indices


@dataclass(frozen=True, eq=False)
class HandTrack:
    """The TCP and the hand's points in N imagined futures; camera frame, metres.

    Attributes:
        tcp: (N, 3).
        points: (N, M, 3).
        K: (3, 3) intrinsics, pixel centres at integers.
    """

    tcp: Tensor
    points: Tensor
    K: Tensor

    @classmethod
    def start(cls, points: Tensor, tcp: Tensor, K: Tensor, futures: int, radius: float = HAND_RADIUS) -> HandTrack:
        """Choose the hand's pixels in the last observed frame.

        Args:
            points: (3, H, W) unprojected depth, metres.
            tcp: (3,) metres, camera frame.
            K: (3, 3).
            futures: N.
            radius: metres; see `hand_pixels`.
        """
        hand = points.flatten(1)[:, hand_pixels(points, tcp, radius)].T  # (M, 3)
        return cls(tcp.expand(futures, 3), hand.expand(futures, *hand.shape), K)

    def advance(self, transform: Tensor) -> HandTrack:
        """One predicted step on.

        Reads the transforms where the hand's points project to (between pixels: linearly), moves each point by its
        own, and the TCP by their mean.

        Args:
            transform: (N, 3, 4, H, W) blended rigid transform of each pixel, camera frame.
        """
        height, width = transform.shape[-2:]
        rays = self.points @ self.K.T  # (N, M, 3)
        pixels = rays[..., :2] / rays[..., 2:].clamp(min=1e-6)
        grid = 2 * pixels / torch.tensor([width - 1, height - 1], dtype=pixels.dtype, device=pixels.device) - 1
        fields = transform.flatten(1, 2).to(pixels.dtype)
        read = grid_sample(fields, grid[:, :, None], padding_mode="border", align_corners=True)  # (N, 12, M, 1)
        read = read.squeeze(-1).transpose(1, 2).unflatten(2, (3, 4))  # (N, M, 3, 4)
        points = (read[..., :3] @ self.points[..., None]).squeeze(-1) + read[..., 3]
        mean = read.mean(dim=1)
        tcp = (mean[..., :3] @ self.tcp[..., None]).squeeze(-1) + mean[..., 3]
        return HandTrack(tcp, points, self.K)
