"""Designated pixels go where the model's own colours go, and nothing is made of what is lost."""

import pytest
import torch

from worldmodel.config import ModelConfig
from worldmodel.kernels import KernelHeads, KernelPrediction
from worldmodel.models import KINDS
from worldmodel.pixel_tracking import PixelTrack, uniform_pixels

SIZE = 48


def one_hot(u, v):
    return uniform_pixels(torch.tensor([SIZE * v + u]), SIZE, SIZE)


def prediction(moves, sources=3, source=1, kernel_size=9):
    """Futures that each take all their pixels from one source; the kernel moves pixels by (du, dv)."""
    kernels = torch.zeros(len(moves), 1, kernel_size, kernel_size)
    for i, (du, dv) in enumerate(moves):
        kernels[i, 0, kernel_size // 2 - dv, kernel_size // 2 - du] = 1
    masks = torch.zeros(len(moves), sources, SIZE, SIZE)
    masks[:, source] = 1
    return KernelPrediction(torch.zeros(len(moves), 3, SIZE, SIZE), masks, None, kernels)


@pytest.mark.parametrize("kind", ["cdna", "sna"])
def test_pixels_go_where_the_model_puts_their_colour(kind, make_model, camera_of):
    """A picture that shows the distribution is rendered by the model itself, without the generated picture."""
    torch.manual_seed(0)
    context = make_model(camera_of(SIZE, SIZE)).context
    model = KINDS[kind](ModelConfig(width=0.25, masks=4, latents="none"), context)
    now = uniform_pixels(torch.tensor([SIZE * 14 + 15, SIZE * 14 + 16, SIZE * 17 + 13]), SIZE, SIZE)
    before = one_hot(11, 20)
    track = PixelTrack.start(now, before)
    picture = now.expand(3, 3, SIZE, SIZE)
    first = before.expand(3, 3, SIZE, SIZE) if model.copies_first else None
    for _ in range(2):
        kernels = torch.rand(3, 4, 9, 9)
        heads = KernelHeads(
            torch.randn(3, model.sources, SIZE, SIZE),
            torch.full((3, 3, SIZE, SIZE), -torch.inf),
            kernels / kernels.sum(dim=(2, 3), keepdim=True),
        )
        rendered = model.render(picture, torch.zeros(3, 1, SIZE, SIZE), heads, first, still=False)
        track = track.advance(rendered)
        expected = rendered.rgb[:, 0] / rendered.rgb[:, 0].sum(dim=(1, 2), keepdim=True)
        torch.testing.assert_close(track.distribution, expected, atol=1e-6, rtol=1e-4)
        picture = expected[:, None].expand(3, 3, SIZE, SIZE)
    top, bottom, left, right = track.box
    assert bottom - top < SIZE and right - left < SIZE  # part of the picture was enough
    assert all(edge % 8 == 0 for edge in track.box)  # of a few sizes, so that memory is used again


def test_futures_begin_as_one_and_move_apart():
    track = PixelTrack.start(one_hot(10, 20)).advance(prediction([(4, -3), (0, 0), (-2, 1)]))
    torch.testing.assert_close(track.expected_position(), torch.tensor([[14.0, 17], [10, 20], [8, 21]]))
    track = track.advance(prediction([(1, 0), (2, 2), (-4, 4)]))
    torch.testing.assert_close(track.expected_position(), torch.tensor([[15.0, 17], [12, 22], [4, 25]]))
    distance = track.expected_distance(torch.tensor([12.0, 21.0]))
    torch.testing.assert_close(distance, torch.tensor([5.0, 1.0, 80**0.5]))


def test_expected_distance_is_the_mean_over_the_spread():
    track = PixelTrack.start(0.25 * one_hot(4, 9) + 0.75 * one_hot(12, 9))
    torch.testing.assert_close(track.expected_position(), torch.tensor([[10.0, 9.0]]))
    torch.testing.assert_close(track.expected_distance(torch.tensor([10.0, 9.0])), torch.tensor([3.0]))


def test_the_hand_goes_as_far_as_what_the_kernels_move_of_its_pixels():
    """A third of the pixels show the table, which stays; the mask of what moves is soft, and some of it is painted."""
    track = PixelTrack.start(uniform_pixels(torch.tensor([SIZE * 20 + 20, SIZE * 20 + 21, SIZE * 20 + 30]), SIZE, SIZE))
    moves = prediction([(4, -3), (0, 2)], sources=4)
    moves.masks[:] = torch.tensor([0.2, 0.5, 0.2, 0.1])[:, None, None]
    moves.masks[:, :, :, 27:] = torch.tensor([1.0, 0, 0, 0])[:, None, None]
    track = track.advance(moves)
    torch.testing.assert_close(track.shift, torch.tensor([[4.0, -3], [0, 2]]))
    assert track.expected_position()[0, 0] < 23.67 + 2.5  # the mean lags behind
    track = track.advance(moves)
    torch.testing.assert_close(track.shift, torch.tensor([[8.0, -6], [0, 4]]))


def test_a_hand_of_which_next_to_nothing_moves_stands_still():
    moves = prediction([(4, 0), (4, 0)])
    moves.masks[0], moves.masks[1] = (torch.tensor([1 - share, share, 0])[:, None, None] for share in (0.002, 0.0))
    track = PixelTrack.start(one_hot(20, 20)).advance(moves)
    torch.testing.assert_close(track.shift, torch.tensor([[0.4, 0], [0, 0]]))


def test_what_the_generated_picture_covers_is_lost_and_the_rest_scaled_up():
    track = PixelTrack.start(uniform_pixels(torch.tensor([SIZE * 5 + 5, SIZE * 5 + 25]), SIZE, SIZE))
    half = prediction([(1, 0), (1, 0)])
    half.masks[0, 1, :, :16], half.masks[0, 2, :, :16] = 0.0, 1.0
    half.masks[0, 1, :, 16:], half.masks[0, 2, :, 16:] = 0.0, 1.0
    half.masks[0, 1, 5, 26], half.masks[0, 2, 5, 26] = 0.1, 0.9
    track = track.advance(half)
    torch.testing.assert_close(track.distribution[0], one_hot(26, 5))
    torch.testing.assert_close(track.distribution[1].sum(), torch.tensor(1.0))


def test_a_future_without_any_mass_left_has_no_place():
    lost = prediction([(0, 0), (0, 0)])
    lost.masks[1] = torch.tensor([0.0, 0.0, 1.0])[:, None, None]
    track = PixelTrack.start(one_hot(8, 8)).advance(lost).advance(prediction([(1, 0), (1, 0)]))
    distance = track.expected_distance(torch.tensor([8.0, 8.0]))
    assert distance[0] == 1 and distance[1].isnan()
    assert track.shift[0, 0] == 1 and track.shift[1].isnan().all()


def test_the_first_frame_brings_back_where_the_pixels_were():
    track = PixelTrack.start(one_hot(20, 20), one_hot(3, 30))
    both = prediction([(2, 0)], sources=4)
    both.masks[:, 1], both.masks[:, 3] = 0.75, 0.25
    track = track.advance(both)
    torch.testing.assert_close(track.distribution[0], 0.75 * one_hot(22, 20) + 0.25 * one_hot(3, 30))
    only_first = track.advance(prediction([(0, 0)], sources=4, source=3))
    torch.testing.assert_close(only_first.distribution[0], one_hot(3, 30))


def test_mass_leaves_the_picture_but_none_comes_in():
    """At the edge colours are repeated; a designated pixel must not become several."""
    start = PixelTrack.start(uniform_pixels(torch.tensor([0, SIZE - 1, SIZE * SIZE - 1]), SIZE, SIZE))
    track = start.advance(prediction([(3, 3), (-4, 0)]))
    torch.testing.assert_close(track.distribution[0], one_hot(3, 3))
    torch.testing.assert_close(track.distribution[1], 0.5 * one_hot(SIZE - 5, 0) + 0.5 * one_hot(SIZE - 5, SIZE - 1))


@pytest.mark.parametrize("kind", ["t3vip", "sv2p"])
def test_motion_is_the_same_without_a_picture(kind, make_model, camera_of):
    context = make_model(camera_of(SIZE, SIZE)).context
    model = KINDS[kind](ModelConfig(width=0.25, masks=4), context).eval()
    rgb, depth = torch.rand(1, 2, 3, SIZE, SIZE), torch.full((1, 2, 1, SIZE, SIZE), 2.0)
    actions = torch.randn(3, 7)
    with torch.inference_mode():
        state = model.observe(rgb, depth, torch.randn(1, 1, 7))
        _, full = model.step(state, actions, paint=False)
        _, bare = model.step(state, actions, paint=False, picture=False)
    assert not torch.equal(full.rgb, bare.rgb)
    for name in ("masks", "transform", "optical_flow") if kind == "t3vip" else ("masks", "kernels"):
        torch.testing.assert_close(getattr(full, name), getattr(bare, name))
