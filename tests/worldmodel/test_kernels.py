"""The rivals: kernels that sum to 1 and are all used, masks that sum to 1, the first frame, and exact gradients."""

from dataclasses import replace

import pytest
import torch

from worldmodel import models
from worldmodel.advection import advect, convolve
from worldmodel.kernels import KernelPrediction

RIVALS = ("cdna", "sna", "sv2p")


@pytest.fixture
def clips(source):
    return source.at(source.spread(3, 5), 5)


@pytest.fixture
def rival(make_model):
    """Makes a small model of a kind with fresh weights."""

    def make(kind, **config):
        like = make_model()
        torch.manual_seed(1)
        architecture = models.named_config(kind, replace(like.config, **config))[1]
        return models.make_model(kind, architecture, like.context).eval()

    return make


def moved_by_hand(picture, masks, kernels):
    """The definition, a loop over kernels and their entries."""
    reach = kernels.shape[-1] // 2
    height, width = picture.shape[-2:]
    padded = torch.nn.functional.pad(picture, (reach,) * 4, mode="replicate")
    out = torch.zeros_like(picture)
    for k in range(kernels.shape[1]):
        for i in range(kernels.shape[-2]):
            for j in range(kernels.shape[-1]):
                view = padded[:, :, i : i + height, j : j + width]
                out = out + masks[:, k : k + 1] * kernels[:, k, i, j].view(-1, 1, 1, 1) * view
    return out


@pytest.mark.parametrize("size", [3, 5])
def test_advection_and_its_gradients_follow_the_definition(size):
    torch.manual_seed(0)
    inputs = [torch.rand(2, 3, 8, 12), torch.rand(2, 4, 8, 12), torch.rand(2, 4, size, size)]
    inputs = [x.requires_grad_() for x in inputs]
    weight = torch.randn(2, 3, 8, 12)
    results = []
    for function in (moved_by_hand, advect):
        out = function(*inputs)
        results.append((out, *torch.autograd.grad((out * weight).sum(), inputs)))
    for ours, expected in zip(results[1], results[0], strict=True):
        torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-5)
    with torch.no_grad():  # without gradients another way is taken
        torch.testing.assert_close(advect(*inputs), results[0][0], rtol=1e-4, atol=1e-5)


def test_a_kernel_fetches_the_pixel_that_it_points_to():
    picture = torch.zeros(1, 1, 8, 8)
    picture[0, 0, 5, 2] = 1
    kernels = torch.zeros(1, 1, 3, 3)
    kernels[0, 0, 2, 0] = 1  # one row down, one column to the left
    assert convolve(picture, kernels)[0, 0, 0, 4, 3] == 1


@pytest.mark.parametrize("kind", RIVALS)
@torch.no_grad()
def test_kernels_and_masks_sum_to_one_and_every_kernel_counts(kind, clips, rival):
    model = rival(kind)
    rgb, depth, actions = clips.rgb[:, 0], clips.depth[:, 0], clips.actions[:, 0]
    prediction, _ = model.predict(rgb, depth, actions, None, model.blank_memory(rgb))
    assert isinstance(prediction, KernelPrediction) and prediction.depth is None
    assert prediction.masks.shape[1] == model.config.masks + (2 if kind == "cdna" else 3)
    assert prediction.kernels.shape[1:] == (model.config.masks, 15, 15)
    torch.testing.assert_close(prediction.masks.sum(1), torch.ones_like(rgb[:, 0]))
    torch.testing.assert_close(prediction.kernels.sum((-1, -2)), torch.ones(len(rgb), model.config.masks))
    assert prediction.kernels.min() > 0 and prediction.rgb.min() >= 0 and prediction.rgb.max() <= 1 + 1e-6
    for k in range(model.config.masks):  # what one kernel says is seen in the picture
        changed = prediction.kernels.clone()
        changed[:, k] = 0
        moving = prediction.masks[:, 1 : 1 + model.config.masks]
        assert not torch.allclose(advect(rgb, moving, changed), advect(rgb, moving, prediction.kernels), atol=1e-4)


@pytest.mark.parametrize(("size", "least", "most"), [(5, 0.2, 0.5), (9, 0.08, 0.2), (15, 0.03, 0.1)])
@torch.no_grad()
def test_untrained_kernels_take_most_from_the_pixel_itself_and_are_not_alike(size, least, most, clips, rival):
    model, rgb = rival("sna", kernel_size=size, masks=10), clips.rgb[:, 0]
    prediction, _ = model.predict(rgb, clips.depth[:, 0], clips.actions[:, 0], None, model.blank_memory(rgb))
    assert least < prediction.kernels[..., size // 2, size // 2].mean() < most
    assert prediction.kernels.std(dim=1).mean() > 0.3 / size**2


@pytest.mark.parametrize("kind", RIVALS)
@torch.no_grad()
def test_only_sna_and_sv2p_copy_from_the_first_frame(kind, clips, rival):
    model = rival(kind)
    depth, actions = clips.depth[:, 0], clips.actions[:, 0]
    results = []
    for first in (clips.rgb[:, 0], 1 - clips.rgb[:, 0]):
        memory = model.blank_memory(first)
        results.append(model.predict(clips.rgb[:, 1], depth, actions, None, memory)[0].rgb)
    assert torch.equal(*results) == (kind == "cdna")


@torch.no_grad()
def test_a_rival_sees_no_depth(clips, rival):
    model = rival("sv2p")
    rgb, actions = clips.rgb[:, 0], clips.actions[:, 0]
    predicted = [
        model.predict(rgb, depth, actions, None, model.blank_memory(rgb))[0].rgb
        for depth in (clips.depth[:, 0], torch.full_like(clips.depth[:, 0], 5.0))
    ]
    assert torch.equal(*predicted)


@torch.no_grad()
def test_latents_are_svtwops_alone_and_many_futures_share_one_past(clips, rival):
    assert [models.KINDS[kind].kind for kind in RIVALS] == list(RIVALS)
    assert rival("cdna").latent_shape[0] == rival("sna").latent_shape[0] == 0
    model = rival("sv2p")
    state = model.observe(clips.rgb[:1, :2], clips.depth[:1, :2], clips.actions[:1, :1])
    latents = torch.randn((3, *model.latent_shape), generator=torch.Generator().manual_seed(0))
    actions = clips.actions[:1, 1].expand(3, -1)
    _, together = model.step(state, actions, latents)
    _, alone = model.step(state, actions[:1], latents[1:2])
    torch.testing.assert_close(together.rgb[1:2], alone.rgb, rtol=1e-4, atol=1e-5)
    assert not torch.allclose(together.rgb[0], together.rgb[1], atol=1e-5)
    _, broadcast = model.step(state, actions[:1], latents)  # one action, many latents
    torch.testing.assert_close(broadcast.rgb, together.rgb, rtol=1e-4, atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("kind", RIVALS)
def test_one_state_has_as_many_futures_as_it_is_given_actions(clips, rival, kind):
    model = rival(kind)
    state = model.observe(clips.rgb[:1, :2], clips.depth[:1, :2], clips.actions[:1, :1])
    candidates = torch.randn((3, 2, 7), generator=torch.Generator().manual_seed(0))
    many, alone = state, [state] * 3
    for t in range(2):
        many, together = model.step(many, candidates[:, t])
        assert many.rgb.shape[0] == many.depth.shape[0] == 3
        for n in range(3):
            alone[n], prediction = model.step(alone[n], candidates[n : n + 1, t])
            torch.testing.assert_close(together.rgb[n : n + 1], prediction.rgb, rtol=1e-4, atol=1e-4)
    assert not torch.allclose(together.rgb[0], together.rgb[1], atol=1e-5)


@torch.no_grad()
def test_kernels_of_the_original_size_are_an_option(rival):
    assert rival("cdna", kernel_size=5).kernel_head.size == 5
