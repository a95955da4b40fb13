"""Point clouds of a pinhole camera: unproject, project, rotate, move rigidly; float32, metres, camera frame."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

MIN_DEPTH_M = 1e-3
"""Points nearer than this to the image plane count as behind the camera."""


def pixel_grid(height: int, width: int, device: torch.device | None = None) -> Tensor:
    """Pixel centres (u, v), which are integers.

    Returns:
        (2, H, W) float32, u to the right in [0], v downwards in [1].
    """
    v, u = torch.meshgrid(
        torch.arange(height, dtype=torch.float32, device=device),
        torch.arange(width, dtype=torch.float32, device=device),
        indexing="ij",
    )
    return torch.stack((u, v))


def pixel_rays(intrinsics: Tensor, height: int, width: int) -> Tensor:
    """The points at depth one metre seen by each pixel.

    Args:
        intrinsics: (3, 3) K.

    Returns:
        (3, H, W) float32 with ones in the last row.
    """
    grid = pixel_grid(height, width, intrinsics.device)
    x = (grid[0] - intrinsics[0, 2]) / intrinsics[0, 0]
    y = (grid[1] - intrinsics[1, 2]) / intrinsics[1, 1]
    return torch.stack((x, y, torch.ones_like(x))).float()


def unproject(depth: Tensor, rays: Tensor) -> Tensor:
    """Depth to an ordered point cloud: `(..., 1, H, W)` metres and `(3, H, W)` rays to `(..., 3, H, W)` metres."""
    return depth.float() * rays


def project(points: Tensor, intrinsics: Tensor) -> Tensor:
    """Points to pixels: `(..., 3, H, W)` metres to `(..., 2, H, W)` pixels. Points behind the camera give garbage,
    never NaN: mask them by their z."""
    x, y, z = points.unbind(-3)
    z = z.clamp(min=MIN_DEPTH_M)
    u = x / z * intrinsics[0, 0] + intrinsics[0, 2]
    v = y / z * intrinsics[1, 1] + intrinsics[1, 2]
    return torch.stack((u, v), dim=-3)


def rotation_from_6d(sixd: Tensor) -> Tensor:
    """Gram-Schmidt of two 3-vectors (Zhou et al. 2019, "On the continuity of rotation representations").

    Args:
        sixd: (..., 6); the first two columns of the matrix, unnormalised.

    Returns:
        (..., 3, 3) rotation matrices, whose first two columns span the input.
    """
    first, second = sixd.float().split(3, dim=-1)
    x = F.normalize(first, dim=-1)
    y = F.normalize(second - (x * second).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack((x, y, torch.linalg.cross(x, y, dim=-1)), dim=-1)


def rotate_about(rotation: Tensor, translation: Tensor, pivot: Tensor) -> Tensor:
    """Rigid transforms `p -> R (p - c) + c + t` as matrices.

    Args:
        rotation: (..., 3, 3).
        translation: (..., 3) metres.
        pivot: (..., 3) metres, the point c that the rotation leaves where it is.

    Returns:
        (..., 3, 4) matrices [R | t + c - R c].
    """
    offset = translation + pivot - (rotation @ pivot.unsqueeze(-1)).squeeze(-1)
    return torch.cat((rotation, offset.unsqueeze(-1)), dim=-1)


def blend_transforms(masks: Tensor, transforms: Tensor) -> Tensor:
    """One transform a pixel, the mask-weighted mean of the K rigid ones.

    Applying it once gives the same point as the paper's Eq. (1), which applies K transforms and sums, since all are
    affine; it takes K times less memory.

    Args:
        masks: (B, K, H, W), sums to 1 over K.
        transforms: (B, K, 3, 4).

    Returns:
        (B, 3, 4, H, W) float32.
    """
    batch, count, height, width = masks.shape
    blended = transforms.reshape(batch, count, 12).transpose(1, 2).float() @ masks.reshape(batch, count, -1).float()
    return blended.reshape(batch, 3, 4, height, width)


def apply_transforms(transforms: Tensor, points: Tensor) -> Tensor:
    """Move each pixel's point by its own transform: `(B, 3, 4, H, W)` and `(B, 3, H, W)` to `(B, 3, H, W)`."""
    return (transforms[:, :, :3] * points.unsqueeze(1)).sum(2) + transforms[:, :, 3]


def mask_centroids(masks: Tensor, points: Tensor) -> Tensor:
    """Where each mask's part of the cloud has its centre: `(B, K, H, W)` and `(B, 3, H, W)` to `(B, K, 3)` metres."""
    weights = masks.flatten(2).float()  # (B, K, HW)
    total = weights.sum(-1, keepdim=True).clamp(min=1e-6)
    return weights @ points.flatten(2).transpose(1, 2) / total
