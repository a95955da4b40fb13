"""The layout that T3VIP published its DexHand and Omnipush data in: a folder an episode, a PNG a picture.

root/intrinsics.txt                 two lines: names, then values, among them fx fy cx cy in pixels
root/training/.../<episode>/
  rgbsub0.png    8 bit colour       depthsub0.png  16 bit, 65535 = `png_far` metres       and what the robot did
"""

from __future__ import annotations

import os
import re
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from data_collection.importers.checks import DepthCheck, check_array
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
from data_collection.schema import DEPTH_STEPS, quantise_depth
from envs.camera import CameraModel
from envs.errors import UsageError

INTRINSICS = "intrinsics.txt"
NUMBERED = re.compile(r"([a-z]+)0*(\d+)\.(png|txt)")


@dataclass(frozen=True, eq=False)
class PngFolders(ABC):
    """A split of such a dataset. The layout tells no camera pose: the world is the camera frame."""

    format: ClassVar[str]
    env_id: ClassVar[str]
    control_rate: ClassVar[float]
    action_aggregation: ClassVar[tuple[str, ...]]
    action_scale: ClassVar[tuple[float, ...]]
    png_far: ClassVar[float]
    """Metres that the depth value 65535 stands for."""
    range_m: ClassVar[tuple[float, float]]
    """Depth range by default, metres."""
    expected_m: ClassVar[float]
    """How far away the middle of the scene is, metres."""
    series: ClassVar[tuple[str, ...]]
    """Numbered files of each frame: what their names begin with."""

    root: Path
    folder: Path
    split: str
    stored: CameraModel
    """The camera in the size of the stored pictures."""
    camera: CameraModel
    depth_scale: float
    notes: tuple[str, ...]

    def parts(self) -> list[Part]:
        folders = sorted(_episode_folders(self.folder), key=lambda folder: _natural(folder, self.folder))
        if not folders:
            raise UsageError(
                f"no episode folder with rgbsub0.png, rgbsub1.png, ... under {self.folder}; give the root of a "
                f"{self.format} dataset, or one of its splits"
            )
        return [Part(i, folder.relative_to(self.root).as_posix(), folder) for i, folder in enumerate(folders)]

    def read(self, part: Part) -> Episode:
        files = self._numbered_files(part.folder)
        count, height, width = len(files["rgbsub"]), self.camera.height, self.camera.width
        misreadings = {"doubled": 2.0, "halved": 0.5, "in millimetres": 1000 * self.png_far / DEPTH_STEPS}
        # What lies at the end of the scale was seen as infinitely far.
        ceiling = 0.999 * self.png_far * self.depth_scale
        depth_check = DepthCheck(self.camera, self.expected_m, misreadings, self.depth_scale, ceiling)
        rgb = np.empty((count, height, width, 3), np.uint8)
        steps = []  # depth as it is stored: an episode's metres would take four times the memory
        step = self.png_far * self.depth_scale / DEPTH_STEPS
        shape = (self.stored.height, self.stored.width)
        for row in range(count):
            colour, raw = _read_png(files["rgbsub"][row]), _read_png(files["depthsub"][row])
            check_array(colour, files["rgbsub"][row].name, "uint8", (*shape, 3))
            check_array(raw, files["depthsub"][row].name, "uint16", shape)
            rgb[row] = average_colour(colour, height, width)
            steps.append(nearest_depth(raw, height, width))
            depth_check.look(steps[-1] * step)
        actions, proprio, robot_notes = self.robot(part.folder, files, count)
        notes = (*depth_check.notes(), *robot_notes)
        near, far = self.camera.near, self.camera.far
        columns: Columns = {
            "rgb": rgb,
            "depth": np.stack([quantise_depth(one * step, near, far) for one in steps]),
            "action": actions_of_episode(actions),
            "proprio": proprio.astype(np.float32),
            "state": proprio.astype(np.float64),
            "reward": np.zeros(count, np.float32),
        }
        return Episode(columns, notes)

    @abstractmethod
    def robot(
        self, folder: Path, files: dict[str, list[Path]], count: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], list[str]]:
        """What the robot did: actions (count - 1, A), proprioception (count, P), and notes.

        Raises:
            Damaged: it is not what the layout says.
        """

    def _numbered_files(self, folder: Path) -> dict[str, list[Path]]:
        """The files of each series in the order of their numbers, one of each for every frame."""
        found: dict[str, dict[int, Path]] = {name: {} for name in self.series}
        for entry in sorted(os.listdir(folder)):
            match = NUMBERED.fullmatch(entry)
            if match and match[1] in found:
                found[match[1]][int(match[2])] = folder / entry
        counts = ", ".join(f"{len(files)} {name}" for name, files in found.items())
        numbers = sorted(set[int]().union(*found.values()))
        if len(numbers) < 2:
            raise Damaged(f"{len(numbers)} frames are no episode ({counts})")
        for name in self.series:
            for number in range(numbers[0], numbers[-1] + 1):
                if number not in found[name]:
                    raise Damaged(f"{name}{number} is missing ({counts})")
        return {name: [files[number] for number in numbers] for name, files in found.items()}


def open_camera(
    options: SourceOptions, folder: Path, source: type[PngFolders], fallback: Columns | None = None
) -> tuple[CameraModel, CameraModel, tuple[str, ...]]:
    """The camera of the stored pictures, that of the pictures to be, and notes.

    Args:
        options: of the import.
        folder: of the split.
        source: the format.
        fallback: "K" (3, 3) and "size" (height, width) to which it belongs, where there is no intrinsics.txt.

    Raises:
        UsageError: there are no intrinsics, or no picture to know the size by.
    """
    size = _picture_size(folder)
    places = [place / INTRINSICS for place in (folder, options.path, folder.parent, options.path.parent)]
    path = next((place for place in places if place.is_file()), None)
    near, far = options.near or source.range_m[0], options.far or source.range_m[1]
    notes: tuple[str, ...] = ()
    if path is not None:
        stored = CameraModel(size[1], size[0], _read_intrinsics(path), np.eye(4), near, far)
        off = np.abs((stored.K[:2, 2] + 0.5) / (size[1], size[0]) - 0.5)  # 0.5 at the border
        if off.max() > 0.25:
            notes = (f"the centre in {path.name} is not in the middle of {size[1]}x{size[0]}: of another size?",)
    elif fallback is not None:
        height, width = (int(side) for side in fallback["size"])
        public = CameraModel(width, height, fallback["K"], np.eye(4), near, far)
        stored = resize_camera(public, *size)
        notes = (f"no {INTRINSICS}; the published intrinsics of the camera are taken",)
    else:
        raise UsageError(f"no {INTRINSICS} in {options.path}; it tells the camera: copy it from the dataset to there")
    return stored, resize_camera(stored, options.image_size, options.image_size), notes


def open_folders(options: SourceOptions, source: type[PngFolders], fallback: Columns | None = None) -> PngFolders:
    """Open a dataset of a format; see `open_camera`."""
    folder, split = find_split(options.path, options.split)
    stored, camera, notes = open_camera(options, folder, source, fallback)
    return source(options.path, folder, split, stored, camera, options.depth_scale, notes)


def _episode_folders(folder: Path) -> list[Path]:
    """Folders with numbered pictures, and folders with nothing in them, whose episode is lost."""
    inside: list[Path] = []
    with os.scandir(folder) as entries:
        for entry in entries:
            match = NUMBERED.fullmatch(entry.name)
            if match and match[1] in ("rgbsub", "depthsub"):
                return [folder]
            if entry.is_dir() and not entry.name.startswith("."):
                inside.append(Path(entry.path))
    found = [episode for child in inside for episode in _episode_folders(child)]
    return found if inside else [folder]


def _natural(folder: Path, root: Path) -> list[tuple[int, str]]:
    """A sorting key that has episode 10 after episode 9."""
    pieces = re.split(r"(\d+)", folder.relative_to(root).as_posix())
    return [(int(piece), "") if piece.isdigit() else (-1, piece) for piece in pieces]


def _picture_size(folder: Path) -> tuple[int, int]:
    """(height, width) of the first picture that opens."""
    for place, inside, files in os.walk(folder):
        inside.sort()
        for name in sorted(name for name in files if name.startswith("rgbsub")):
            try:
                with Image.open(Path(place) / name) as picture:
                    return picture.height, picture.width
            except (OSError, SyntaxError):
                continue
    raise UsageError(
        f"no rgbsub*.png under {folder}; the published layout has rgbsub0.png and depthsub0.png in a folder an "
        "episode (the colour-only video set has no depth and cannot be imported)"
    )


def _read_png(path: Path) -> NDArray[Any]:
    """A picture as it is stored: uint8 (H, W, 3) without transparency, or uint16 (H, W), or what else it is."""
    try:
        with Image.open(path) as picture:
            values = np.asarray(picture)
    except (OSError, SyntaxError, ValueError, UnidentifiedImageError) as error:
        raise Damaged(f"{path.name} does not unpack ({type(error).__name__})") from error
    if values.ndim == 3 and values.shape[2] == 4:
        return values[..., :3]
    if values.dtype == np.int32 and values.min() >= 0 and values.max() <= DEPTH_STEPS:  # 16 bits to some Pillows
        return values.astype(np.uint16)
    return values


def _read_intrinsics(path: Path) -> NDArray[np.float64]:
    try:
        names, values = (line.replace(",", " ").split() for line in path.read_text().split("\n")[:2])
        told = dict(zip((name.strip(":#").lower() for name in names), map(float, values), strict=True))
        return np.array([[told["fx"], 0, told["cx"]], [0, told["fy"], told["cy"]], [0, 0, 1]])
    except (KeyError, ValueError) as error:
        raise UsageError(
            f"{path} does not tell the camera ({error}); it needs a line of names, among them fx fy cx cy, and a line "
            "of as many values in pixels"
        ) from error
