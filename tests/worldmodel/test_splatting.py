"""Forward warping against a loop that does what its name says, and against layers whose picture is known."""

import itertools

import pytest
import torch

from worldmodel import splatting
from worldmodel.geometry import pixel_grid
from worldmodel.splatting import splat, splat_sum

HEIGHT, WIDTH = 6, 12
NEAR = slice(4, 7)  # columns of the nearer layer


def naive(values, pixels):
    out = torch.zeros_like(values)
    batch, _, height, width = values.shape
    for b, y, x in itertools.product(range(batch), range(height), range(width)):
        u, v = pixels[b, :, y, x].tolist()
        left, top = int(u // 1), int(v // 1)
        for column, row in itertools.product((left, left + 1), (top, top + 1)):
            share = (1 - abs(u - column)) * (1 - abs(v - row))
            if 0 <= column < width and 0 <= row < height:
                out[b, :, row, column] += share * values[b, :, y, x]
    return out


def scattered(seed, *shape, channels=2):
    """Values, and places in, around and far outside of the picture, none on the lines where the gradient jumps."""
    generator = torch.Generator().manual_seed(seed)
    batch, height, width = shape
    values = torch.randn((batch, channels, height, width), dtype=torch.float64, generator=generator)
    spread = torch.rand((batch, 2, height, width), dtype=torch.float64, generator=generator)
    whole = (spread * torch.tensor([width + 6, height + 6]).view(2, 1, 1)).floor() - 4
    return values, whole + 0.2 + 0.6 * torch.rand(whole.shape, dtype=torch.float64, generator=generator)


def layers(shift, far=2.0):
    """A near layer (value 1, one metre away) shifted to the right over a far one (value 0.25)."""
    depth = torch.full((1, 1, HEIGHT, WIDTH), far)
    depth[..., NEAR] = 1.0
    values = torch.full((1, 1, HEIGHT, WIDTH), 0.25)
    values[..., NEAR] = 1.0
    pixels = pixel_grid(HEIGHT, WIDTH)[None].clone()
    pixels[:, 0, :, NEAR] += shift
    return values, pixels, depth


@pytest.mark.parametrize("shape", [(2, 4, 5), (1, 7, 3)])
def test_splat_sum_is_the_loop(shape):
    values, pixels = scattered(0, *shape)
    torch.testing.assert_close(splat_sum(values, pixels), naive(values, pixels))


def test_gradients_of_splat_sum_in_both_arguments():
    values, pixels = scattered(1, 1, 3, 4)
    assert torch.autograd.gradcheck(splat_sum, (values.requires_grad_(), pixels.requires_grad_()))


def test_in_deterministic_mode_it_is_the_same(monkeypatch):
    """What a GPU does then, on the CPU."""
    values, pixels = (x.requires_grad_() for x in scattered(2, 2, 5, 4))
    expected = splat_sum(values, pixels)
    weights = torch.randn(expected.shape, dtype=expected.dtype, generator=torch.Generator().manual_seed(0))
    gradients = torch.autograd.grad(expected, (values, pixels), weights)
    monkeypatch.setattr(splatting, "_order_matters", lambda values: torch.are_deterministic_algorithms_enabled())
    torch.use_deterministic_algorithms(True)
    try:
        ordered = splat_sum(values, pixels)
        in_order = torch.autograd.grad(ordered, (values, pixels), weights)
        assert torch.are_deterministic_algorithms_enabled()
    finally:
        torch.use_deterministic_algorithms(False)
    for ours, theirs in zip((ordered, *in_order), (expected, *gradients), strict=True):
        torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("mode", ["average", "softmax"])
def test_gradients_of_splat(mode):
    values, pixels = scattered(2, 1, 3, 4)
    depth = 1 + torch.rand((1, 1, 3, 4), dtype=torch.float64, generator=torch.Generator().manual_seed(3))

    def picture(values, pixels, depth):
        return splat(values, pixels, depth, mode, sharpness=2.0)[0]

    arguments = (values.requires_grad_(), pixels.requires_grad_(), depth.requires_grad_(mode == "softmax"))
    assert torch.autograd.gradcheck(picture, arguments)


def test_gradient_of_values_in_mode_over():
    values, pixels = scattered(4, 1, 3, 4)
    depth = 1 + torch.rand((1, 1, 3, 4), dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    assert torch.autograd.gradcheck(lambda x: splat(x, pixels, depth, "over")[0], (values.requires_grad_(),))


def test_mass_is_kept_inside_and_lost_outside():
    values = torch.rand(1, 1, 5, 7, generator=torch.Generator().manual_seed(0))
    grid = pixel_grid(5, 7)[None]
    inside = torch.cat((grid[:, :1] * 0.9 + 0.13, grid[:, 1:] * 0.8 + 0.21), dim=1)
    torch.testing.assert_close(splat_sum(values, inside).sum(), values.sum())
    half_a_pixel_out = grid + torch.tensor([0.0, 0.5]).view(2, 1, 1)
    kept = values.sum() - values[:, :, -1].sum() / 2
    torch.testing.assert_close(splat_sum(values, half_a_pixel_out).sum(), kept)
    for far in (8.0, 1e6, -1e6):
        assert splat_sum(values, grid + far).abs().sum() == 0


@pytest.mark.parametrize("mode", ["over", "average", "softmax", "sum"])
def test_no_motion_gives_the_picture_back(mode):
    generator = torch.Generator().manual_seed(1)
    values = torch.rand((2, 3, HEIGHT, WIDTH), generator=generator)
    depth = 1 + 3 * torch.rand((2, 1, HEIGHT, WIDTH), generator=generator)
    pixels = pixel_grid(HEIGHT, WIDTH).expand(2, -1, -1, -1)
    picture, coverage = splat(values, pixels, depth, mode, sharpness=3.0)
    # A rounding error of a pixel's place lets its neighbour in; a near one weighs up to exp(9) as much in softmax.
    torch.testing.assert_close(picture, values, atol=1e-3 if mode == "softmax" else 2e-5, rtol=0)
    torch.testing.assert_close(coverage, torch.ones_like(coverage), atol=2e-5, rtol=0)


@pytest.mark.parametrize("sharpness", [3.0, 15.0, 100.0])
def test_a_far_surface_beside_a_near_one_is_not_dimmed(sharpness):
    values, depth = torch.ones(1, 1, HEIGHT, WIDTH), torch.ones(1, 1, HEIGHT, WIDTH)
    depth[..., WIDTH // 2 :] = 6.0
    picture, _ = splat(values, pixel_grid(HEIGHT, WIDTH)[None], depth, "softmax", sharpness)
    torch.testing.assert_close(picture, values, atol=1e-3, rtol=0)


@pytest.mark.parametrize("mode", ["over", "average", "softmax", "sum"])
def test_where_nothing_lands_there_is_nothing(mode):
    values, pixels, depth = layers(1.0)
    picture, coverage = splat(values, pixels, depth, mode, sharpness=3.0)
    assert coverage[..., 4].abs().max() < 1e-5 and coverage[..., 7].min() > 1.99
    shown = picture if mode == "sum" else picture * (coverage > 0.5)
    assert shown[..., 4].abs().max() < 1e-5
    picture, coverage = splat(values, pixels + 100, depth, mode, sharpness=3.0)
    assert torch.count_nonzero(picture) == 0 and torch.count_nonzero(coverage) == 0


@pytest.mark.parametrize("mode", ["over", "average", "softmax", "sum"])
def test_points_behind_the_camera_are_dropped(mode):
    values, pixels, depth = layers(0.0)
    depth[..., NEAR] = -1.0
    picture, coverage = splat(values, pixels, depth, mode, sharpness=3.0)
    assert coverage[..., NEAR].abs().max() < 1e-5 and coverage[..., :4].min() > 0.999
    shown = picture if mode == "sum" else picture * (coverage > 0.5)
    assert shown[..., NEAR].abs().max() < 1e-4


def column_7(shift, mode, sharpness=0.0, far=2.0):
    """What is seen in the far layer's first column next to the near layer."""
    column = splat(*layers(shift, far), mode, sharpness)[0][0, 0, :, 7]
    assert column.max() - column.min() < 1e-4
    return float(column.mean())


def test_a_near_layer_hides_the_far_one_that_it_moved_over():
    assert column_7(1.0, "over") == pytest.approx(1.0, abs=1e-3)


def test_a_tenth_of_a_pixel_hides_a_tenth():
    assert column_7(0.1, "over") == pytest.approx(0.1 * 1 + 0.9 * 0.25, abs=5e-3)
    assert column_7(0.1, "softmax", 5.0) > 0.8  # what mode `over` is for


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("sign", "edge"), [(-1, 0), (1, 7)])
def test_a_near_layer_goes_on_hiding_as_it_leaves_the_picture(axis, sign, edge):
    """The edge of a part of a picture looks as the same column, or row, of the whole one."""
    whole = torch.full((1, 1, 8, 24), 2.0)
    whole[..., slice(9, 12) if sign < 0 else slice(12, 15)] = 1.9

    def seen(depth, shift, place):
        depth = depth.mT if axis else depth
        near = (depth < 2.0).float()
        pixels = pixel_grid(*depth.shape[-2:])[None].clone()
        pixels[:, axis] += sign * shift * near[:, 0]
        return splat(near, pixels, depth, "over")[0].select(3 - axis, place)

    for shift in (0.5, 0.9, 1.0, 1.02, 1.03, 1.3, 1.5, 1.9):
        inside = seen(whole, shift, 8 + edge)
        torch.testing.assert_close(seen(whole[..., 8:16], shift, edge), inside, atol=1e-4, rtol=0)
        assert inside.min() > 0.49 and (shift < 1.0 or inside.min() > 0.96)


def test_points_of_one_surface_share_a_pixel():
    assert column_7(0.5, "over", far=1.005) == pytest.approx((0.5 * 1 + 0.25) / 1.5, abs=1e-3)


def test_the_other_modes():
    assert column_7(1.0, "average") == pytest.approx(0.625, abs=1e-4)
    assert column_7(1.0, "softmax", 0.0) == pytest.approx(0.625, abs=1e-4)
    weight = float(torch.sigmoid(torch.tensor(3.0)))  # exp(-3 * 1) against exp(-3 * 2)
    assert column_7(1.0, "softmax", 3.0) == pytest.approx(weight + 0.25 * (1 - weight), abs=1e-3)
    assert column_7(1.0, "sum") == pytest.approx(1.25, abs=1e-4)
