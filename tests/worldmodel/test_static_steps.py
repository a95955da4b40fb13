"""A training step takes shapes and turns that its options fix, and makes nothing but where its inputs are."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from worldmodel.held_out import ValidationSet
from worldmodel.losses import LossWeights
from worldmodel.models import make_model as make_kind
from worldmodel.options import PRESETS
from worldmodel.trainer import Trainer

OF_PICTURES = {"loss", "rgb", "kl"}
OF_CLOUDS = OF_PICTURES | {"depth", "knn", "scene_smoothness", "optical_smoothness"}


@pytest.mark.parametrize(
    ("kind", "config", "weights", "precision", "terms"),
    [
        ("t3vip", {}, {}, "float32", OF_CLOUDS),
        ("t3vip", {"latents": "clip", "splat": "softmax"}, {"alignment": "chamfer", "power": 2}, "bfloat16", OF_CLOUDS),
        ("sv2p", {"kernel_size": 3}, {}, "float32", OF_PICTURES),
    ],
)
def test_no_step_needs_to_know_a_number(make_model, source, tmp_path, kind, config, weights, precision, terms):
    """It runs there and back on tensors that have shapes but no numbers, none of them made where nobody said."""
    like = make_model()
    model = make_kind(kind, replace(like.config, **config), like.context)
    options = replace(PRESETS["tiny"], data=Path("squares"), out=tmp_path, losses=LossWeights(**weights))
    options = replace(options, batch=2, precision=precision)
    trainer = Trainer(model, options, source, ValidationSet(source, 2, 4, 2, 2), {})
    trainer.step = options.steps // 2
    inputs = trainer.inputs(source.at(source.spread(2, 4), 4))
    assert inputs.inferred and inputs.taught
    with FakeTensorMode(allow_non_fake_inputs=True), torch.device("meta"):
        assert trainer.differentiate(inputs).keys() == terms
    assert all(parameter.grad is not None for parameter in trainer.parameters)
