"""Each term of the objective against its definition."""

import math

import pytest
import torch

from envs.errors import UsageError
from worldmodel import losses
from worldmodel.geometry import pixel_grid

RADIUS = 2


def clouds(seed, height=7, width=9, batch=2):
    generator = torch.Generator().manual_seed(seed)
    return (torch.randn((batch, 3, height, width), dtype=torch.float64, generator=generator) for _ in range(2))


def in_window(height, width, radius):
    """(HW, HW) bool: which pixels lie in the window about which."""
    grid = pixel_grid(height, width).flatten(1)
    return ((grid[:, :, None] - grid[:, None, :]).abs() <= radius).all(0)


@pytest.mark.parametrize("radius", [1, RADIUS, 20])
def test_nearest_neighbour_is_that_of_brute_force_also_at_borders(radius):
    query, reference = clouds(0)
    distances = torch.cdist(query.flatten(2).transpose(1, 2), reference.flatten(2).transpose(1, 2))
    distances = distances.masked_fill(~in_window(7, 9, radius), torch.inf)
    expected = distances.min(dim=2)
    assert torch.equal(losses.nearest_in_window(query, reference, radius).flatten(1), expected.indices)
    torch.testing.assert_close(losses.knn_distance(query, reference, radius), expected.values.mean())


def test_alignment_looks_both_ways():
    moved, target = clouds(1)
    both = losses.knn_distance(moved, target, RADIUS) + losses.knn_distance(target, moved, RADIUS)
    torch.testing.assert_close(losses.knn_alignment(moved, target, RADIUS), both)
    assert losses.knn_alignment(target, target, RADIUS) < 1e-5


def test_chamfer_distance_is_that_of_brute_force(monkeypatch):
    monkeypatch.setattr(losses, "_AT_ONCE", 25)  # so that 63 points are no multiple of it
    moved, target = clouds(5)
    rows = [[torch.linalg.vector_norm(moved[b, :, y, x, None, None] - target[b], dim=0).flatten()
             for y in range(7) for x in range(9)] for b in range(2)]  # fmt: skip
    distances = torch.stack([torch.stack(row) for row in rows])  # (B, HW of moved, HW of target)
    assert torch.equal(losses.nearest_of_all(moved, target).flatten(1), distances.argmin(2))
    torch.testing.assert_close(losses.chamfer_distance(moved, target), distances.amin(2).mean())
    torch.testing.assert_close(losses.chamfer_distance(target, moved), distances.amin(1).mean())
    both = distances.amin(2).mean() + distances.amin(1).mean()
    torch.testing.assert_close(losses.chamfer_alignment(moved, target), both)


def test_chamfer_is_knn_with_the_whole_picture_for_a_window():
    moved, target = (cloud.requires_grad_() for cloud in clouds(6))
    answers = []
    for weights in (losses.LossWeights(alignment="chamfer"), losses.LossWeights(knn_radius=9)):
        loss = losses.alignment(moved, target, weights)
        answers.append((loss, *torch.autograd.grad(loss, (moved, target))))
    for chamfer, knn in zip(*answers, strict=True):
        torch.testing.assert_close(chamfer, knn, rtol=0, atol=0)
    narrow = losses.alignment(moved, target, losses.LossWeights(knn_radius=1))
    assert narrow > 1.1 * answers[0][0]  # what a window misses


def test_a_cloud_that_is_no_number_gives_a_loss_that_is_none():
    moved, target = clouds(2, 6, 8, 1)
    for query, reference in ((moved, target * torch.nan), (moved * torch.nan, target)):
        assert losses.nearest_in_window(query, reference, 2).max() < 6 * 8
        assert losses.nearest_in_window(query, reference, 2).min() >= 0
        assert losses.knn_alignment(query, reference, 2).isnan()


def test_gradient_of_the_alignment_is_right_and_finite_where_points_coincide():
    moved, target = clouds(2, 3, 4, 1)
    assert torch.autograd.gradcheck(lambda x: losses.knn_alignment(x, target, 1), (moved.requires_grad_(),))
    same = target.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(losses.knn_alignment(same, target, 1), same)
    assert gradient.isfinite().all()


@pytest.mark.parametrize(("power", "expected"), [(1, 1.5), (2, 2.5)])
def test_reconstruction(power, expected):
    assert float(losses.reconstruction(torch.tensor([1.0, -1.0]), torch.tensor([0.0, 1.0]), power)) == expected


def test_smoothness_is_zero_for_linear_flow_and_lets_go_at_edges():
    grid = pixel_grid(8, 10)[None]
    linear = torch.cat((0.3 * grid[:, :1] - 0.2 * grid[:, 1:] + 1, grid[:, 1:] * 0.5), dim=1)
    flat = torch.full((1, 3, 8, 10), 0.5)
    assert losses.edge_aware_smoothness(linear, flat) < 1e-5
    step = (grid[:, :1] >= 5).float()
    on_flat = losses.edge_aware_smoothness(step, flat)
    assert on_flat == pytest.approx(2 / 8)  # two columns of eight with a second difference of one
    on_edge = losses.edge_aware_smoothness(step, step.expand(-1, 3, -1, -1))
    assert on_edge < 1e-3 * on_flat
    elsewhere = (grid[:, 1:] >= 4).float().expand(-1, 3, -1, -1)  # an edge across does not excuse it
    assert losses.edge_aware_smoothness(step, elsewhere) == pytest.approx(float(on_flat))
    rows = (grid[:, 1:] >= 4).float()
    assert losses.edge_aware_smoothness(rows, flat) == pytest.approx(2 / 6)


def test_smoothness_is_the_mean_over_channels_of_flow_and_of_edges():
    columns = pixel_grid(8, 10)[None, :1]
    step, flat = (columns >= 5).float(), torch.full((1, 3, 8, 10), 0.5)
    on_flat = float(losses.edge_aware_smoothness(step, flat))
    assert losses.edge_aware_smoothness(step.expand(-1, 3, -1, -1), flat) == pytest.approx(on_flat)
    faint = flat + 0.3 * step * torch.tensor([1.0, 0.0, 0.0]).view(3, 1, 1)  # in one colour of three
    assert losses.edge_aware_smoothness(step, faint) == pytest.approx(on_flat * math.exp(-0.1 * losses.EDGE_SHARPNESS))


def test_kl_is_that_of_torch_distributions():
    generator = torch.Generator().manual_seed(4)
    mean, log_variance = (torch.randn((3, 2, 2, 4, 5), generator=generator) for _ in range(2))
    posterior = torch.distributions.Normal(mean, (0.5 * log_variance).exp())
    prior = torch.distributions.Normal(torch.zeros(()), torch.ones(()))
    expected = torch.distributions.kl_divergence(posterior, prior).flatten(2).sum(2).mean() / 640
    torch.testing.assert_close(losses.kl_to_prior(mean, log_variance, 640), expected)


@pytest.mark.parametrize("name", ["rgb", "depth", "knn", "scene_smoothness", "optical_smoothness", "kl"])
def test_negative_weights_are_refused(name):
    with pytest.raises(UsageError, match=rf"{name} is -0.5; give 0"):
        losses.LossWeights(**{name: -0.5})


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_no_numbers_are_refused(value):
    with pytest.raises(UsageError, match=rf"kl is {value}; give 0"):
        losses.LossWeights(kl=value)


def test_a_window_of_nothing_is_refused():
    with pytest.raises(UsageError, match="knn-radius is 0; give at least 1"):
        losses.LossWeights(knn_radius=0)
