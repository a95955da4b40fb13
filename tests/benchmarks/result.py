"""What a benchmark found, and all of it as a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Result:
    """One line of `bench.json`."""

    name: str
    value: float
    """What was measured, in `unit`."""
    unit: str
    against: str
    """What it is compared with: the number that it got in the same run, or the limit, and what it is."""
    ratio: float
    """How many times better the value is: larger rates, smaller times, less memory."""


def rate(name: str, value: float, unit: str, other: float, what: str) -> Result:
    """A result of which more is better."""
    return Result(name, value, unit, f"{_number(other)} {unit}: {what}", value / other)


def cost(name: str, value: float, unit: str, other: float, what: str) -> Result:
    """A result of which less is better."""
    return Result(name, value, unit, f"{_number(other)} {unit}: {what}", other / value)


def table(results: Sequence[Result]) -> str:
    """The results, one a line."""
    rows = [("benchmark", "value", "ratio", "against")]
    rows += [(r.name, f"{_number(r.value)} {r.unit}", f"{r.ratio:.1f}x", r.against) for r in results]
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    lines = [
        f"{name:<{widths[0]}}  {value:>{widths[1]}}  {ratio:>{widths[2]}}  {against}"
        for name, value, ratio, against in rows
    ]
    return "\n".join(lines)


def _number(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
