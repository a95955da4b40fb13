"""Following points through predicted transforms.

The end-effector's point (TCP) lies between the fingers: what the camera sees in its direction is the background, or
the table. But a rigid transform moves any point of a body. So the TCP is moved by the transform of the *hand pixels*,
the visible points near it (`HandTrack`).

A point on the surface of a thing is moved as the points around it are, each by its own transform (`SurfaceTrack`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

HAND_RADIUS = 0.06  # metres; visible points this near to the TCP are taken for the hand
LEAST_FOREGROUND = 0.02  # below this share of anything that moves, the hand counts as still
MIN_HAND_PIXELS = 6  # of the fewest that a 64 x 64 picture shows of an unoccluded hand


def hand_pixels(points: Tensor, tcp: Tensor) -> Tensor:
    """Which pixels show the hand: those whose point is within HAND_RADIUS of the TCP.

    Where fewer than MIN_HAND_PIXELS are (the hand is hidden, or the TCP is far from any surface), the radius grows
    until it holds as many.

    Args:
        points: (3, H, W) visible points, metres, in the frame of `tcp`.
        tcp: (3,) metres.

    Returns:
        indices: (M,) int64 into the H*W pixels, row by row.
    """
    distance = (points - tcp[:, None, None]).norm(dim=0).flatten()
    near = (distance <= HAND_RADIUS).nonzero().squeeze(1)
    if len(near) >= MIN_HAND_PIXELS:
        return near
    return distance.topk(MIN_HAND_PIXELS, largest=False).indices


def tcp_way(points: Tensor, tcp: Tensor, K: Tensor, steps: Iterable[tuple[Tensor, Tensor]]) -> Tensor:
    """Where predictions take the TCP in one future, by `HandTrack`; camera frame, metres.

    Args:
        points: (3, H, W) what is seen in the last observed frame.
        tcp: (3,) then.
        K: (3, 3) intrinsics.
        steps: of each of P predictions the blended transform (1, 3, 4, H, W) and the background's mask (1, 1, H, W).

    Returns:
        (P+1, 3), from where it was seen on.
    """
    track = HandTrack.start(points.flatten(1)[:, hand_pixels(points, tcp)].T, tcp, K, 1)
    way = [track.tcp]
    for transform, background in steps:
        track = track.advance(transform, background)
        way.append(track.tcp)
    return torch.cat(way)


class Track(Protocol):
    """A point in N imagined futures; camera frame, metres."""

    def advance(self, transform: Tensor, background: Tensor) -> Track:
        """One predicted step on.

        Args:
            transform: (N, 3, 4, H, W) blended rigid transform of each pixel, camera frame.
            background: (N, 1, H, W) the mask of the background, which never moves.
        """

    def expected_position(self) -> Tensor:
        """(N, 3)."""

    def expected_distance(self, goal: Tensor) -> Tensor:
        """(N,), to a goal (3,)."""


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
    def start(cls, points: Tensor, tcp: Tensor, K: Tensor, futures: int) -> HandTrack:
        """Follow the TCP (3,) by the hand's points (M, 3)."""
        return cls(tcp.expand(futures, 3), points.expand(futures, *points.shape), K)

    def advance(self, transform: Tensor, background: Tensor) -> HandTrack:
        """One predicted step on.

        Reads transforms and background mask where the hand's points are seen, and moves the points and the TCP as one
        body. Among the pixels near the hand some show the table behind it, and the mask of the hand is soft: a plain
        mean of the transforms would lag behind. The blended transform of a pixel is A = b I + (1 - b) M with b its
        background mask; so M, the motion of what moves there, is the mean of A - b I over the mean of 1 - b. Where next
        to nothing moves, M goes over into the identity.

        Args:
            transform: (N, 3, 4, H, W) blended rigid transform of each pixel, camera frame.
            background: (N, 1, H, W) the mask of the background, which never moves.
        """
        mean = _seen_at(self.points, self.K, torch.cat((transform.flatten(1, 2), background), dim=1)).mean(dim=1)
        still = torch.eye(3, 4, dtype=mean.dtype, device=mean.device)
        behind = mean[:, 12, None, None].clamp(max=1 - LEAST_FOREGROUND)
        motion = (mean[:, :12].unflatten(1, (3, 4)) - behind * still) / (1 - behind)  # (N, 3, 4)
        turn, shift = motion[..., :3].mT, motion[..., 3]
        points = self.points @ turn + shift[:, None]
        tcp = (self.tcp[:, None] @ turn)[:, 0] + shift
        return HandTrack(tcp, points, self.K)

    def expected_position(self) -> Tensor:
        """(N, 3), the TCP."""
        return self.tcp

    def expected_distance(self, goal: Tensor) -> Tensor:
        """(N,), of the TCP to a goal (3,)."""
        return (self.tcp - goal).norm(dim=-1)


@dataclass(frozen=True, eq=False)
class SurfaceTrack:
    """Points of a surface in N imagined futures, and where each says that the followed one is; camera frame, metres.

    Attributes:
        points: (N, M, 3).
        claims: (N, M, 3), the followed point, moved as each of them is. As long as they move as one body, they agree.
        K: (3, 3) intrinsics, pixel centres at integers.
    """

    points: Tensor
    claims: Tensor
    K: Tensor

    @classmethod
    def start(cls, points: Tensor, point: Tensor, K: Tensor, futures: int) -> SurfaceTrack:
        """Follow `point` (3,) by the points (M, 3) around it."""
        shape = (futures, *points.shape)
        return cls(points.expand(shape), point.expand(shape), K)

    def advance(self, transform: Tensor, background: Tensor) -> SurfaceTrack:
        """One predicted step on: each point and its claim go by the blended transform that is seen at the point.

        A thing may stand still while the end-effector moves beside it. What little of that is blended into the thing's
        pixels must not be taken for its motion, so that the background is not set apart here.

        Args:
            transform: (N, 3, 4, H, W) blended rigid transform of each pixel, camera frame.
            background: not used.
        """
        motion = _seen_at(self.points, self.K, transform.flatten(1, 2)).unflatten(2, (3, 4))  # (N, M, 3, 4)
        turn, shift = motion[..., :3], motion[..., 3]
        points, claims = ((turn @ of[..., None]).squeeze(-1) + shift for of in (self.points, self.claims))
        return SurfaceTrack(points, claims, self.K)

    def expected_position(self) -> Tensor:
        """(N, 3), the mean claim."""
        return self.claims.mean(dim=1)

    def expected_distance(self, goal: Tensor) -> Tensor:
        """(N,), the mean distance of the claims to a goal (3,).

        Where they go apart, the model does not know where the thing goes, and this is more than the distance of their
        mean, as a pixel's expected distance is for models of pictures. The distance of the mean would be small in a
        future in which half of a thing flies past the goal while the other half stays.
        """
        return (self.claims - goal).norm(dim=-1).mean(dim=1)


def _seen_at(points: Tensor, K: Tensor, fields: Tensor) -> Tensor:
    """Fields (N, C, H, W), linearly between pixels, where points (N, M, 3) project to: (N, M, C)."""
    height, width = fields.shape[-2:]
    rays = points @ K.T
    pixels = rays[..., :2] / rays[..., 2:].clamp(min=1e-6)
    grid = 2 * pixels / torch.tensor([width - 1, height - 1], dtype=pixels.dtype, device=pixels.device) - 1
    read = grid_sample(fields.to(pixels.dtype), grid[:, :, None], padding_mode="border", align_corners=True)
    return read.squeeze(-1).mT
