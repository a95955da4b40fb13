"""What the simulator knows about motion: scene flow, optical flow and disocclusion between any two frames.

Everything follows from the depth and the body ids of the first frame and the poses of all bodies in both frames, so it
is exact at any gap between them. Leading dimensions (clips, batches) are carried along.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs.camera import CameraModel
from envs.errors import UsageError


@dataclass(frozen=True, eq=False)
class Motion:
    """True motion from one frame to another."""

    scene_flow: NDArray[np.float32]
    """(..., H, W, 3) displacement of the surface point under each pixel of the first frame, camera frame, metres."""
    optical_flow: NDArray[np.float32]
    """(..., H, W, 2) its displacement in the image, pixels (right, down)."""
    disocclusion: NDArray[np.bool_]
    """(..., H, W) pixels of the second frame on which no point of the first one lands."""


def motion(
    camera: CameraModel, depth: ArrayLike, body_id: ArrayLike, pose_before: ArrayLike, pose_after: ArrayLike
) -> Motion:
    """All there is to know about the motion between two frames; arguments as for `scene_flow`."""
    flow = scene_flow(camera, depth, body_id, pose_before, pose_after)
    return Motion(flow, optical_flow(camera, depth, flow), disocclusion(camera, depth, flow))


def scene_flow(
    camera: CameraModel, depth: ArrayLike, body_id: ArrayLike, pose_before: ArrayLike, pose_after: ArrayLike
) -> NDArray[np.float32]:
    """The motion of the surface point under each pixel, moved rigidly with its body.

    Args:
        camera: the camera that took the frame.
        depth: (..., H, W) planar depth of the first frame, metres.
        body_id: (..., H, W) integer, the body under each pixel of the first frame; 0 is the world.
        pose_before: (..., bodies, 7) in the first frame: world position, metres, and unit quaternion (w, x, y, z).
        pose_after: (..., bodies, 7) in the second frame.

    Returns:
        (..., H, W, 3) float32, camera frame, metres. Exactly zero on bodies whose pose does not change.

    Raises:
        UsageError: the shapes do not fit together, or a pixel names a body that has no pose.
    """
    points = camera.unproject(depth)
    ids = np.asarray(body_id)
    before, after = np.asarray(pose_before, dtype=np.float64), np.asarray(pose_after, dtype=np.float64)
    lead = points.shape[:-3]
    if ids.shape != points.shape[:-1]:
        raise UsageError(f"body_id has shape {ids.shape}; it must be the depth's, {points.shape[:-1]}")
    if before.shape != after.shape or before.shape[:-2] != lead or before.ndim < 2 or before.shape[-1] != 7:
        expected = (*lead, "bodies", 7)
        raise UsageError(f"poses have shapes {before.shape} and {after.shape}; both must be {expected}")
    if ids.size and not (ids.min() >= 0 and ids.max() < before.shape[-2]):
        raise UsageError(
            f"body ids range over {ids.min()}..{ids.max()} but there are poses of {before.shape[-2]} bodies"
        )

    rotation, translation = _camera_frame_motion(camera, before, after)  # (..., bodies, 3, 3), (..., bodies, 3)
    turn = (rotation - np.eye(3)).reshape(*lead, -1, 9)
    still = (before == after).all(-1)
    still[..., 0] = True
    turn[still], translation[still] = 0.0, 0.0
    flat_ids = ids.reshape(*lead, -1, 1).astype(np.int64)  # (..., H * W, 1)
    turn = np.take_along_axis(turn, flat_ids, axis=-2).reshape(*ids.shape, 3, 3)
    translation = np.take_along_axis(translation, flat_ids, axis=-2).reshape(*ids.shape, 3)
    return ((turn @ points[..., None])[..., 0] + translation).astype(np.float32)


def optical_flow(camera: CameraModel, depth: ArrayLike, flow: ArrayLike) -> NDArray[np.float32]:
    """Scene flow as it appears in the image.

    Args:
        camera: the camera that took the frame.
        depth: (..., H, W) planar depth of the first frame, metres.
        flow: (..., H, W, 3) scene flow, camera frame, metres.

    Returns:
        (..., H, W, 2) float32, pixels (right, down); exactly zero where the scene flow is; NaN behind the camera.
    """
    points = camera.unproject(depth)
    flow = _checked_flow(flow, points)
    return (camera.project(points + flow) - camera.project(points)).astype(np.float32)


def disocclusion(camera: CameraModel, depth: ArrayLike, flow: ArrayLike) -> NDArray[np.bool_]:
    """The pixels of the second frame on which no point of the first one lands.

    A point lands on the pixel whose centre is nearest to its projection; points behind the camera and outside of the
    image land nowhere.

    Args:
        camera: the camera that took the frame.
        depth: (..., H, W) planar depth of the first frame, metres.
        flow: (..., H, W, 3) scene flow, camera frame, metres.

    Returns:
        (..., H, W) bool.
    """
    points = camera.unproject(depth)
    landed = camera.project(points + _checked_flow(flow, points)).reshape(-1, camera.height * camera.width, 2)
    size = (camera.width, camera.height)
    inside = ((landed >= -0.5) & (landed < np.array(size) - 0.5)).all(-1)  # False for NaN
    column, row = np.floor(np.where(inside[..., None], landed, 0.0) + 0.5).astype(np.int64).transpose(2, 0, 1)
    hidden_before = np.ones((len(landed), camera.height * camera.width), bool)
    image = np.broadcast_to(np.arange(len(landed))[:, None], inside.shape)
    hidden_before[image[inside], (row * camera.width + column)[inside]] = False
    return hidden_before.reshape(points.shape[:-1])


def _camera_frame_motion(
    camera: CameraModel, before: NDArray[np.float64], after: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The rigid motion of each body, expressed in the camera frame: point' = rotation @ point + translation."""
    turn = _rotation_matrices(after[..., 3:]) @ _rotation_matrices(before[..., 3:]).swapaxes(-1, -2)
    to_camera, eye = camera.world_T_camera[:3, :3].T, camera.world_T_camera[:3, 3]
    rotation = to_camera @ turn @ to_camera.T
    shift = (turn @ (eye - before[..., :3])[..., None])[..., 0] + after[..., :3] - eye
    return rotation, shift @ to_camera.T


def _rotation_matrices(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 4) quaternions (w, x, y, z), normalised here, as (..., 3, 3) matrices."""
    norm = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    if not (norm > 0.5).all():
        raise UsageError(f"a pose has a quaternion of norm {norm.min():.3g}; give unit quaternions (w, x, y, z)")
    w, x, y, z = np.moveaxis(quaternions / norm, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _checked_flow(flow: ArrayLike, points: NDArray[np.float64]) -> NDArray[np.float64]:
    flow = np.asarray(flow, dtype=np.float64)
    if flow.shape != points.shape:
        raise UsageError(f"scene flow has shape {flow.shape}; for this depth it must be {points.shape}")
    return flow
