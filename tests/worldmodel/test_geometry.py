"""Point clouds against the camera they come from, rotations and rigid transforms against their definitions."""

import numpy as np
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from envs.camera import CameraModel
from worldmodel import geometry

QUICK = settings(max_examples=25)
seeds = st.integers(0, 2**32 - 1)


def random_camera(rng, width, height):
    fx, fy = rng.uniform(0.5, 6, 2) * max(width, height)
    K = [[fx, 0, rng.uniform(0, width)], [0, fy, rng.uniform(0, height)], [0, 0, 1]]
    return CameraModel(width, height, np.array(K), np.eye(4), 0.1, 10.0)


def rotations(rng, *shape):
    return geometry.rotation_from_6d(torch.from_numpy(rng.normal(size=(*shape, 6)))).double()


@given(seed=seeds, width=st.integers(1, 24), height=st.integers(1, 24))
@QUICK
def test_unproject_and_project_are_the_cameras(seed, width, height):
    rng = np.random.default_rng(seed)
    camera = random_camera(rng, width, height)
    K = torch.from_numpy(np.array(camera.K)).float()
    rays = geometry.pixel_rays(K, height, width)
    depth = rng.uniform(0.2, 10, (2, height, width))
    points = geometry.unproject(torch.from_numpy(depth)[:, None], rays)
    np.testing.assert_allclose(points.permute(0, 2, 3, 1), camera.unproject(depth), rtol=1e-4, atol=1e-5)
    grid = geometry.pixel_grid(height, width)
    np.testing.assert_allclose(geometry.project(points, K), grid.expand(2, -1, -1, -1), atol=2e-3)
    anywhere = rng.uniform([-2, -2, 0.5], [2, 2, 5], (height, width, 3))
    seen = geometry.project(torch.from_numpy(anywhere).float().permute(2, 0, 1), K)
    np.testing.assert_allclose(seen.permute(1, 2, 0), camera.project(anywhere), rtol=1e-4, atol=2e-3)


def test_points_behind_the_camera_project_to_numbers():
    points = torch.tensor([[1.0, 0.0], [0.0, 2.0], [-1.0, 0.0]]).view(3, 1, 2)
    assert geometry.project(points, torch.eye(3)).isfinite().all()


@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6))
@QUICK
def test_rotation_from_6d_is_a_rotation_that_spans_its_input(numbers):
    first, second = np.array(numbers[:3]), np.array(numbers[3:])
    assume(np.linalg.norm(np.cross(first, second)) > 0.1)
    R = geometry.rotation_from_6d(torch.tensor(numbers)).double().numpy()
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-5)
    assert np.linalg.det(R) > 0
    np.testing.assert_allclose(R[:, 0], first / np.linalg.norm(first), atol=1e-5)
    assert abs(R[:, 2] @ second) < 1e-4 and R[:, 1] @ second > 0


def test_rotation_from_6d_of_the_identity_is_exact():
    assert torch.equal(geometry.rotation_from_6d(torch.tensor([1.0, 0, 0, 0, 1.0, 0])), torch.eye(3))


def test_gradient_of_rotation_from_6d():
    rng = np.random.default_rng(0)
    weights = torch.from_numpy(rng.normal(size=(5, 3, 3))).float()
    x = torch.from_numpy(rng.normal(size=(5, 6))).float().requires_grad_()

    def scalar(sixd):
        return (weights * geometry.rotation_from_6d(sixd)).sum((1, 2))

    (gradient,) = torch.autograd.grad(scalar(x).sum(), x)
    for i in range(6):
        step = torch.zeros(6)
        step[i] = 2e-3
        with torch.no_grad():
            numeric = (scalar(x + step) - scalar(x - step)) / 4e-3
        torch.testing.assert_close(gradient[:, i], numeric, atol=5e-3, rtol=1e-2)


def test_rotate_about_turns_about_the_pivot_and_then_shifts():
    rng = np.random.default_rng(1)
    R, c, t, p = rotations(rng, 7), *(torch.from_numpy(rng.normal(size=(7, 3))) for _ in range(3))
    matrix = geometry.rotate_about(R, t, c)

    def moved(point):
        return (matrix[..., :3] @ point[..., None])[..., 0] + matrix[..., 3]

    torch.testing.assert_close(moved(c), c + t)
    torch.testing.assert_close(moved(p), (R @ (p - c)[..., None])[..., 0] + c + t)


def test_blended_transforms_move_as_the_sum_of_masked_ones():
    """Eq. (1) of the paper, term by term."""
    rng = np.random.default_rng(2)
    B, K, H, W = 2, 5, 4, 6
    masks = torch.softmax(torch.from_numpy(rng.normal(size=(B, K, H, W))), dim=1).float()
    transforms = torch.cat((rotations(rng, B, K), torch.from_numpy(rng.normal(size=(B, K, 3, 1)))), dim=-1).float()
    points = torch.from_numpy(rng.normal(size=(B, 3, H, W))).float()
    expected = torch.zeros_like(points)
    for k in range(K):
        R, t = transforms[:, k, :, :3], transforms[:, k, :, 3]
        expected += masks[:, k : k + 1] * (torch.einsum("bij,bjhw->bihw", R, points) + t[:, :, None, None])
    blended = geometry.blend_transforms(masks, transforms)
    assert blended.shape == (B, 3, 4, H, W)
    torch.testing.assert_close(geometry.apply_transforms(blended, points), expected, atol=1e-5, rtol=1e-5)


def test_gradients_of_what_keeps_double_precision():
    rng = np.random.default_rng(3)

    def draw(*shape):
        return torch.from_numpy(rng.normal(size=shape)).requires_grad_()

    points = draw(1, 3, 2, 3)
    in_front = (points.detach() + torch.tensor([0, 0, 4.0]).view(3, 1, 1)).requires_grad_()
    K = torch.tensor([[30.0, 0, 4], [0, 25.0, 3], [0, 0, 1]], dtype=torch.float64)
    assert torch.autograd.gradcheck(geometry.apply_transforms, (draw(1, 3, 4, 2, 3), points))
    assert torch.autograd.gradcheck(geometry.rotate_about, (draw(2, 3, 3), draw(2, 3), draw(2, 3)))
    assert torch.autograd.gradcheck(lambda p: geometry.project(p, K), (in_front,))


def test_gradient_of_blending_reaches_masks_and_transforms():
    """Linear in each argument: the gradient times the argument is the value itself."""
    rng = np.random.default_rng(4)
    masks = torch.from_numpy(rng.uniform(size=(2, 3, 4, 5))).float().requires_grad_()
    transforms = torch.from_numpy(rng.normal(size=(2, 3, 3, 4))).float().requires_grad_()
    weights = torch.from_numpy(rng.normal(size=(2, 3, 4, 4, 5))).float()
    value = (weights * geometry.blend_transforms(masks, transforms)).sum()
    for argument, gradient in zip((masks, transforms), torch.autograd.grad(value, (masks, transforms)), strict=True):
        torch.testing.assert_close((argument * gradient).sum(), value, rtol=1e-4, atol=0)


def test_centroids_are_those_of_the_masked_points():
    points = torch.from_numpy(np.random.default_rng(5).normal(size=(1, 3, 4, 4))).float()
    masks = torch.zeros(1, 2, 4, 4)
    masks[0, 0, 1:3, 2:] = 0.7
    centroids = geometry.mask_centroids(masks, points)
    torch.testing.assert_close(centroids[0, 0], points[0, :, 1:3, 2:].mean((1, 2)))
    assert centroids[0, 1].isfinite().all()  # of a mask that holds nothing
