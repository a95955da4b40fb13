"""What the model promises: copying before it has learned, masks that move rigidly, memory, and no peeking."""

import numpy as np
import pytest
import torch

from envs.errors import UsageError
from worldmodel.clips import Clips
from worldmodel.inference import InferenceNetwork
from worldmodel.losses import LossWeights
from worldmodel.objective import reconstruction_terms
from worldmodel.rollout import unroll


@pytest.fixture(scope="module")
def clips(source):
    return source.at(source.spread(3, 5), 5)


@pytest.fixture
def model(make_model):
    return make_model()


def first_step(model, clips, **options):
    memory = model.blank_memory(clips.rgb[:, 0])
    return model.predict(clips.rgb[:, 0], clips.depth[:, 0], clips.actions[:, 0], None, memory, **options)


@torch.no_grad()
def test_an_untrained_model_copies(make_model, clips):
    """Transforms start as the identity up to a hundredth of a pixel."""
    prediction, _ = first_step(make_model(moving=False), clips)
    assert 0 < prediction.optical_flow.abs().max() < 0.02
    torch.testing.assert_close(prediction.rgb, clips.rgb[:, 0], atol=0.02, rtol=0)
    torch.testing.assert_close(prediction.depth, clips.depth[:, 0], atol=0.02, rtol=0)
    assert prediction.occlusion.sum() == 0


@torch.no_grad()
def test_first_shifts_follow_the_action_each_its_own_way(make_model, clips):
    model = make_model(moving=False, masks=10, first_shift=2.0)
    embedding = torch.zeros(1000, model.embedding_size)
    actions = torch.randn(1000, model.action_dim, generator=torch.Generator().manual_seed(0))
    rotation, shift = model.transforms(embedding, actions)
    pixel = (model.camera.near + model.camera.far) / 2 / model.camera.K[0, 0]
    assert 1.0 < shift.std() / pixel < 3.0  # 2 pixels, give or take the luck of few directions
    directions = torch.corrcoef(shift[:, :, 0].T)
    assert directions.fill_diagonal_(0).abs().max() < 0.999  # no two masks move alike
    torch.testing.assert_close(rotation, torch.eye(3).expand_as(rotation), atol=0.01, rtol=0)
    assert model.transforms(embedding[:1], 0 * actions[:1])[1].abs().max() < 0.02 * pixel


@torch.no_grad()
@pytest.mark.parametrize("unit", [5.0, 20.0])
def test_translations_are_learned_in_pixels(make_model, unit):
    model = make_model(moving=False, translation_unit=unit)
    torch.nn.init.zeros_(model.transforms.last.weight)
    torch.nn.init.ones_(model.transforms.last.bias)
    _, translation = model.transforms(torch.zeros(1, model.embedding_size), torch.zeros(1, model.action_dim))
    pixel = (model.camera.near + model.camera.far) / 2 / model.camera.K[0, 0]
    torch.testing.assert_close(translation, torch.full_like(translation, unit * pixel))


@torch.no_grad()
def test_without_transforms_any_model_copies(model, clips):
    rollout = unroll(model, clips, context=2, still=True)
    for t, prediction in enumerate(rollout.predictions):
        torch.testing.assert_close(prediction.rgb, clips.rgb[:, min(t, 1)], atol=1e-4, rtol=0)
        torch.testing.assert_close(prediction.depth, clips.depth[:, min(t, 1)], atol=1e-4, rtol=0)
        assert prediction.scene_flow.abs().max() < 1e-5 and prediction.occlusion.sum() == 0
    moving = first_step(model, clips)[0]
    assert (moving.rgb - clips.rgb[:, 0]).abs().max() > 0.1  # so it is the transforms that make a prediction


@torch.no_grad()
def test_the_background_mask_never_moves_and_the_others_do(model, clips):
    head = model.mask_decoder.head
    for mask in range(model.config.masks):
        head.bias.zero_()
        head.bias[mask] = 100.0
        prediction, _ = first_step(model, clips)
        length = prediction.scene_flow.norm(dim=1)
        assert length.max() < 1e-5 if mask == 0 else length.min() > 1e-3


@torch.no_grad()
def test_what_a_prediction_says_belongs_together(model, clips):
    prediction, _ = first_step(model, clips)
    B, H, W = 3, 16, 24
    assert prediction.rgb.shape == (B, 3, H, W) and prediction.depth.shape == (B, 1, H, W)
    assert prediction.masks.shape == (B, 4, H, W) and prediction.transform.shape == (B, 3, 4, H, W)
    torch.testing.assert_close(prediction.masks.sum(1), torch.ones(B, H, W))
    camera = model.camera
    points = camera.unproject(clips.depth[:, 0, 0].numpy())
    np.testing.assert_allclose(prediction.points.permute(0, 2, 3, 1), points, atol=1e-5)
    homogeneous = torch.cat((prediction.points, torch.ones(B, 1, H, W)), dim=1)
    moved = torch.einsum("bijhw,bjhw->bihw", prediction.transform, homogeneous)
    torch.testing.assert_close(prediction.moved_points, moved, atol=1e-5, rtol=1e-5)
    landed = camera.project(moved.permute(0, 2, 3, 1).numpy())
    np.testing.assert_allclose(prediction.optical_flow.permute(0, 2, 3, 1), landed - camera.pixels(), atol=1e-3)
    assert set(prediction.occlusion.unique().tolist()) == {0.0, 1.0}
    assert camera.near <= prediction.depth.min() and prediction.depth.max() <= camera.far
    assert prediction.rgb.min() >= 0 and prediction.rgb.max() <= 1 + 1e-5


@torch.no_grad()
def test_the_inpainter_paints_where_no_point_lands_and_nowhere_else(model, clips):
    before, _ = first_step(model, clips)
    model.inpainter.head.bias += 50.0
    after, _ = first_step(model, clips)
    hidden = before.occlusion.bool()
    assert 0 < hidden.float().mean() < 0.5
    torch.testing.assert_close(after.depth[hidden], torch.full((int(hidden.sum()),), model.camera.far))
    assert torch.equal(after.depth[~hidden], before.depth[~hidden])
    assert after.rgb[hidden.expand_as(after.rgb)].min() > 0.999


@torch.no_grad()
def test_without_paint_all_else_is_the_same(model, clips):
    painted, memory = first_step(model, clips)
    plain, plain_memory = first_step(model, clips, paint=False)
    shown = ~painted.occlusion.bool()
    assert torch.equal(plain.transform, painted.transform) and torch.equal(plain.occlusion, painted.occlusion)
    assert torch.equal(plain.depth[shown], painted.depth[shown])
    assert torch.equal(plain.depth[~shown], clips.depth[:, 0][~shown])  # what was there before
    plain_memory, memory = plain_memory.states, memory.states
    assert len(plain_memory) == len(memory)
    assert all(torch.equal(a, b) for a, b in zip(plain_memory[6], memory[6], strict=True))
    assert not plain_memory[8][0].any() and memory[8][0].any()


@torch.no_grad()
def test_memory_is_carried(model, clips):
    """With the same last frame, what was seen before it makes a difference; and it comes from every LSTM."""

    def last_step(first):
        rgb = torch.stack((first, clips.rgb[:, 1]), dim=1)
        state = model.observe(rgb, clips.depth[:, :2], clips.actions[:, :1])
        return state, model.step(state, clips.actions[:, 1])

    state, (after, prediction) = last_step(clips.rgb[:, 0])
    _, (_, other) = last_step(clips.rgb[:, 0].flip(1))
    assert (prediction.rgb - other.rgb).abs().max() > 1e-3
    assert len(state.memory.states) == 9 and len(after.memory.states) == 9
    for (hidden, cell), (later_hidden, later_cell) in zip(state.memory.states, after.memory.states, strict=True):
        assert hidden.abs().max() > 0 and cell.abs().max() > 0
        assert not torch.equal(hidden, later_hidden) and not torch.equal(cell, later_cell)


@torch.no_grad()
@pytest.mark.parametrize("context", [1, 2, 3])
def test_observe_and_step_are_the_rollout(model, clips, context):
    rollout = unroll(model, clips, context)
    state = model.observe(clips.rgb[:, :context], clips.depth[:, :context], clips.actions[:, : context - 1])
    for t in range(context - 1, 4):
        state, prediction = model.step(state, clips.actions[:, t])
        assert torch.equal(prediction.rgb, rollout.predictions[t].rgb)
        assert torch.equal(prediction.transform, rollout.predictions[t].transform)


@torch.no_grad()
def test_one_state_has_as_many_futures_as_it_is_given_actions(model, clips):
    state = model.observe(clips.rgb[:1, :2], clips.depth[:1, :2], clips.actions[:1, :1])
    candidates = torch.randn((4, 2, 7), generator=torch.Generator().manual_seed(0))
    many, together = state, []
    for t in range(2):
        many, prediction = model.step(many, candidates[:, t])
        together.append(prediction)
    assert many.rgb.shape == (4, 3, 16, 24) and many.depth.shape == (4, 1, 16, 24)
    for n in range(4):
        alone = state
        for t in range(2):
            alone, prediction = model.step(alone, candidates[n : n + 1, t])
            torch.testing.assert_close(prediction.transform[0], together[t].transform[n], atol=1e-3, rtol=1e-3)
            if t == 0:  # later a point on the edge of a pixel may be counted for its neighbour
                torch.testing.assert_close(prediction.rgb[0], together[t].rgb[n], atol=1e-3, rtol=1e-3)
    assert (together[0].rgb[0] - together[0].rgb[1]).abs().max() > 0.01  # actions make the difference


@torch.no_grad()
def test_predictions_look_at_nothing_but_the_context_and_the_actions(model, clips):
    generator = torch.Generator().manual_seed(0)

    def with_noise_from(frame):
        rgb, depth = clips.rgb.clone(), clips.depth.clone()
        rgb[:, frame:] = torch.rand(rgb[:, frame:].shape, generator=generator)
        depth[:, frame:] = 1 + 2 * torch.rand(depth[:, frame:].shape, generator=generator)
        return unroll(model, Clips(rgb, depth, clips.actions), context=2, truth=0.0)

    plain, blind = unroll(model, clips, context=2, truth=0.0), with_noise_from(2)
    for name in ("rgb", "depth", "masks", "transform", "scene_flow", "optical_flow", "occlusion"):
        assert torch.equal(plain.stack(name), blind.stack(name))
    assert not torch.allclose(plain.stack("rgb")[:, 1:], with_noise_from(1).stack("rgb")[:, 1:], atol=1e-2)
    shuffled = Clips(clips.rgb, clips.depth, clips.actions.roll(1, dims=2))
    assert not torch.allclose(plain.stack("transform"), unroll(model, shuffled, 2).stack("transform"), atol=1e-3)


@torch.no_grad()
def test_scheduled_sampling_takes_the_share_of_true_frames_that_it_is_told(model, clips):
    def share(truth):
        many = Clips(*(x[:1].expand(40, *x.shape[1:]) for x in (clips.rgb, clips.depth, clips.actions)))
        coins = torch.rand((40, many.actions.shape[1]), generator=torch.Generator().manual_seed(0))
        rollout = unroll(model, many, 2, truth=truth, coins=coins)
        true = (rollout.input_rgb == many.rgb[:, :-1]).flatten(2).all(2)
        assert true[:, :2].all()
        return float(true[:, 2:].float().mean())

    assert share(0.0) == 0.0 and share(1.0) == 1.0 and 0.2 < share(0.4) < 0.6


@torch.no_grad()
def test_a_coin_below_the_share_keeps_colour_and_depth_true(model, clips):
    coins = torch.tensor([[0.9, 0.1, 0.9, 0.9], [0.9, 0.9, 0.1, 0.9], [0.9, 0.1, 0.1, 0.9]])
    rollout = unroll(model, clips, 1, truth=0.5, coins=coins)
    true = (coins < 0.5)[:, :-1]
    depth = rollout.stack("points")[:, 1:, 2:]  # of the frames that predictions were made from
    for seen, recorded in ((rollout.input_rgb[:, 1:], clips.rgb), (depth, clips.depth)):
        assert torch.equal((seen == recorded[:, 1:-1]).flatten(2).all(2), true)


@torch.no_grad()
def test_actions_are_normalised_inside(make_model, clips):
    model = make_model()
    shifted, scaled = torch.linspace(-1, 1, 7), torch.linspace(0.5, 2, 7)
    expected, _ = first_step(model, clips)
    model.action_mean, model.action_std = shifted, scaled
    raw = Clips(clips.rgb, clips.depth, clips.actions * scaled + shifted)
    torch.testing.assert_close(first_step(model, raw)[0].transform, expected.transform, atol=1e-5, rtol=1e-5)


KINDS = {
    "t3vip": {},
    "t3vip-d": {"latents": "none"},
    "per clip": {"latents": "clip"},
    "action-free": {"act_cond": False},
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_runs_forward_and_backward(make_model, clips, kind):
    model = make_model(**KINDS[kind]).train()
    latents = None
    modules = {"model": model}
    if model.latent_channels:
        inference = InferenceNetwork(4, 1, 0.25, per_clip=model.config.latents == "clip")
        modules["inference"] = inference
        latents, _ = inference(torch.cat((clips.rgb, clips.depth), dim=2))
    rollout = unroll(model, clips, 2, latents)
    terms = reconstruction_terms(model, rollout, clips, LossWeights())
    assert set(terms) == {"rgb", "depth", "knn", "scene_smoothness", "optical_smoothness"}
    torch.stack(list(terms.values())).sum().backward()
    for module in modules.values():
        for name, parameter in module.named_parameters():
            assert parameter.grad is not None and parameter.grad.isfinite().all(), name
            assert parameter.grad.abs().max() > 0, name
    assert (model.transforms.last.in_features == 32 + 7) == (kind != "action-free")


@torch.no_grad()
def test_what_is_no_action_is_refused(model, clips):
    state = model.observe(clips.rgb[:, :1], clips.depth[:, :1])
    for action, words in ((None, "none was given"), (torch.zeros(2, 1), r"has shape \(2, 1\)")):
        with pytest.raises(UsageError, match=words):
            model.step(state, action)


def test_an_action_free_model_takes_actions_and_ignores_them(make_model, clips):
    model = make_model(act_cond=False)
    state = model.observe(clips.rgb[:, :2], clips.depth[:, :2])
    with_action, without = model.step(state, clips.actions[:, 1])[1], model.step(state, None)[1]
    assert torch.equal(with_action.rgb, without.rgb)


@torch.no_grad()
def test_latents_change_the_prediction_and_none_means_zeros(model, clips):
    state = model.observe(clips.rgb[:, :2], clips.depth[:, :2], clips.actions[:, :1])
    zeros = torch.zeros(3, *model.latent_shape)
    plain = model.step(state, clips.actions[:, 1])[1].transform
    assert torch.equal(plain, model.step(state, clips.actions[:, 1], zeros)[1].transform)
    assert not torch.allclose(plain, model.step(state, clips.actions[:, 1], zeros + 1)[1].transform, atol=1e-3)


@torch.no_grad()
def test_in_half_precision_only_the_network_is_coarse(make_model, clips):
    model = make_model()
    exact, _ = first_step(model, clips)
    model.precision = torch.bfloat16
    coarse, memory = first_step(model, clips)
    assert all(hidden.dtype == torch.bfloat16 and cell.dtype == torch.float32 for hidden, cell in memory.states)
    for name in ("rgb", "depth", "masks", "transform", "scene_flow", "optical_flow", "occlusion"):
        assert getattr(coarse, name).dtype == torch.float32
    assert not torch.equal(coarse.transform, exact.transform)
    torch.testing.assert_close(coarse.transform, exact.transform, atol=0.03, rtol=0)
    assert torch.equal(coarse.points, exact.points)


def test_sizes_that_do_not_halve_three_times_are_refused(make_model, camera_of):
    with pytest.raises(UsageError, match="20x24 is no multiple of 8"):
        make_model(camera_of(24, 20))


@torch.no_grad()
def test_a_tall_camera(make_model, camera_of):
    model = make_model(camera_of(8, 32))
    rgb, depth = torch.rand(2, 1, 3, 32, 8), torch.full((2, 1, 1, 32, 8), 2.0)
    _, prediction = model.step(model.observe(rgb, depth), torch.zeros(2, 7))
    assert prediction.rgb.shape == (2, 3, 32, 8) and prediction.transform.shape == (2, 3, 4, 32, 8)
    assert prediction.rgb.isfinite().all()


def test_frames_of_other_shapes_are_refused(model, clips):
    rgb, depth = clips.rgb[:, :2], clips.depth[:, :2]
    for pictures, depths in (
        (rgb, depth[:, :, 0]),
        (rgb[:, 0], depth),
        (rgb[:, :0], depth[:, :0]),
        (rgb, depth[:, :1]),
    ):
        with pytest.raises(UsageError, match=r"^rgb is \(.*; give \(B, T, 3, H, W\) and \(B, T, 1, H, W\)"):
            model.observe(pictures, depths, clips.actions[:, :1])
    for pictures in ((255 * rgb).to(torch.uint8), 255 * rgb):
        with pytest.raises(UsageError, match=r"^rgb is torch.* up to .*; give floats, colours in \[0, 1\] and metres"):
            model.observe(pictures, depth, clips.actions[:, :1])
    for actions in (clips.actions[:, :2], clips.actions[:, :0], clips.actions[:1, :1], clips.actions[:, 0]):
        with pytest.raises(UsageError, match=r"^actions are \(.* for 2 frames; give \(3, 1, A\).*aggregate_actions"):
            model.observe(rgb, depth, actions)
