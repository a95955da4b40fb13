"""The 70 objects: necklaces of four sides, each of one of four shapes, and their split into train, validation and test.

A name has four digits, the shapes of the sides counter-clockwise as seen from above. An object may be turned: "1132",
"1321", "3211" and "2113" are one object; its canonical name is the least of them.
"""

from __future__ import annotations

import hashlib
import itertools

from envs.errors import UsageError

SHAPES = {"1": "concave", "2": "triangular", "3": "rectangular", "4": "circular"}
"""Digit -> shape of a side; the digits are Omnipush's."""
SIDES = 4
SPLIT_SIZES = {"train": 50, "validation": 10, "test": 10}  # objects; the paper's
SPLIT_SEED = 0


def canonical(name: str) -> str:
    """The least rotation of a name.

    Raises:
        UsageError: not a name of four sides.
    """
    if not isinstance(name, str) or len(name) != SIDES or not set(name) <= set(SHAPES):
        meaning = ", ".join(f"{digit} {shape}" for digit, shape in SHAPES.items())
        raise UsageError(f"no object {name!r}; give four digits, one for each side: {meaning}")
    return min(name[turn:] + name[:turn] for turn in range(SIDES))


def from_omnipush(name: str) -> str:
    """The canonical name of an object of Omnipush, such as "1a1a3a2a": digits are shapes, letters are weights.

    Raises:
        UsageError: not such a name.
    """
    if not isinstance(name, str) or len(name) != 2 * SIDES or not name[1::2].isalpha():
        raise UsageError(f"no object {name!r} in Omnipush; give four times a digit and a letter, such as '1a1a3a2a'")
    return canonical(name[::2])


def _shuffled(names: tuple[str, ...]) -> list[str]:
    """In an order that is the same with every version of every package."""
    return sorted(names, key=lambda name: hashlib.sha256(f"{SPLIT_SEED}:{name}".encode()).digest())


def _split(names: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    order = iter(_shuffled(names))
    return {split: tuple(sorted(itertools.islice(order, size))) for split, size in SPLIT_SIZES.items()}


OBJECTS = tuple(sorted({canonical("".join(digits)) for digits in itertools.product(SHAPES, repeat=SIDES)}))
"""Canonical names of all objects, in order; an object's number is its place here."""
SPLITS = _split(OBJECTS)
"""Split -> names of its objects."""


def objects_of(split: str) -> tuple[str, ...]:
    """The objects of "train", "validation", "test", or "all".

    Raises:
        UsageError: no such split.
    """
    if split == "all":
        return OBJECTS
    if split not in SPLITS:
        raise UsageError(f"no split {split!r}; choose one of {', '.join(SPLITS)}, all")
    return SPLITS[split]
