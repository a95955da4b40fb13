"""`python -m worldmodel.action_columns --data DIR`: how much of the motion of joints each action column explains."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_collection.dataset import RGBDDataset
from envs.command import run
from envs.errors import UsageError
from worldmodel.clips import ACTION_COLUMNS, ClipSource

OUTCOME = "joint_delta"
SHARE_FITTED = 0.75


@dataclass(frozen=True)
class Config:
    """Fit the joints' motion over a frame gap by linear maps of each action column, and print what share of its
    variance they explain on episodes that were not fitted. The larger, the more a model is told by that column."""

    data: Path
    """Dataset with the column joint_delta, such as those of `collect-rollouts --env dexhand`."""
    gap: tuple[int, ...] = (1, 3)
    """Frame gaps."""

    def __post_init__(self) -> None:
        if not self.gap or min(self.gap) < 1:
            raise UsageError(f"gap is {self.gap}; give frame gaps of at least 1")


def main(config: Config) -> None:
    """Measure and print a line for each column.

    Raises:
        UsageError: the commands are not absolute.
    """
    dataset = RGBDDataset(config.data)
    if set(dataset.attrs["action_aggregation"]) != {"last"}:
        raise UsageError(f"the commands in {dataset.path} are not all absolute: there is only one way of telling them")
    told = [column for column in ACTION_COLUMNS if column != OUTCOME]
    shares = [explained(dataset, gap, told) for gap in config.gap]
    print("column", *(f"gap-{gap}" for gap in config.gap))
    for column in told:
        print(column, *(f"{share[column]:.2f}" for share in shares))


def explained(dataset: RGBDDataset, gap: int, columns: list[str]) -> dict[str, float]:
    """The share of the variance of the joints' motion that a linear map of each column explains, on other episodes.

    Raises:
        UsageError: too few episodes, or no joints in the data.
    """
    episodes = len(dataset.episode_slices)
    fitted = int(SHARE_FITTED * episodes)
    if not fitted:
        raise UsageError(f"{dataset.path} has {episodes} episode; some are to be fitted and others not: collect more")
    parts = [
        ClipSource(dataset, gap, episodes=part, action_column=OUTCOME, memory_limit=0)
        for part in (slice(0, fitted), slice(fitted, None))
    ]
    starts = [part.starts(2) for part in parts]
    outcomes = [part.actions_at(firsts, 2)[:, 0] for part, firsts in zip(parts, starts, strict=True)]
    shares = {}
    for column in columns:
        source = parts[0].with_actions(column)
        told = [source.actions_at(firsts, 2)[:, 0] for firsts in starts]
        shares[column] = _explained(told[0], outcomes[0], told[1], outcomes[1])
    return shares


def _explained(told: NDArray, outcome: NDArray, other_told: NDArray, other_outcome: NDArray) -> float:
    """1 - residual / variance on the other episodes, of the least-squares map with a constant."""
    mapped, *_ = np.linalg.lstsq(_with_one(told), outcome, rcond=None)
    residual = other_outcome - _with_one(other_told) @ mapped
    return float(1 - (residual**2).sum() / ((other_outcome - other_outcome.mean(0)) ** 2).sum())


def _with_one(rows: NDArray) -> NDArray:
    return np.column_stack((rows, np.ones(len(rows))))


if __name__ == "__main__":
    run(Config, main)
