"""CALVIN (Mees et al. 2022): hours of play, a compressed npz a frame, and a table of where episodes begin and end.

task_D_D/training/
  .hydra/merged_config.yaml   the static camera
  ep_start_end_ids.npy        (N, 2) first and last frame of each episode, both inclusive
  episode_0000042.npz         rgb_static, depth_static, rel_actions, robot_obs, scene_obs, and what is not read
"""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_collection.importers.calvin_camera import Recording, read_recording
from data_collection.importers.checks import DepthCheck, check_array, note_unit_of_motion, odd_gripper
from data_collection.importers.images import average_colour, nearest_depth, resize_camera
from data_collection.importers.source import (
    Columns,
    Damaged,
    Episode,
    Part,
    SourceOptions,
    actions_of_episode,
    find_split,
)
from data_collection.schema import quantise_depth
from envs.camera import CameraModel
from envs.errors import UsageError

IDS = "ep_start_end_ids.npy"
LENGTHS = "ep_lens.npy"
NEAR, FAR = 3.7, 6.3  # metres: the table and what stands on it, from 4.2 m away
ROBOT_OBS, SCENE_OBS = 15, 24
UNIT_M, UNIT_RAD = 0.02, 0.05
MOST_CLIPPED = 0.1
"""A larger share of clipped actions is noted."""
MISREADINGS = {"doubled": 2.0, "halved": 0.5, "in millimetres": 1000.0, "in centimetres": 100.0}


@dataclass(frozen=True, eq=False)
class CalvinSource:
    """A split of a CALVIN dataset. Long play is cut where an episode would have more than `steps` actions; the frame
    at a cut belongs to both sides, so that no action is lost."""

    folder: Path
    split: str
    env_id: str
    recording: Recording
    camera: CameraModel
    episodes: NDArray[np.int64]
    """(N, 2) first and last frame of each."""
    steps: int
    depth_scale: float
    notes: tuple[str, ...]

    # `rel_actions` say how far the hand went to the next frame, in position and Euler angles, in units and clipped to
    # -1 and 1. Number by number, such differences add up to those over several frames, but where they are clipped.
    action_aggregation = ("sum",) * 6 + ("last",)
    action_scale = (UNIT_M, UNIT_M, UNIT_M, UNIT_RAD, UNIT_RAD, UNIT_RAD, 1.0)

    @property
    def control_rate(self) -> float:
        return self.recording.control_rate

    def parts(self) -> list[Part]:
        parts: list[Part] = []
        for number, (first, last) in enumerate(self.episodes.tolist()):
            pieces = max(1, -(-(last - first) // self.steps))
            cuts = [first + round(piece * (last - first) / pieces) for piece in range(pieces + 1)]
            for start, stop in itertools.pairwise(cuts):
                name = f"episode {number}, frames {start} to {stop}"
                parts.append(Part(len(parts), name, self.folder, start, stop - start + 1))
        return parts

    def read(self, part: Part) -> Episode:
        if part.frames < 2:
            raise Damaged(f"{part.frames} frames are no episode")
        stored, height, width = self.recording.camera, self.camera.height, self.camera.width
        shapes = {
            "rgb_static": ("uint8", (stored.height, stored.width, 3)),
            "depth_static": ("float", (stored.height, stored.width)),
            "rel_actions": ("float", (7,)),
            "robot_obs": ("float", (ROBOT_OBS,)),
            "scene_obs": ("float", (SCENE_OBS,)),
        }
        depth_check = DepthCheck(self.camera, self.recording.distance, MISREADINGS, self.depth_scale)
        rgb = np.empty((part.frames, height, width, 3), np.uint8)
        raw = []  # depth as it is stored: an episode's metres would take twice the memory
        flat = {name: np.empty((part.frames, *shape), np.float64) for name, (_, shape) in list(shapes.items())[2:]}
        for row in range(part.frames):
            name = f"episode_{part.first + row:07d}.npz"
            frame = _read_frame(part.folder / name, tuple(shapes))
            for key, (kind, shape) in shapes.items():
                check_array(frame[key], f"{key} of {name}", kind, shape)
            rgb[row] = average_colour(frame["rgb_static"], height, width)
            raw.append(nearest_depth(frame["depth_static"], height, width))
            depth_check.look(raw[-1] * self.depth_scale)
            for key, values in flat.items():
                values[row] = frame[key]
        notes = depth_check.notes()
        near, far = self.camera.near, self.camera.far
        depth = np.stack([quantise_depth(one * self.depth_scale, near, far) for one in raw])
        return Episode(*_columns(rgb, depth, flat, notes))


def _columns(
    rgb: NDArray[np.uint8], depth: NDArray[np.uint16], flat: Columns, notes: list[str]
) -> tuple[Columns, tuple[str, ...]]:
    actions, robot, scene = flat["rel_actions"][:-1], flat["robot_obs"], flat["scene_obs"]
    wrong = odd_gripper(actions[:, 6], "rel_actions")
    if wrong:
        raise Damaged(wrong)
    notes += filter(None, [odd_gripper(robot[:, 14], "robot_obs")])  # no model sees it
    largest = float(np.abs(actions[:, :6]).max())
    if largest > 1 + 1e-6:
        notes.append(f"relative actions up to {largest:.3g}, not within -1 and 1")
    clipped = float((np.abs(actions[:, :6]) == 1).any(axis=1).mean())
    if clipped > MOST_CLIPPED:
        notes.append(
            f"{clipped:.0%} of the relative actions are clipped to -1 or 1: the arm went further than they say"
        )
    notes += note_unit_of_motion(np.diff(robot[:, :3], axis=0), actions[:, :3], UNIT_M)
    columns: Columns = {
        "rgb": rgb,
        "depth": depth,
        "action": actions_of_episode(actions),
        "proprio": robot.astype(np.float32),
        "state": np.concatenate([robot, scene], axis=1),
        "reward": np.zeros(len(rgb), np.float32),
        "scene_obs": scene.astype(np.float32),
    }
    return columns, tuple(notes)


def _read_frame(path: Path, keys: tuple[str, ...]) -> Columns:
    """The arrays of these names in an npz; no others are unpacked."""
    try:
        file = np.load(path, allow_pickle=False)
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise Damaged(f"{path.name} is no npz file")
        with file:
            missing = [key for key in keys if key not in file.files]
            if missing:
                raise Damaged(f"no {missing[0]} in {path.name}")
            return {key: file[key] for key in keys}
    except Damaged:
        raise
    except FileNotFoundError:
        raise Damaged(f"{path.name} is missing") from None
    except Exception as error:  # what a flipped byte makes of an archive has many names
        raise Damaged(f"{path.name} does not unpack ({type(error).__name__})") from error


def open_calvin(options: SourceOptions) -> CalvinSource:
    """Open a CALVIN dataset, or one split of it.

    Raises:
        UsageError: the table of episodes or the camera is missing, or makes no sense.
    """
    inside = (options.path / IDS).is_file() and options.split is None
    folder, split = (options.path, options.path.name) if inside else find_split(options.path, options.split)
    table = options.ids or folder / IDS
    episodes = _read_table(table)
    near, far = options.near or NEAR, options.far or FAR
    recording = read_recording(folder, near, far)
    notes = []
    lengths = _read_lengths(folder / LENGTHS) if options.ids is None else None
    if lengths is not None and not np.array_equal(lengths, episodes[:, 1] - episodes[:, 0] + 1):
        notes.append(f"{LENGTHS} does not follow from {IDS}; {IDS} is believed")
    return CalvinSource(
        folder=folder,
        split=split,
        env_id=f"calvin/{options.scene or _scene_of(folder, split) or recording.scene or 'unknown'}",
        recording=recording,
        camera=resize_camera(recording.camera, options.image_size, options.image_size),
        episodes=episodes,
        steps=options.steps,
        depth_scale=options.depth_scale,
        notes=tuple(notes),
    )


def _read_table(path: Path) -> NDArray[np.int64]:
    if not path.is_file():
        raise UsageError(f"no {path}; give a split of a CALVIN dataset, or the table of its episodes with --ids")
    try:
        table: NDArray[Any] = np.load(path, allow_pickle=False)
    except Exception as error:
        raise UsageError(f"{path} is not a table of numbers ({error}); restore it from the dataset") from error
    if table.ndim != 2 or table.shape[1] != 2 or table.dtype.kind not in "iu" or not len(table):
        raise UsageError(f"{path} is {table.dtype} {table.shape}, not whole numbers (N, 2): first and last frames")
    return table.astype(np.int64)


def _read_lengths(path: Path) -> NDArray[Any] | None:
    try:
        lengths: NDArray[Any] = np.load(path, allow_pickle=False)
    except Exception:  # it is only compared
        return None
    return lengths.reshape(-1)


def _scene_of(folder: Path, split: str) -> str:
    """`task_ABC_D` is trained on ABC and validated on D."""
    named = re.fullmatch(r"task_([A-Z]+)_([A-Z]+)", folder.resolve().parent.name)
    if not named:
        return ""
    return named[1] if split.startswith("train") else named[2]
