"""Futures from the prior: the same as unrolling, and the best of them by the rule that was asked for."""

import pytest
import torch

from worldmodel.rollout import unroll
from worldmodel.sampling import Futures, best_future, draw_latents, predict_futures

CONTEXT, PREDICTED, SAMPLES = 2, 3, 4


@pytest.fixture
def clip(source):
    return source.at(source.starts(CONTEXT + PREDICTED)[:1], CONTEXT + PREDICTED)


@torch.inference_mode()
def test_every_future_is_what_unrolling_with_its_latents_gives(make_model, clip):
    model = make_model()
    torch.nn.init.normal_(model.encoder.join.weight, std=0.5)  # or untrained latents would hardly show
    latents = draw_latents(model, SAMPLES, PREDICTED, (0, 7))
    futures = predict_futures(model, clip, CONTEXT, latents)
    assert futures.rgb.shape == (SAMPLES, PREDICTED, 3, 16, 24) and futures.inpainted.shape == (SAMPLES, PREDICTED)
    padded = torch.cat((torch.zeros_like(latents[:, : CONTEXT - 1]), latents), dim=1)
    for n in range(SAMPLES):
        rollout = unroll(model, clip, CONTEXT, padded[n : n + 1])
        torch.testing.assert_close(rollout.stack("rgb")[0, CONTEXT - 1 :], futures.rgb[n], atol=1e-4, rtol=0)
        torch.testing.assert_close(rollout.stack("depth")[0, CONTEXT - 1 :], futures.depth[n], atol=1e-3, rtol=0)
    assert (futures.rgb[0] - futures.rgb[1]).abs().max() > 1e-3


def test_latents_are_those_of_the_seed(make_model):
    model, per_clip = make_model(), make_model(latents="clip", masks=3)
    first = draw_latents(model, SAMPLES, PREDICTED, (0, 7))
    assert torch.equal(first, draw_latents(make_model(seed=1), SAMPLES, PREDICTED, (0, 7)))
    for other in ((0, 8), (1, 7)):
        assert not torch.equal(first, draw_latents(model, SAMPLES, PREDICTED, other))
    assert first.mean().abs() < 0.4 and 0.6 < first.std() < 1.4
    repeated = draw_latents(per_clip, SAMPLES, PREDICTED, (0, 7))
    assert torch.equal(repeated[:, 0], repeated[:, 2]) and not torch.equal(repeated[0], repeated[1])


class Darkness:
    """Calls alike what is equally bright, wrongly by as much as it is told."""

    def __init__(self, errors=0.0):
        self.errors, self.seen = torch.as_tensor(errors), 0

    def __call__(self, predicted, target):
        self.seen += len(predicted)
        distance = (predicted.mean((1, 2, 3)) - target.mean((1, 2, 3))).abs() + self.errors
        return distance, 1 - distance


def test_the_best_future_by_psnr_and_by_vgg():
    truth = torch.full((1, 2, 3, 4, 4), 0.5)
    rgb = truth + torch.tensor([0.4, 0.1, 0.2, 0.3, 0.15, 0.25, 0.35]).view(7, 1, 1, 1, 1)
    rgb[4, :, :, :2] -= 0.3  # as bright as the truth on the whole, and wrong everywhere
    futures = Futures(rgb, None, None)
    assert best_future(futures, truth, None) == 1
    deciding = Darkness()
    assert best_future(futures, truth, (deciding, deciding)) == 4
    ranking, deciding = Darkness([0, 0, 0, 0, 0.15, 0, 0]), Darkness()  # the ranking errs, the decision does not
    assert best_future(futures, truth, (ranking, ranking)) != 4
    assert best_future(futures, truth, (ranking, deciding)) == 4 and deciding.seen == 2 * 5


def test_one_future_is_picked_with_all_that_belongs_to_it():
    futures = Futures(torch.rand(3, 2, 3, 4, 4), torch.rand(3, 2, 1, 4, 4), torch.rand(3, 2))
    chosen = futures.pick(1)
    assert torch.equal(chosen.rgb, futures.rgb[1:2]) and torch.equal(chosen.depth, futures.depth[1:2])
    assert torch.equal(chosen.inpainted, futures.inpainted[1:2])
