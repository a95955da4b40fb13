"""The four play tables as data: where the fixtures are, how large each block is, what everything looks like.

Places are CALVIN's, in metres after its global scale of 0.8. Every table is 0.84 m wide, its top 0.44 m above the
floor; the robot stands in front of it (-y), to its left.
"""

from __future__ import annotations

from dataclasses import dataclass

from envs.errors import UsageError

RGB = tuple[float, float, float]


@dataclass(frozen=True)
class Wood:
    """A procedural wood: two colours in [0, 1], the number of growth rings across a face, and a seed."""

    light: RGB
    dark: RGB
    rings: float
    seed: int


@dataclass(frozen=True)
class Layout:
    """One play table; x coordinates in metres, in the world frame."""

    button_x: float
    """The button, and the green LED it toggles."""
    switch_x: float
    """The switch, and the yellow bulb it lights."""
    door_x: float
    """The handle of the closed sliding door, at the left edge of the door."""
    door_travel: float
    """How far the door slides to the left; also its width."""
    drawer_x: float
    """The middle of the drawer."""
    block_lengths: tuple[float, float, float]
    """Length of the red, the blue and the pink block; their other two sides are 0.04 m."""
    body: Wood
    door: Wood


SMALL, MIDDLE, BIG = 0.040, 0.056, 0.080

_DARK = Wood((0.40, 0.25, 0.16), (0.26, 0.15, 0.09), 5.0, 1)
_ESPRESSO = Wood((0.42, 0.37, 0.35), (0.29, 0.25, 0.24), 8.0, 2)
_SLATE = Wood((0.36, 0.44, 0.50), (0.26, 0.33, 0.38), 6.0, 3)
_MAPLE = Wood((0.86, 0.74, 0.56), (0.76, 0.62, 0.43), 4.0, 4)
_BIRCH = Wood((0.93, 0.85, 0.71), (0.85, 0.74, 0.57), 7.0, 5)
_OAK = Wood((0.74, 0.51, 0.29), (0.60, 0.38, 0.20), 5.0, 6)

LAYOUTS = {
    "A": Layout(-0.28, 0.30, -0.10, 0.280, 0.10, (MIDDLE, BIG, SMALL), _DARK, _DARK),
    "B": Layout(0.28, -0.32, 0.088, 0.304, 0.18, (SMALL, BIG, MIDDLE), _MAPLE, _BIRCH),
    "C": Layout(-0.12, -0.32, 0.06, 0.240, 0.10, (BIG, SMALL, MIDDLE), _OAK, _DARK),
    "D": Layout(-0.12, 0.30, -0.10, 0.280, 0.18, (MIDDLE, SMALL, BIG), _ESPRESSO, _SLATE),
}


def layout(scene: str) -> Layout:
    """The layout of scene "A", "B", "C" or "D"."""
    if scene not in LAYOUTS:
        raise UsageError(f"there is no scene {scene!r}; choose one of {', '.join(LAYOUTS)}")
    return LAYOUTS[scene]
