"""What is said about latents, against posteriors that are known."""

import pytest
import torch
from torch.distributions import Normal, kl_divergence

from worldmodel.latents import infer_latents, latent_use


class Posterior:
    """An inference network that says what it is told to."""

    def __init__(self, mean, log_variance, per_clip):
        self.answer, self.per_clip = (mean, log_variance), per_clip

    def __call__(self, frames):
        return self.answer


@pytest.mark.parametrize("per_clip", [False, True])
def test_each_latent_is_counted_once_with_its_divergence_in_nats(per_clip, make_model, source):
    draws = torch.randn((2, 2, 1 if per_clip else 3, 1, 2, 3), generator=torch.Generator().manual_seed(0))
    mean, log_variance = draws.expand(-1, -1, 3, -1, -1, -1)
    clips = source.at(source.spread(2, 4), 4)
    latents, inferred = infer_latents(make_model(), Posterior(mean, log_variance, per_clip), clips)
    assert torch.equal(latents, mean)
    once, spread = draws[0], (0.5 * draws[1]).exp()
    assert torch.equal(inferred["means"], once.reshape(-1, 6))
    nats = kl_divergence(Normal(once, spread), Normal(0.0, 1.0)).reshape(-1, 6).sum(1)
    torch.testing.assert_close(inferred["divergence"], nats)


def test_a_unit_is_active_if_its_mean_varies_over_the_data():
    means = torch.tensor([[5.0, 0.09, 0.11], [5.0, -0.09, -0.11]])  # variances 0, 0.0081, 0.0121
    use = latent_use({"means": means, "divergence": torch.tensor([1.0, 3.0])})
    assert use == {"units": 3, "active": 1, "kl_nats": 2.0}
