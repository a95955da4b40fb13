"""The inference network: clips of any length, what a latent sees, and that it can be learned."""

import pytest
import torch

from worldmodel.inference import FIRST_LOG_VARIANCE, LOG_VARIANCES, InferenceNetwork


@pytest.fixture
def network():
    torch.manual_seed(0)
    return InferenceNetwork(4, 1, width=0.25, per_clip=False)


def frames(length, seed=0):
    return torch.rand((2, length, 4, 16, 24), generator=torch.Generator().manual_seed(seed))


@torch.no_grad()
@pytest.mark.parametrize("per_clip", [False, True])
@pytest.mark.parametrize("length", [2, 3, 7])
def test_any_clip_length(per_clip, length):
    torch.manual_seed(0)
    network = InferenceNetwork(4, 1, width=0.25, per_clip=per_clip)
    mean, log_variance = network(frames(length))
    assert mean.shape == log_variance.shape == (2, length - 1, 1, 2, 3)
    assert LOG_VARIANCES[0] <= log_variance.min() and log_variance.max() <= LOG_VARIANCES[1]
    same_over_time = torch.allclose(mean, mean[:, :1].expand_as(mean), atol=1e-7)
    assert same_over_time == (per_clip or length == 2)


@torch.no_grad()
def test_a_latent_sees_the_frames_around_it_and_the_clip(network):
    clip = frames(12)
    mean = network(clip)[0]
    for changed in range(12):
        other = clip.clone()
        other[:, changed] = frames(1, seed=1)[:, 0]
        difference = (network(other)[0] - mean).abs().mean((0, 2, 3, 4))
        beside = [t for t in range(11) if changed in (t, t + 1)]
        away = [t for t in range(11) if t not in beside]
        assert difference.min() > 0  # through the mean over the clip
        assert min(difference[beside]) > 1.5 * max(difference[away])


@torch.no_grad()
def test_what_stands_still_in_the_clip_is_not_seen(network):
    clip, scenery = frames(5), frames(1, seed=1)
    expected = network(clip)
    for seen, same in zip(network(clip + scenery), expected, strict=True):
        torch.testing.assert_close(seen, same, rtol=1e-4, atol=1e-5)
    plain = InferenceNetwork(4, 1, width=0.25, per_clip=False, evidence="frames")
    plain.load_state_dict(network.state_dict())
    assert not torch.allclose(plain(clip + scenery)[0], plain(clip)[0], atol=1e-2)


@torch.no_grad()
def test_an_untrained_latent_is_heard_above_its_noise(network):
    mean, log_variance = network(torch.cat([frames(5, seed) for seed in range(8)]))
    assert (log_variance - FIRST_LOG_VARIANCE).abs().max() < 2
    assert mean.std() > (0.5 * log_variance).exp().mean()


def test_the_gradient_of_a_draw_reaches_every_weight(network):
    mean, log_variance = network(frames(3))
    noise = torch.randn(mean.shape, generator=torch.Generator().manual_seed(0))
    weights = torch.randn(mean.shape, generator=torch.Generator().manual_seed(1))
    (weights * (mean + (0.5 * log_variance).exp() * noise)).sum().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad.isfinite().all() and parameter.grad.abs().max() > 0, name
    bias = network.heads.bias.grad  # of the mean, and of the log variance
    torch.testing.assert_close(bias[0], weights.sum(), rtol=1e-4, atol=1e-4)
    expected = (weights * 0.5 * (0.5 * log_variance).exp() * noise).sum().detach()
    torch.testing.assert_close(bias[1], expected, rtol=1e-4, atol=1e-4)
