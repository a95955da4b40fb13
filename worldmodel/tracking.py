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
LEAST_FOREGROUND = 0.02  # below this share of anything that moves, the hand counts as still
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
        least: below this share of anything that moves, the body counts as still; 1 for blended transforms as they are.
    """

    tcp: Tensor
    points: Tensor
    K: Tensor
    least: float = LEAST_FOREGROUND

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

    def advance(self, transform: Tensor, background: Tensor) -> HandTrack:
        """One predicted step on.

        Reads transforms and background mask where the hand's points project to (between pixels: linearly), and moves
        the points and the TCP as one body. Among the pixels near the hand some show the table behind it, and the mask
        of the hand is soft: a plain mean of the transforms would lag behind. The blended transform of a pixel is
        A = b I + (1 - b) M with b its background mask; so M, the motion of what moves there, is the mean of A - b I
        over the mean of 1 - b. Where next to nothing moves, M goes over into the identity.

        Args:
            transform: (N, 3, 4, H, W) blended rigid transform of each pixel, camera frame.
            background: (N, 1, H, W) the mask of the background, which never moves.
        """
        height, width = transform.shape[-2:]
        rays = self.points @ self.K.T  # (N, M, 3)
        pixels = rays[..., :2] / rays[..., 2:].clamp(min=1e-6)
        grid = 2 * pixels / torch.tensor([width - 1, height - 1], dtype=pixels.dtype, device=pixels.device) - 1
        fields = torch.cat((transform.flatten(1, 2), background), dim=1).to(pixels.dtype)
        read = grid_sample(fields, grid[:, :, None], padding_mode="border", align_corners=True)  # (N, 13, M, 1)
        mean = read.squeeze(-1).mean(dim=2)  # (N, 13)
        still = torch.eye(3, 4, dtype=mean.dtype, device=mean.device)
        behind = mean[:, 12, None, None].clamp(max=1 - self.least)
        motion = (mean[:, :12].unflatten(1, (3, 4)) - behind * still) / (1 - behind)  # (N, 3, 4)
        turn, shift = motion[..., :3].mT, motion[..., 3]
        points = self.points @ turn + shift[:, None]
        tcp = (self.tcp[:, None] @ turn)[:, 0] + shift
        return HandTrack(tcp, points, self.K, self.least)
