"""What CALVIN's `.hydra/merged_config.yaml` tells: the static camera, the control rate, the scene."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from data_collection.importers.source import SPLITS
from envs.camera import CameraModel
from envs.errors import UsageError

CONFIG = Path(".hydra") / "merged_config.yaml"
CONTROL_RATE = 30.0  # CALVIN's own default, hertz


@dataclass(frozen=True, eq=False)
class Recording:
    """How a split was recorded."""

    camera: CameraModel
    """The static camera, in the size of the stored pictures."""
    distance: float
    """From the camera to the point that it looks at, metres."""
    control_rate: float
    scene: str
    """The scene's letter; empty where the config names none."""


def read_recording(folder: Path, near: float, far: float) -> Recording:
    """Read the config of a split, or, where it has none, of the splits beside it.

    Args:
        folder: of the split.
        near: least depth of the dataset to be, metres.
        far: greatest depth of the dataset to be, metres.

    Raises:
        UsageError: there is no config, or it does not tell the static camera; or the depth range is none.
    """
    places = [folder / CONFIG, *(folder.parent / name / CONFIG for name in SPLITS), folder.parent / CONFIG]
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        raise UsageError(
            f"no {CONFIG} in {folder} or beside it; it tells the camera: copy it from the dataset's split to there"
        )
    try:
        config = yaml.safe_load(path.read_text())
        static = config["cameras"]["static"]
        eye, target, up = (np.array(static[key], np.float64) for key in ("look_from", "look_at", "up_vector"))
        camera = _camera(static, eye, target, up, near, far)
    except UsageError:  # about the depth range, of which the config says nothing
        raise
    except (yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise UsageError(
            f"{path} does not tell the static camera ({type(error).__name__}: {reason}); it needs cameras.static with "
            "fov, aspect, width, height, look_from, look_at and up_vector"
        ) from error
    environment, scene = config.get("env"), config.get("scene")
    rate = environment.get("control_freq", CONTROL_RATE) if isinstance(environment, dict) else CONTROL_RATE
    name = str(scene.get("name", "")) if isinstance(scene, dict) else ""
    return Recording(
        camera,
        float(np.linalg.norm(target - eye)),
        float(rate) if isinstance(rate, (int, float)) and rate > 0 else CONTROL_RATE,
        name.rpartition("_")[2] if name.startswith("calvin_scene_") else "",
    )


def _camera(
    static: dict[str, Any], eye: np.ndarray, target: np.ndarray, up: np.ndarray, near: float, far: float
) -> CameraModel:
    """PyBullet's view and projection as a pinhole: the field of view is the vertical one."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    width, height = int(static["width"]), int(static["height"])
    upright = CameraModel.from_fovy(width, height, float(static["fov"]), pose, near, far)
    K = upright.K.copy()
    K[0, 0] = (width / 2) / (math.tan(math.radians(float(static["fov"])) / 2) * float(static.get("aspect", 1)))
    return CameraModel(width, height, K, pose, near, far)
