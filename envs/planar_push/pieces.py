"""What an object is made of: outlines seen from above, cut into convex parts, and what follows for mass and clearance.

The frame of a side: x points outwards from the face of the centre piece, y along the face. The frame of an object: the
middle of the centre piece, the first side towards +x, the others counter-clockwise.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs.planar_push.objects import SHAPES, SIDES

HALF_WIDTH = 0.035  # m, of the centre piece and of every side
REACH = 0.035  # m, of every side outwards
BITE, HORN = 0.025, 0.006  # m, depth of the concave side, and width of what is left beside it
BITE_FACETS, ARC_FACETS = 8, 14  # straight pieces that make up the curves

Array = NDArray[np.float64]
Outline = Array
"""Corners (N, 2) of a convex polygon, counter-clockwise, metres."""


def centre_outline() -> Outline:
    """The square centre piece, in the frame of the object."""
    return HALF_WIDTH * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


@cache
def side_outlines(shape: str) -> tuple[Outline, ...]:
    """The convex parts of a side, in the frame of the side."""
    if shape == "rectangular":
        return (_trapezoid(-HALF_WIDTH, HALF_WIDTH, REACH, REACH),)
    if shape == "triangular":
        return (np.array([[0.0, -HALF_WIDTH], [REACH, 0.0], [0.0, HALF_WIDTH]]),)
    if shape == "circular":
        angle = np.linspace(-np.pi / 2, np.pi / 2, ARC_FACETS + 1)
        return (np.column_stack([REACH * np.cos(angle), HALF_WIDTH * np.sin(angle)]),)
    # Concave: a circular arc from horn to horn, strip by strip.
    mouth = HALF_WIDTH - HORN
    radius = (BITE**2 + mouth**2) / (2 * BITE)
    y = np.linspace(-mouth, mouth, BITE_FACETS + 1)
    x = REACH - BITE + radius - np.sqrt(radius**2 - y**2)
    strips = [_trapezoid(*y[i : i + 2], *x[i : i + 2]) for i in range(BITE_FACETS)]
    horns = [_trapezoid(low, low + HORN, REACH, REACH) for low in (-HALF_WIDTH, mouth)]
    return (*strips, *horns)


@cache
def side_area_and_centroid(shape: str) -> tuple[float, float]:
    """Area, m^2, and x of the centroid in the frame of the side, m; y is 0."""
    moments = [_moments(outline) for outline in side_outlines(shape)]
    area = sum(moment[0] for moment in moments)
    return area, sum(moment[0] * moment[1][0] for moment in moments) / area


def side_transform(side: int) -> tuple[Array, Array]:
    """Rotation (2, 2) and origin (2,) of side 0 to 3 in the frame of the object."""
    angle = 2 * np.pi * side / SIDES
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return rotation, HALF_WIDTH * rotation[:, 0]


@cache
def object_outlines(name: str) -> tuple[Outline, ...]:
    """The convex parts of a whole object, in its frame."""
    outlines = [centre_outline()]
    for side, digit in enumerate(name):
        rotation, origin = side_transform(side)
        outlines += [outline @ rotation.T + origin for outline in side_outlines(SHAPES[digit])]
    return tuple(outlines)


def clearance(name: str, points: ArrayLike) -> Array:
    """How far points are from an object.

    Args:
        name: of the object.
        points: (..., 2) in its frame, metres.

    Returns:
        (...) metres, 0 inside.
    """
    points = np.asarray(points, np.float64)[..., None, :]
    nearest = np.full(points.shape[:-2], np.inf)
    for outline in object_outlines(name):
        edge = np.roll(outline, -1, axis=0) - outline
        offset = points - outline  # (..., corners, 2)
        along = np.clip((offset * edge).sum(-1) / (edge**2).sum(-1), 0.0, 1.0)
        distance = np.linalg.norm(offset - along[..., None] * edge, axis=-1).min(-1)
        inside = (edge[:, 0] * offset[..., 1] - edge[:, 1] * offset[..., 0] >= 0).all(-1)
        nearest = np.minimum(nearest, np.where(inside, 0.0, distance))
    return nearest


def mass_properties(name: str, mass: float, weights: ArrayLike) -> tuple[float, Array, Array]:
    """Of an object of even density that carries a weight in the middle of each side.

    Args:
        name: of the object.
        mass: without the weights, kg.
        weights: (4,) kg.

    Returns:
        the whole mass, kg; the centre of mass (2,) in the frame of the object, m; and the second moments (2,) of the
        mass about it along x and y, kg m^2.
    """
    masses, centres, spreads = [], [], []
    for outline in object_outlines(name):
        area, centroid, spread = _moments(outline)
        masses.append(area)
        centres.append(centroid)
        spreads.append(spread)
    density = mass / sum(masses)
    masses = [density * area for area in masses]
    for side, weight in enumerate(np.asarray(weights, np.float64)):
        rotation, origin = side_transform(side)
        masses.append(weight)
        centres.append(origin + rotation[:, 0] * side_area_and_centroid(SHAPES[name[side]])[1])
        spreads.append(np.zeros(2))
    m, c = np.array(masses)[:, None], np.array(centres)
    centre = (m * c).sum(0) / m.sum()
    return float(m.sum()), centre, (m * (np.array(spreads) + (c - centre) ** 2)).sum(0)


def _trapezoid(low: float, high: float, reach_low: float, reach_high: float) -> Outline:
    return np.array([[0.0, low], [reach_low, low], [reach_high, high], [0.0, high]])


def _moments(outline: Outline) -> tuple[float, Array, Array]:
    """Area, centroid (2,), and mean squared distance (2,) from it along x and y, of a convex polygon."""
    a, b = outline, np.roll(outline, -1, axis=0)
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = cross.sum() / 2
    centroid = ((a + b) * cross[:, None]).sum(0) / (6 * area)
    second = ((a**2 + a * b + b**2) * cross[:, None]).sum(0) / (12 * area)
    return float(area), centroid, second - centroid**2
