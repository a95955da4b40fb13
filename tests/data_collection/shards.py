"""Made-up episodes, and damage done to shards."""

import h5py
import numpy as np

from data_collection.schema import DEPTH_STEPS
from envs.camera import CameraModel

CAMERA = CameraModel.from_fovy(16, 12, 30.0, np.eye(4), 1.0, 3.0)
ATTRS = {
    "env_id": "some/Env-v0",
    "env_kwargs": {"image_size": 16},
    "policy": "random",
    "seed": 3,
    "control_rate": 10.0,
    "camera": CAMERA.to_dict(),
    "action_aggregation": ["sum", "last"],
    "action_scale": [0.1, 1.0],
    "body_names": ["world"],
    "hand_body_ids": [],
    "versions": {},
    "gl_renderer": "none",
}


def make_episode(rng, rows, ground_truth=False):
    columns = {
        "rgb": rng.integers(0, 256, (rows, 12, 16, 3), np.uint8),
        "depth": rng.integers(0, DEPTH_STEPS + 1, (rows, 12, 16), np.uint16),
        "action": rng.normal(size=(rows, 2)).astype(np.float32),
        "proprio": rng.normal(size=(rows, 4)).astype(np.float32),
        "state": rng.normal(size=(rows, 9)),
        "reward": rng.normal(size=rows).astype(np.float32),
    }
    if ground_truth:
        columns["segmentation"] = rng.integers(0, 9, (rows, 12, 16), np.uint8)
        columns["body_pose"] = rng.normal(size=(rows, 3, 7)).astype(np.float32)
    return columns


def flip_a_byte_of(path, column):
    """Change the middle byte of a column's first stored chunk."""
    with h5py.File(path, "r") as file:
        place = file[column].id.get_chunk_info(0)
    content = bytearray(path.read_bytes())
    content[place.byte_offset + place.size // 2] ^= 0xFF
    path.write_bytes(content)
