"""Clips of a dataset: frames a gap apart with the actions between them added up, never dropped.

Pictures are held in memory where they fit, and else read from the shards by range, a clip at a time. What is small,
such as actions and poses, is always held.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import scipy  # its parts load when they are used
import torch
from numpy.typing import NDArray
from torch import Tensor

from data_collection.actions import aggregate_actions
from data_collection.dataset import RGBDDataset
from envs import ground_truth
from envs.errors import UsageError

ACTION_COLUMNS = ("action", "action_change", "action_followed", "joint_delta")
"""What a model may be conditioned on: what was commanded; by how much absolute commands differ from those before them;
how far a follower of absolute commands goes, that lags behind them; or how far each joint went, which tells of the
outcome."""
FOLLOWING_SECONDS = 0.13
"""Time constant of that follower, chosen on DexHand. A linear map of where it goes explains 82 % of the variance of the
joints' motion in a control step, 84 % in three; one of the commands' changes 53 and 58 % (`action_columns.py`)."""
SAMPLED_ACTIONS = 4096
"""Actions of which the statistics are taken."""
HELD = ("rgb", "depth")
"""What is held in memory where it fits."""
PICTURES = (*HELD, "segmentation")


@dataclass(frozen=True)
class Clips:
    """A batch of clips."""

    rgb: Tensor
    """(B, T, 3, H, W) float32 in [0, 1]."""
    depth: Tensor
    """(B, T, 1, H, W) float32 metres."""
    actions: Tensor
    """(B, T-1, A) float32, aggregated over the frame gap, in the dataset's units."""

    def pinned(self) -> Clips:
        """The same in memory that a GPU reads by itself, so that copying it need not be waited for."""
        return Clips(*(getattr(self, field.name).pin_memory() for field in fields(self)))

    def to(self, device: torch.device) -> Clips:
        """The same on another device."""
        return Clips(*(getattr(self, field.name).to(device, non_blocking=True) for field in fields(self)))


ROBOT_OBS = 15
"""Numbers in CALVIN's `robot_obs`, of which the first three are where the TCP is."""


@dataclass(frozen=True)
class ClipTruth:
    """What the simulator knows about a batch of clips; flow at index t leads from frame t to frame t+1."""

    scene_flow: Tensor
    """(B, T-1, 3, H, W) metres, camera frame."""
    hand: Tensor
    """(B, T-1, H, W) bool, pixels of the end-effector in frame t."""
    bodies: Tensor
    """(B, T-1, H, W) int64, the body under each pixel of frame t; 0 is the world."""
    tcp: Tensor | None
    """(B, T, 3) metres, camera frame; None where proprioception is not that of an arm, `robot_obs` of CALVIN."""


def action_units(dataset: RGBDDataset, action_column: str) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """How each number of an action adds up over a frame gap, and how many metres or radians 1 stands for in it.

    Raises:
        UsageError: no such column, or changes are asked for of actions that are changes themselves.
    """
    if action_column == "joint_delta":
        joints = dataset.width(action_column)
        return ("sum",) * joints, (1.0,) * joints
    aggregation = tuple(dataset.attrs["action_aggregation"])
    scale = tuple(float(unit) for unit in dataset.attrs["action_scale"])
    if action_column == "action":
        return aggregation, scale
    if set(aggregation) != {"last"}:
        raise UsageError(
            f"action-column is '{action_column}', but the actions of {dataset.attrs['env_id']} are not all absolute "
            f"({', '.join(aggregation)}); give --action-column action"
        )
    return ("sum",) * len(scale), scale


def usual_column(dataset: RGBDDataset) -> str:
    """What was commanded, or, where joints follow absolute commands, what follows them; never what came of it."""
    servoed = set(dataset.attrs["action_aggregation"]) == {"last"} and "joint_delta" in dataset.columns
    return "action_followed" if servoed else "action"


def action_changes(actions: NDArray[Any], slices: NDArray[np.int64]) -> NDArray[Any]:
    """(N, A) what each action of some episodes changes in the one before; 0 in an episode's first.

    Args:
        actions: (N, A), absolute.
        slices: (E, 2) first row of each episode, and the one after its last.
    """
    changes = np.diff(actions, axis=0, prepend=actions[:1])
    changes[slices[:, 0]] = 0
    return changes


def actions_followed(actions: NDArray[Any], slices: NDArray[np.int64], control_rate: float) -> NDArray[Any]:
    """(N, A) how far a follower of the commands goes in each control step of some episodes, in their units.

    It goes a fixed share of what is left to the command, as a joint does whose servo is soft. At an episode's start it
    is at the first command.

    Args:
        actions: (N, A), absolute.
        slices: (E, 2) first row of each episode, and the one after its last; all N rows, in their order.
        control_rate: control steps a second.
    """
    share = 1 - np.exp(-1 / (control_rate * FOLLOWING_SECONDS))
    changes = action_changes(actions, slices)
    followed = [scipy.signal.lfilter([share], [1, share - 1], changes[start:end], axis=0) for start, end in slices]
    return np.concatenate(followed).astype(actions.dtype)


class ClipSource:
    """Random clips of a dataset, the same for the same seed and step, with no state to save.

    Args:
        dataset: opened with the columns rgb, depth, action, and for truth segmentation, body_pose, proprio.
        frame_gap: control steps from one frame of a clip to the next.
        episodes: which episodes to use; all when None.
        share: another source of the same dataset, whose memory this one uses too.
        action_column: one of `ACTION_COLUMNS`.
        memory_limit: bytes that RGB and depth may take; larger ones stay on the disk. None to hold them always.
    """

    def __init__(
        self,
        dataset: RGBDDataset,
        frame_gap: int,
        episodes: slice | None = None,
        share: ClipSource | None = None,
        action_column: str = "action",
        memory_limit: float | None = None,
    ) -> None:
        if frame_gap < 1:
            raise UsageError(f"frame-gap is {frame_gap}; give 1 for adjacent frames, or more")
        if action_column not in ACTION_COLUMNS:
            raise UsageError(f"action-column is {action_column!r}; choose one of {', '.join(ACTION_COLUMNS)}")
        self.dataset, self.frame_gap, self.action_column = dataset, frame_gap, action_column
        self._slices = dataset.episode_slices[episodes or slice(None)]
        self._columns: dict[str, NDArray[Any]] = share._columns if share else {}
        self.in_memory: bool = memory_limit is None or dataset.size_of(HELD) <= memory_limit
        """Whether pictures are held; what `share` decided holds here too."""
        if share is not None:
            self.in_memory = share.in_memory
        self.action_aggregation, self.action_scale = action_units(dataset, action_column)
        self._hold((action_column, *HELD) if self.in_memory else (action_column,))
        self.action_dim = int(self._columns[action_column].shape[1])

    @property
    def control_rate(self) -> float:
        """Control steps a second."""
        return float(self.dataset.attrs["control_rate"])

    @property
    def frame_seconds(self) -> float:
        """From one frame of a clip to the next."""
        return self.frame_gap / self.control_rate

    def starts(self, frames: int) -> NDArray[np.int64]:
        """First rows of all clips of `frames` frames."""
        total = self._places(frames)[1][-1]
        return self._starts_of(np.arange(total), frames)

    def sample(self, rng: np.random.Generator, batch: int, frames: int, share: slice = slice(None)) -> Clips:
        """Draw a batch of clips uniformly over all places where one can start; read a share of it."""
        total = self._places(frames)[1][-1]
        return self.at(self._starts_of(rng.integers(0, total, batch), frames)[share], frames)

    def spread(self, count: int, frames: int) -> NDArray[np.int64]:
        """First rows of `count` clips spread evenly over the data, for a fixed validation set."""
        total = self._places(frames)[1][-1]
        return self._starts_of(np.linspace(0, total - 1, min(count, total)).astype(np.int64), frames)

    def _places(self, frames: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """First rows (E,) of the episodes that can hold a clip, and the number of places (E,) up to each one's end."""
        span = (frames - 1) * self.frame_gap + 1
        lengths = self._slices[:, 1] - self._slices[:, 0]
        if lengths.max(initial=0) < span:
            raise UsageError(
                f"no episode is {span} frames long, as {frames} frames at gap {self.frame_gap} need (the longest has "
                f"{lengths.max(initial=0)}); choose a smaller frame gap or shorter clips, in training by --frame-gap "
                "or --schedule.clip-lengths"
            )
        long = lengths >= span
        return self._slices[long, 0], np.cumsum(lengths[long] - span + 1)

    def _starts_of(self, places: NDArray[np.int64], frames: int) -> NDArray[np.int64]:
        firsts, totals = self._places(frames)
        episodes = np.searchsorted(totals, places, side="right")
        return firsts[episodes] + places - np.concatenate([[0], totals])[episodes]

    def at(self, starts: NDArray[np.int64], frames: int) -> Clips:
        """The clips that start at these rows."""
        stored = self._read(HELD, self._rows(starts, frames))
        rgb = torch.from_numpy(stored["rgb"]).permute(0, 1, 4, 2, 3).float() / 255
        depth = torch.from_numpy(self.dataset.depth_metres(stored["depth"])).unsqueeze(2)
        return Clips(rgb, depth, torch.from_numpy(self.actions_at(starts, frames)))

    def actions_at(self, starts: NDArray[np.int64], frames: int) -> NDArray[np.float32]:
        """(B, frames-1, A) aggregated actions of the clips that start at these rows."""
        rows = self._rows(starts, frames)[:, :-1, None] + np.arange(self.frame_gap)
        actions = self._columns[self.action_column][rows]
        return aggregate_actions(actions, self.action_aggregation, self.action_scale).astype(np.float32)

    def with_actions(self, action_column: str) -> ClipSource:
        """The same clips with another action column; shares the memory."""
        if action_column == self.action_column:
            return self
        other = ClipSource(self.dataset, self.frame_gap, share=self, action_column=action_column)
        other._slices = self._slices
        return other

    def truth_at(self, starts: NDArray[np.int64], frames: int) -> ClipTruth:
        """Scene flow, hand pixels and TCP of the clips that start at these rows; needs a dataset with ground truth."""
        dataset, camera = self.dataset, self.dataset.camera
        stored = self._read(("depth", "segmentation", "body_pose", "proprio"), self._rows(starts, frames))
        depth = dataset.depth_metres(stored["depth"])
        bodies, poses = stored["segmentation"], stored["body_pose"]
        flow = np.stack(
            [
                [
                    ground_truth.scene_flow(camera, depth[b, t], bodies[b, t], poses[b, t], poses[b, t + 1])
                    for t in range(frames - 1)
                ]
                for b in range(len(starts))
            ]
        )
        hand = np.isin(bodies[:, :-1], dataset.attrs["hand_body_ids"])
        proprio = stored["proprio"].astype(np.float64)
        tcp = camera.to_camera(proprio[..., :3]) if proprio.shape[-1] == ROBOT_OBS else None
        return ClipTruth(
            torch.from_numpy(flow).permute(0, 1, 4, 2, 3).float(),
            torch.from_numpy(hand),
            torch.from_numpy(bodies[:, :-1].astype(np.int64)),
            None if tcp is None else torch.from_numpy(tcp).float(),
        )

    def action_statistics(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean and standard deviation of aggregated actions, (A,) each; a dimension that never changes gets 1."""
        actions = self.actions_at(self.spread(SAMPLED_ACTIONS, 2), 2)[:, 0].astype(np.float64)
        std = actions.std(0)
        return actions.mean(0), np.where(std > 1e-4 * np.abs(actions).max(0), std, 1.0)  # in whatever unit they are

    def _hold(self, names: Sequence[str]) -> None:
        for name in names:
            if name in self._columns:
                continue
            if name == "action_change":
                self._hold(("action",))
                self._columns[name] = action_changes(self._columns["action"], self.dataset.episode_slices)
            elif name == "action_followed":
                self._hold(("action",))
                actions, slices = self._columns["action"], self.dataset.episode_slices
                self._columns[name] = actions_followed(actions, slices, self.control_rate)
            else:
                self._columns[name] = self.dataset.load(name)

    def _read(self, names: Sequence[str], rows: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """These rows of some columns, from memory or from the disk."""
        far = [] if self.in_memory else [name for name in names if name in PICTURES]
        near = [name for name in names if name not in far]
        self._hold(near)
        stored = self.dataset.rows(far, rows) if far else {}
        return stored | {name: self._columns[name][rows] for name in near}

    def _rows(self, starts: NDArray[np.int64], frames: int) -> NDArray[np.int64]:
        return np.asarray(starts)[:, None] + np.arange(frames) * self.frame_gap
