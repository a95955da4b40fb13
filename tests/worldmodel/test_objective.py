"""What the objective takes its terms of: the frames that come true, and latents of the inferred posterior."""

import math
from types import SimpleNamespace

import pytest
import torch

from worldmodel.losses import LossWeights
from worldmodel.objective import StepInputs, _latents, reconstruction_terms
from worldmodel.rollout import Rollout

FRAMES = 4


@pytest.fixture
def clips(source):
    return source.at(source.spread(2, FRAMES), FRAMES)


def rollout(model, clips, scene_flow, optical_flow):
    """One that predicts the true frames, and the same flows at every step."""
    predictions = [
        SimpleNamespace(
            rgb=clips.rgb[:, t],
            depth=clips.depth[:, t],
            moved_points=clips.depth[:, t] * model.rays,
            scene_flow=scene_flow,
            optical_flow=optical_flow,
        )
        for t in range(1, FRAMES)
    ]
    return Rollout(predictions, clips.rgb[:, :-1].clone().requires_grad_())


def test_what_comes_true_costs_nothing_and_its_inputs_learn_nothing_from_edges(make_model, clips):
    model, still = make_model(), torch.zeros_like(clips.rgb[:, 0])
    terms = reconstruction_terms(model, rollout(model, clips, still, still[:, :2]), clips, LossWeights())
    assert set(terms) == {"rgb", "depth", "knn", "scene_smoothness", "optical_smoothness"}
    for name, term in terms.items():
        assert term < 1e-5 and not term.requires_grad, name


def test_each_flow_has_a_smoothness_of_its_own(make_model, clips):
    model, still = make_model(), torch.zeros_like(clips.rgb[:, 0])
    rough = torch.randn(still.shape, generator=torch.Generator().manual_seed(0))
    of_scene, of_picture = (
        reconstruction_terms(model, rollout(model, clips, *flows), clips, LossWeights())
        for flows in ((rough, still[:, :2]), (still, rough[:, :2]))
    )
    assert of_scene["scene_smoothness"] > 0.1 and of_scene["optical_smoothness"] == 0
    assert of_picture["optical_smoothness"] > 0.1 and of_picture["scene_smoothness"] == 0


def test_latents_are_drawn_from_the_posterior(make_model, clips):
    model = make_model()
    noise = torch.randn((2, FRAMES - 1, *model.latent_shape), generator=torch.Generator().manual_seed(0))
    mean, log_variance = torch.full_like(noise, 0.3), torch.full_like(noise, math.log(4))
    nothing = torch.zeros(())
    inputs = StepInputs(clips.rgb, clips.depth, clips.actions, noise, nothing, nothing, nothing, True, False)
    latents, kl = _latents(model, lambda frames: (mean, log_variance), inputs)
    torch.testing.assert_close(latents, 0.3 + 2 * noise)
    nats = 0.5 * (0.3**2 + 4 - 1 - math.log(4))
    assert float(kl) == pytest.approx(nats * math.prod(model.latent_shape) / (16 * 24))
