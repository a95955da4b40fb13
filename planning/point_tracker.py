"""Following a point of a thing on the table from frame to frame, by what the camera sees.

The surface around the point in the first frame, as far as it hangs together, is a rigid piece of coloured point cloud.
In each further frame that piece is put where its colours and depths agree best with what is seen there. It is always
the first frame's piece, so that errors do not add up. Things on a table slide: the motion that is looked for is two
numbers of translation along the table and one of rotation about the vertical.

No model of the world and nothing of a simulator takes part. All controllers that plan with learned models follow
their point with it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy  # its parts load when they are used
from numpy.typing import NDArray

from envs.camera import CameraModel

Array = NDArray[np.float64]

COLOUR_SCALE, DEPTH_SCALE = 0.06, 0.006  # differences, in [0, 1] and metres, beyond which a pixel counts as an outlier
SURPRISE = np.array([0.015, 0.015, 0.15])  # m, m, rad: how far a motion may well be from that of the step before
IN_FRONT = 0.015  # m; a point is hidden where what is seen is so much nearer, and says nothing then
HIDDEN = 2.3  # disagreement of a hidden point: more than of one in sight, lest the piece flee behind things
SLOWING = 0.7  # share of the last motion that is expected to come again
POOR = 2.0  # mean disagreement of a point, squared, beyond which a fit may be wrong: a wide search is made
AGREES = 0.012  # m; a point of the piece is in sight where the depth seen is not farther off
MIN_POINTS = 4  # of the piece that must be in sight to say where it is seen


@dataclass(frozen=True, eq=False)
class Grid:
    """Motions (dx, dy, turn), evenly spaced; metres and radians.

    Attributes:
        motions: (N, 3).
        spacing: (3,) from one to the next.
    """

    motions: Array
    spacing: Array

    @classmethod
    def upto(cls, shift: float, turn: float, shifts: int, turns: int) -> Grid:
        """Up to `shift` metres along x and y, in so many steps each, and up to `turn` radians."""
        (along, pace), (around, angle) = (
            np.linspace(-end, end, count, retstep=True) for end, count in ((shift, shifts), (turn, turns))
        )
        return cls(np.array(list(itertools.product(along, along, around))), np.array([pace, pace, angle]))


NEARBY, WIDE = Grid.upto(0.018, 0.08, 5, 3), Grid.upto(0.045, 0.9, 9, 13)
"""Motions of one step that are tried: what a push does, and what happens where the tip catches in a corner."""


class PointTracker:
    """Follows one point.

    Args:
        camera: geometry of the camera that takes the frames.
        radius: metres around the point that the piece of surface extends at the most.
        step: metres of depth from pixel to pixel beyond which a surface ends.
        colour: how far colours, in [0, 1], may be from that at the point before the surface ends; 1 for any.
    """

    def __init__(self, camera: CameraModel, radius: float = 0.08, step: float = 0.01, colour: float = 1.0) -> None:
        self.camera, self.radius, self.step, self.colour = camera, radius, step, colour

    def reset(self, rgb: NDArray, depth: NDArray, point: Array) -> None:
        """Begin with the first frame.

        Args:
            rgb: (H, W, 3) uint8.
            depth: (H, W) metres.
            point: (3,) metres, world frame, on a surface that the camera sees.
        """
        seen = self.camera.to_world(self.camera.unproject(depth))
        distance = np.linalg.norm(seen - point, axis=-1)
        seed = np.unravel_index(np.argmin(distance), distance.shape)
        alike = np.abs(rgb / 255 - rgb[seed] / 255).max(axis=-1) <= self.colour
        piece = connected(depth, (int(seed[0]), int(seed[1])), alike & (distance <= self.radius), self.step)
        self._start = np.asarray(point, np.float64)
        self._offsets = seen[piece] - self._start  # (M, 3)
        self._colours = rgb[piece] / 255
        self._depth_scales = DEPTH_SCALE + bend(depth)[piece] / 2  # at an edge the next picture may show what is beyond
        self._motion, self._last = np.zeros(3), np.zeros(3)
        self._depth = depth

    def update(self, rgb: NDArray, depth: NDArray) -> None:
        """Take in the next frame: (H, W, 3) uint8 and (H, W) metres."""
        seen = np.dstack([rgb / 255, depth])
        motion, poorness = self._fit(seen, NEARBY)
        if poorness > POOR:
            motion = min((motion, poorness), self._fit(seen, WIDE), key=lambda fit: fit[1])[0]
        self._last, self._motion, self._depth = motion - self._motion, motion, depth

    def _fit(self, seen: Array, tries: Grid) -> tuple[Array, float]:
        """The motion (3,) since the first frame that agrees best, and how badly it still does.

        Args:
            seen: (H, W, 4) colours in [0, 1] and depth of the new frame.
            tries: motions since the last frame to start from.
        """
        expected = self._motion + SLOWING * self._last

        def disagreement(motion: Array) -> Array:
            return self._disagreement(motion[None], seen, expected)[0]

        starts = np.concatenate([expected[None], self._motion + tries.motions])
        start = starts[np.argmin(soft(self._disagreement(starts, seen, expected)).sum(axis=1))]
        room = tries.spacing  # to the neighbours of a start
        found = scipy.optimize.least_squares(
            disagreement, start, bounds=(start - room, start + room), loss="soft_l1", x_scale=SURPRISE, max_nfev=20,
            xtol=1e-4, ftol=1e-4,
        )  # fmt: skip
        return found.x, 2 * found.cost / len(self._offsets)

    @property
    def point(self) -> Array:
        """Where the point is now: (3,) metres, world frame."""
        return self._start + np.append(self._motion[:2], 0.0)

    def around(self, radius: float) -> Array:
        """Points (M, 3) of the piece within `radius` of the point that are in sight now, metres, world frame.

        All of those within it where next to none are in sight.
        """
        near = self._moved(self._motion[None])[0][np.linalg.norm(self._offsets, axis=-1) <= radius]
        points = self.camera.to_camera(near)
        u, v = np.rint(self.camera.project(points)).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < self.camera.width) & (v < self.camera.height)
        there = self._depth[v.clip(0, self.camera.height - 1), u.clip(0, self.camera.width - 1)]
        visible = inside & (np.abs(there - points[:, 2]) <= AGREES)
        return near[visible] if visible.sum() >= MIN_POINTS else near

    def _moved(self, motions: Array) -> Array:
        """The piece after each of some motions (N, 3), x, y and yaw: (N, M, 3), world frame."""
        cos, sin, zero = np.cos(motions[:, 2]), np.sin(motions[:, 2]), np.zeros(len(motions))
        turns = np.stack([cos, sin, zero, -sin, cos, zero, zero, zero, zero + 1], axis=-1).reshape(-1, 3, 3)
        shifts = np.column_stack([motions[:, :2], zero])
        return self._start + shifts[:, None] + self._offsets @ turns

    def _disagreement(self, motions: Array, seen: Array, expected: Array) -> Array:
        """What disagrees after each of some motions (N, 3): colours, depths, and how surprising it is: (N, 4 M + 3)."""
        colours, depths, hidden = self._differences(motions, seen)
        colours, depths = np.where(hidden[..., None], 0.0, colours), np.where(hidden, HIDDEN, depths)
        surprise = (motions - expected) / SURPRISE * np.sqrt(len(self._offsets)) / 2
        return np.concatenate([colours.reshape(len(motions), -1), depths, surprise], axis=1)

    def _differences(self, motions: Array, seen: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """What differs after motions (N, 3): colours (N, M, 3) and depths (N, M), scaled; which points are hidden."""
        points = self.camera.to_camera(self._moved(motions))
        there = read(seen, self.camera.project(points))
        colours = (there[..., :3] - self._colours) / (COLOUR_SCALE * np.sqrt(3))
        return colours, (there[..., 3] - points[..., 2]) / self._depth_scales, there[..., 3] < points[..., 2] - IN_FRONT


def soft(residuals: Array) -> Array:
    """SciPy's `soft_l1` loss: squares of small numbers, sizes of large ones."""
    return 2 * (np.sqrt(1 + residuals**2) - 1)


def read(picture: Array, pixels: Array) -> Array:
    """The values of a picture (H, W, C) between pixels (..., 2) u, v, linearly: (..., C). Its edge goes on outside."""
    height, width = picture.shape[:2]
    u, v = np.clip(pixels[..., 0], 0, width - 1), np.clip(pixels[..., 1], 0, height - 1)
    left, top = np.minimum(u.astype(int), width - 2), np.minimum(v.astype(int), height - 2)
    along, down = (u - left)[..., None], (v - top)[..., None]
    upper = picture[top, left] * (1 - along) + picture[top, left + 1] * along
    lower = picture[top + 1, left] * (1 - along) + picture[top + 1, left + 1] * along
    return upper * (1 - down) + lower * down


def bend(depth: NDArray) -> Array:
    """How far a depth image (H, W) is from a plane at each pixel: twice what the neighbours' mean is off, metres."""
    wide = np.pad(depth.astype(np.float64), 1, mode="edge")
    inner = 2 * wide[1:-1, 1:-1]
    return np.maximum(
        np.abs(wide[1:-1, :-2] + wide[1:-1, 2:] - inner), np.abs(wide[:-2, 1:-1] + wide[2:, 1:-1] - inner)
    )


def connected(depth: NDArray, seed: tuple[int, int], usable: NDArray[np.bool_], step: float) -> NDArray[np.bool_]:
    """The pixels of one surface.

    Args:
        depth: (H, W) metres.
        seed: row and column of a pixel on it.
        usable: (H, W) bool, what may belong to it.
        step: depth from a pixel to its neighbour beyond which they are of two surfaces, metres.

    Returns:
        (H, W) bool; the seed at least.
    """
    inside = np.zeros(depth.shape, bool)
    inside[seed] = True
    todo = [seed]
    while todo:
        row, column = todo.pop()
        for at in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
            if not (0 <= at[0] < depth.shape[0] and 0 <= at[1] < depth.shape[1]) or inside[at]:
                continue
            if usable[at] and abs(depth[at] - depth[row, column]) <= step:
                inside[at] = True
                todo.append(at)
    return inside
