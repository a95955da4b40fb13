"""Weights that are cast once for all frames give the numbers of weights that autocast casts at every frame."""

import gc
import weakref
from contextlib import nullcontext

import pytest
import torch
from torch import nn

from worldmodel import models
from worldmodel.lending import WeightLoan
from worldmodel.rollout import unroll


@pytest.fixture
def clips(source):
    return source.at(source.spread(2, 4), 4)


def gradients(model, clips, lending=True):
    """Of a rollout in bfloat16 on its own frames, by name; where it does not lend, autocast casts."""
    model.precision = torch.bfloat16
    model.zero_grad(set_to_none=True)
    if not lending:
        model.lending = nullcontext
    rollout = unroll(model, clips, 2)
    (rollout.stack("rgb") - clips.rgb[:, 1:]).square().mean().backward()
    return {name: p.grad for name, p in model.named_parameters() if p.grad is not None}


@pytest.mark.parametrize("name", ["t3vip", "sv2p"])
def test_gradients_have_the_same_bits(make_model, clips, name):
    kind, config = models.named_config(name, make_model().config)

    def model():
        torch.manual_seed(0)
        return models.make_model(kind, config, make_model().context).to(memory_format=torch.channels_last)

    ours, theirs = gradients(model(), clips), gradients(model(), clips, lending=False)
    assert ours.keys() == theirs.keys() and len(ours) > 50
    for weight, gradient in theirs.items():
        assert gradient.dtype == ours[weight].dtype == torch.float32
        assert torch.equal(ours[weight], gradient), weight
    assert any(gradient.abs().max() > 0 for gradient in theirs.values())


def test_layers_work_with_the_cast_weights_until_the_frame_is_done(make_model):
    model = make_model()
    weight = model.encoder.conv0.weight
    loan = WeightLoan(model, torch.bfloat16)
    account = loan.open()
    with pytest.raises(ZeroDivisionError), loan.frame(account):
        assert model.encoder.conv0.weight.dtype == model.mask_decoder.up1.bias.dtype == torch.bfloat16
        assert model.transforms.last.weight.dtype == model.encoder.norm0.weight.dtype == torch.float32
        raise ZeroDivisionError
    assert model.encoder.conv0.weight is weight and isinstance(weight, nn.Parameter)


def test_the_gradient_of_a_weight_that_no_frame_used_is_zero(make_model):
    model = make_model()
    loan = WeightLoan(model, torch.bfloat16)
    account = loan.open()
    with loan.frame(account):
        model.encoder.conv0.weight.float().sum().backward()
    assert torch.equal(model.encoder.conv0.weight.grad, torch.ones_like(model.encoder.conv0.weight))
    assert not model.encoder.conv1.weight.grad.any()


def test_in_float32_nothing_is_lent(make_model):
    model = make_model()
    weight = model.encoder.conv0.weight
    with model.lending(), model._borrowing():
        assert model.encoder.conv0.weight is weight


def test_an_unroll_that_fails_lends_no_more(make_model):
    model = make_model()
    model.precision = torch.bfloat16
    with pytest.raises(ZeroDivisionError), model.lending():
        raise ZeroDivisionError
    weight = model.encoder.conv0.weight
    with model._borrowing():
        assert model.encoder.conv0.weight is weight


@torch.inference_mode()
def test_predictions_are_the_same(make_model, clips):
    lent, cast = make_model(), make_model()
    lent.precision = cast.precision = torch.bfloat16
    cast.lending = nullcontext
    assert torch.equal(unroll(lent, clips, 2).stack("rgb"), unroll(cast, clips, 2).stack("rgb"))


def test_a_step_leaves_nothing_behind(make_model, clips, monkeypatch):
    loans = []
    open_account = WeightLoan.open

    def noted(self):
        loans.append(weakref.ref(self))
        return open_account(self)

    monkeypatch.setattr(WeightLoan, "open", noted)
    gradients(make_model(), clips)
    gc.collect()
    assert len(loans) == 1 and loans[0]() is None
