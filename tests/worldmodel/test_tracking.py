"""Hand and surfaces are followed exactly where the transforms are exact; where these disagree, it counts."""

import numpy as np
import pytest
import torch

from envs.camera import CameraModel
from worldmodel.geometry import pixel_grid
from worldmodel.tracking import HandTrack, SurfaceTrack, _seen_at, hand_pixels, tcp_way

BACKGROUND, HAND = 4.6, 4.2  # metres


@pytest.fixture
def camera() -> CameraModel:
    return CameraModel.from_fovy(64, 64, 10.0, np.eye(4), 3.5, 5.5)


def scene(camera, corner=(20, 24), size=6):
    """A square hand in front of a wall; the TCP lies below it, where the camera sees the wall."""
    depth = np.full((64, 64), BACKGROUND)
    u, v = corner
    depth[v : v + size, u : u + size] = HAND
    points = torch.from_numpy(camera.unproject(depth)).permute(2, 0, 1)
    tcp = camera.unproject(np.full((64, 64), HAND))[v + size + 1, u + size // 2]
    return points, torch.from_numpy(tcp)


def hand(points, tcp):
    return points.flatten(1)[:, hand_pixels(points, tcp)].T


def square(transform_inside, corner, size=6, batch=2):
    field = torch.eye(3, 4, dtype=torch.float64)[None, :, :, None, None].repeat(batch, 1, 1, 64, 64)
    u, v = corner
    field[..., v : v + size, u : u + size] = transform_inside[None, :, :, None, None]
    background = torch.ones(batch, 1, 64, 64, dtype=torch.float64)
    background[..., v : v + size, u : u + size] = 0
    return field, background


def intrinsics(camera):
    return torch.from_numpy(np.array(camera.K))


def test_hand_pixels_are_those_near_the_tcp_in_space(camera):
    points, tcp = scene(camera)
    found = torch.zeros(64, 64, dtype=torch.bool)
    found.view(-1)[hand_pixels(points, tcp)] = True
    assert found[24:30, 20:26].sum() == found.sum() > 15  # on the hand only, never on the wall behind the TCP
    v, u = divmod(int(hand_pixels(points, tcp)[-1]), 64)
    assert (points[:, v, u] - tcp).norm() <= 0.06


def test_a_hidden_hand_takes_the_nearest_points(camera):
    _, tcp = scene(camera)
    wall = torch.from_numpy(camera.unproject(np.full((64, 64), BACKGROUND))).permute(2, 0, 1)
    found = hand_pixels(wall, tcp)
    distances = (wall - tcp[:, None, None]).norm(dim=0).flatten()
    assert len(found) == 6 and distances[found].max() <= distances.kthvalue(6).values


def test_follows_the_hand_across_the_picture_exactly(camera):
    """Transforms move the square only; the track must read them where the square has gone."""
    points, tcp = scene(camera)
    track = HandTrack.start(hand(points, tcp), tcp, intrinsics(camera), futures=2)
    corner, true, steps, way = (20, 24), tcp.clone(), [], [tcp]
    for du, dv in [(6, 0), (3, 5), (0, -8)]:  # whole pixels, farther than the hand is wide
        shift = torch.tensor([du * HAND / camera.K[0, 0], dv * HAND / camera.K[1, 1], 0.0], dtype=torch.float64)
        moved = torch.cat([torch.eye(3, dtype=torch.float64), shift[:, None]], dim=1)
        track, step = track.advance(*square(moved, corner)), square(moved, corner, batch=1)
        corner, true = (corner[0] + du, corner[1] + dv), true + shift
        np.testing.assert_allclose(track.tcp, true.expand(2, 3), atol=1e-9)
        steps, way = [*steps, step], [*way, true]
    np.testing.assert_allclose(tcp_way(points, tcp, intrinsics(camera), steps), torch.stack(way), atol=1e-9)


def test_background_around_and_soft_masks_do_not_hold_the_hand_back(camera):
    """Half of the pixels chosen show the wall, and the hand's mask is soft: the blended transforms are too short."""
    points, tcp = scene(camera)
    shift = torch.tensor([0.02, 0.0, 0.01], dtype=torch.float64)
    background = torch.full((1, 1, 64, 64), 1.0, dtype=torch.float64)
    background[..., 24:30, 20:23] = 0.3
    field = torch.eye(3, 4, dtype=torch.float64)[None, :, :, None, None].repeat(1, 1, 1, 64, 64)
    field[:, :, 3] += (1 - background) * shift.view(1, 3, 1, 1)
    track = HandTrack.start(hand(points, tcp), tcp, intrinsics(camera), futures=1).advance(field, background)
    np.testing.assert_allclose(track.tcp[0], tcp + shift, atol=1e-9)
    still = HandTrack.start(hand(points, tcp), tcp, intrinsics(camera), futures=1)
    ones = torch.ones_like(background)
    identity = torch.eye(3, 4, dtype=torch.float64)[None, :, :, None, None].expand(1, 3, 4, 64, 64)
    np.testing.assert_allclose(still.advance(identity, ones).tcp[0], tcp, atol=1e-12)


def test_rotation_and_motion_in_depth_move_the_tcp_as_part_of_the_body(camera):
    points, tcp = scene(camera)
    angle = 0.3
    turn = torch.tensor(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]], dtype=torch.float64
    )
    pivot, shift = torch.tensor([0.0, 0.0, HAND], dtype=torch.float64), torch.tensor([0.0, 0.01, 0.05])
    transform = torch.cat([turn, (pivot - turn @ pivot + shift)[:, None]], dim=1)
    everywhere = transform[None, :, :, None, None].expand(3, 3, 4, 64, 64)
    track = HandTrack.start(hand(points, tcp), tcp, intrinsics(camera), futures=3)
    expected = tcp
    for _ in range(2):
        track = track.advance(everywhere, torch.zeros(3, 1, 64, 64))
        expected = turn @ (expected - pivot) + pivot + shift
    np.testing.assert_allclose(track.tcp, expected.expand(3, 3), atol=1e-9)


def test_futures_are_apart_and_points_off_the_picture_do_no_harm(camera):
    points, tcp = scene(camera)
    track = HandTrack.start(hand(points, tcp), tcp, intrinsics(camera), futures=2)
    far = torch.eye(3, 4, dtype=torch.float64).repeat(2, 1, 1)
    far[1, :, 3] = torch.tensor([-5.0, 3.0, 0.0])
    field = far[..., None, None].expand(2, 3, 4, 64, 64)
    nothing_behind = torch.zeros(2, 1, 64, 64)
    track = track.advance(field, nothing_behind).advance(field, nothing_behind)
    np.testing.assert_allclose(track.tcp[0], tcp)
    np.testing.assert_allclose(track.tcp[1], tcp + 2 * far[1, :, 3])


def test_fields_are_read_between_pixels_where_points_project_to():
    wide = CameraModel.from_fovy(20, 10, 40.0, np.eye(4), 0.5, 5.0)
    pixels = torch.tensor([[0.0, 0.0], [19.0, 9.0], [15.25, 2.5]], dtype=torch.float64)
    rays = torch.cat([pixels, torch.ones(3, 1)], dim=1) @ torch.linalg.inv(intrinsics(wide)).T
    seen = _seen_at(2.0 * rays[None], intrinsics(wide), pixel_grid(10, 20)[None])
    np.testing.assert_allclose(seen[0], pixels, atol=1e-9)


def on_the_hand(camera, pixels):
    """Points (M, 3) of the square at these (u, v)."""
    points, _ = scene(camera)
    return torch.stack([points[:, v, u] for u, v in pixels])


def test_a_turning_surface_takes_its_point_along_and_its_points_agree(camera):
    body = on_the_hand(camera, [(20, 24), (25, 24), (21, 29)])
    point = body[0] + torch.tensor([0.004, -0.003, 0.0])
    angle = torch.tensor(0.4, dtype=torch.float64)
    cos, sin = torch.cos(angle), torch.sin(angle)
    turn = torch.eye(3, dtype=torch.float64)
    turn[0, :2], turn[1, :2] = torch.stack([cos, -sin]), torch.stack([sin, cos])
    pivot, shift = body.mean(dim=0), torch.tensor([0.01, 0.02, 0.0], dtype=torch.float64)
    transform = torch.cat([turn, (pivot - turn @ pivot + shift)[:, None]], dim=1)
    everywhere = transform[None, :, :, None, None].expand(2, 3, 4, 64, 64)
    track = SurfaceTrack.start(body, point, intrinsics(camera), futures=2)
    expected = point
    for _ in range(3):
        track = track.advance(everywhere, torch.zeros(2, 1, 64, 64))
        expected = turn @ (expected - pivot) + pivot + shift
    np.testing.assert_allclose(track.expected_position(), expected.expand(2, 3), atol=1e-9)
    goal = expected + torch.tensor([0.0, 0.03, 0.04])
    np.testing.assert_allclose(track.expected_distance(goal), [0.05, 0.05], atol=1e-9)


def test_a_surface_that_is_torn_apart_is_not_at_its_goal_though_its_mean_is(camera):
    """Half of the points fly twice as far as the goal, the others stay; each is read where it has gone."""
    body = on_the_hand(camera, [(20, 24), (20, 29), (25, 24), (25, 29)])
    point = body.mean(dim=0)
    step = torch.tensor([6 * HAND / camera.K[0, 0], 0.0, 0.0], dtype=torch.float64)  # 6 pixels
    track = SurfaceTrack.start(body, point, intrinsics(camera), futures=1)
    for gone in (0, 6):
        field = torch.eye(3, 4, dtype=torch.float64)[None, :, :, None, None].repeat(1, 1, 1, 64, 64)
        field[:, :, 3, :, 24 + gone : 27 + gone] += step.view(1, 3, 1, 1)
        track = track.advance(field, torch.zeros(1, 1, 64, 64))
    goal = point + step
    np.testing.assert_allclose(track.expected_position()[0], goal, atol=1e-9)
    np.testing.assert_allclose(track.expected_distance(goal), step.norm()[None], atol=1e-9)


def test_what_little_is_blended_into_a_thing_at_rest_hardly_moves_it(camera):
    """Not so for the hand, which is known to move."""
    body = on_the_hand(camera, [(20, 24), (25, 29)])
    point, shift = body.mean(dim=0), torch.tensor([0.05, 0.0, 0.0], dtype=torch.float64)
    background = torch.full((1, 1, 64, 64), 0.97, dtype=torch.float64)
    field = torch.eye(3, 4, dtype=torch.float64)[None, :, :, None, None].repeat(1, 1, 1, 64, 64)
    field[:, :, 3] += (1 - background) * shift.view(1, 3, 1, 1)
    surface = SurfaceTrack.start(body, point, intrinsics(camera), futures=1).advance(field, background)
    hand = HandTrack(point[None], body[None], intrinsics(camera)).advance(field, background)
    np.testing.assert_allclose(surface.expected_distance(point), [0.03 * 0.05], atol=1e-9)
    np.testing.assert_allclose(hand.expected_distance(point), [0.05], atol=1e-9)
