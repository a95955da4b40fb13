"""A step that is recorded and replayed trains as one that is launched. What needs a GPU runs where there is one."""

import logging
import weakref
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from worldmodel.devices import prepare_devices
from worldmodel.held_out import ValidationSet
from worldmodel.inference import inference_network
from worldmodel.objective import StepInputs, objective
from worldmodel.options import PRESETS, Schedule
from worldmodel.recording import Recorder, Recording, _kind
from worldmodel.trainer import Trainer

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU that PyTorch can use is here")
PHASES = Schedule(warmup=0.1, truth_until=0.5, posterior_from=0.3, kl_ramp=(0.3, 0.6), clip_lengths=((0.6, 4), (1, 5)))
STEPS = 12


@dataclass(frozen=True)
class Inputs:
    x: Tensor
    other: Tensor | None
    squared: bool


def test_a_kind_is_shapes_types_and_plain_values():
    some = Inputs(torch.zeros(3), None, True)
    assert _kind(some) == _kind(Inputs(torch.ones(3), None, True))
    others = (
        Inputs(torch.zeros(4), None, True),
        Inputs(torch.zeros(3).double(), None, True),
        replace(some, other=some.x),
    )
    assert len({_kind(some), _kind(replace(some, squared=False)), *map(_kind, others)}) == 5


@pytest.mark.parametrize(
    ("kind", "message", "reason"),
    [
        (RuntimeError, "not permitted\nwhen capturing", "not permitted"),
        (torch.OutOfMemoryError, "", "OutOfMemoryError"),
    ],
)
def test_what_cannot_be_recorded_runs_as_it_is(caplog, kind, message, reason):
    """With a failure that is made up: a warning, once, the same gradients, and nothing of the failure left by then."""
    weight = nn.Parameter(torch.tensor([1.0, 2.0, 3.0]))
    held = []

    def differentiate(inputs):
        assert held[0]() is None
        weight.grad = None
        loss = (weight * inputs.x).sum()
        loss.backward()
        return {"loss": loss.detach()}

    def record(inputs):
        large = torch.zeros(3)
        held.append(weakref.ref(large))
        raise kind(message)

    recorder = Recorder(differentiate, [weight])
    recorder._record = record
    with caplog.at_level(logging.WARNING):
        for factor in (1.0, 2.0):
            told = recorder(Inputs(torch.full((3,), factor), None, True))
            assert told["loss"] == 6 * factor and torch.equal(weight.grad, torch.full((3,), factor))
    said = [record.message for record in caplog.records]
    assert said == [f"steps run without CUDA graphs, which is slower: recording failed ({reason})"]


def test_a_kind_is_recorded_once_and_fed_each_time():
    """With a recording that stands in for a GPU's: the inputs it owns are overwritten, gradients are handed on."""
    weight = nn.Parameter(torch.ones(2))
    recorder = Recorder(lambda inputs: {}, [weight])
    made = []

    class Graph:
        def __init__(self, owned):
            self.owned, self.outputs, self.gradient = owned, {"loss": torch.zeros(())}, torch.zeros(2)

        def replay(self):
            self.outputs["loss"].copy_(self.owned.x.sum())
            self.gradient.copy_(self.owned.x)

    def record(inputs):
        owned = replace(inputs, x=inputs.x.clone())
        graph = Graph(owned)
        made.append(graph)
        return Recording(graph, owned, graph.outputs, [graph.gradient])

    recorder._record = record
    for squared in (True, False, True):
        for x in (torch.tensor([1.0, 2.0]), torch.tensor([3.0, 4.0])):
            told = recorder(Inputs(x, None, squared))
            assert told["loss"] == x.sum() and torch.equal(weight.grad, x)
    assert len(made) == 2


@pytest.fixture
def options():
    return replace(PRESETS["tiny"], data=Path("squares"), out=Path("run"), batch=2, schedule=PHASES)


def inputs_of(model, clips):
    """Half way through a run: latents inferred, some inputs true."""
    draw = torch.Generator().manual_seed(0)
    noise = torch.randn((2, 1 if model.config.latents == "clip" else 3, *model.latent_shape), generator=draw)
    return StepInputs(
        clips.rgb,
        clips.depth,
        clips.actions,
        noise if model.latent_channels else None,
        torch.tensor([[0.1, 0.2, 0.3], [0.9, 0.8, 0.7]]),
        torch.tensor(0.5),
        torch.tensor(0.1),
        inferred=model.latent_channels > 0,
        taught=True,
    )


@pytest.mark.parametrize("latents", ["step", "clip"])
def test_the_objective_is_made_of_its_inputs_alone(make_model, source, options, latents):
    """What is replayed sees no clock: the same inputs give the same objective, and each of them counts."""
    model = make_model(latents=latents)
    inference = inference_network(model)
    inputs = inputs_of(model, source.at(source.spread(2, 4), 4))

    @torch.no_grad()
    def total(**changes):
        return float(objective(model, inference, replace(inputs, **changes), options)[0])

    assert total() == total()
    for changes in (
        {"rgb": 0.5 * inputs.rgb},
        {"depth": 0.9 * inputs.depth},
        {"actions": inputs.actions + 1},
        {"noise": inputs.noise + 1},
        {"coins": 1 - inputs.coins},
        {"truth": torch.tensor(0.0)},
        {"kl_weight": torch.tensor(0.2)},
        {"inferred": False},
        {"taught": False},
    ):
        assert total(**changes) != total(), changes
    assert total(taught=False) == pytest.approx(total(truth=torch.tensor(0.0)), rel=1e-6)


@torch.no_grad()
@pytest.mark.parametrize("config", [{"latents": "none"}, {"act_cond": False}])
def test_models_without_latents_or_actions_have_an_objective_too(make_model, source, options, config):
    model = make_model(**config)
    inputs = inputs_of(model, source.at(source.spread(2, 4), 4))
    inference = inference_network(model) if model.latent_channels else None
    total, terms = objective(model, inference, inputs, options)
    assert ("kl" in terms) == (inference is not None)
    other, _ = objective(model, inference, replace(inputs, actions=inputs.actions + 1), options)
    assert (total == other) == (not model.config.act_cond)


@pytest.fixture
def train(make_model, source, tmp_path):
    def train(name, device="cuda", **options):
        chosen = replace(
            PRESETS["tiny"], data=Path("squares"), out=tmp_path / name, batch=4, steps=STEPS, device=device
        )
        chosen = replace(chosen, schedule=PHASES, save_every=STEPS, validate_every=STEPS, **options)
        chosen.out.mkdir(exist_ok=True)
        model = make_model(moving=False).to(device).to(memory_format=torch.channels_last)
        trainer = Trainer(model, chosen, source, ValidationSet(source, 2, 4, 2, 2), {})
        losses, update = [], trainer.update

        def noted(clips):
            losses.append(update(clips)["loss"])
            return {"loss": losses[-1]}

        trainer.update = noted
        trainer.run()
        return trainer, losses

    return train


@needs_gpu
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_replayed_steps_train_as_launched_ones(train, precision):
    """Through all phases of a run: other clip lengths, latents inferred, no true frames left."""
    replayed, ours = train("replayed", precision=precision)
    launched, theirs = train("launched", precision=precision, cuda_graphs=False)
    assert len(replayed._compute._recordings) == 4 and not replayed._compute._failed
    assert launched._compute == launched.differentiate
    assert ours[0] == pytest.approx(theirs[0], rel=1e-3)
    assert ours == pytest.approx(theirs, rel=3e-2)


@needs_gpu
def test_a_gpu_trains_as_the_cpu(train):
    (_, ours), (_, theirs) = train("gpu", precision="float32"), train("cpu", device="cpu", precision="float32")
    assert ours[0] == pytest.approx(theirs[0], rel=1e-3)
    assert ours == pytest.approx(theirs, rel=3e-2)


@needs_gpu
@pytest.mark.parametrize("graphs", [True, False])
def test_deterministic_runs_have_the_same_bits(train, graphs):
    prepare_devices(deterministic=True)
    try:
        runs = [train(name, precision="bfloat16", cuda_graphs=graphs)[0].options.out for name in ("first", "second")]
    finally:
        torch.use_deterministic_algorithms(False)
        torch.backends.cudnn.deterministic = False
    first, second = (load_file(run / "checkpoints" / f"step-{STEPS:08d}" / "training.safetensors") for run in runs)
    assert all(torch.equal(first[name], second[name]) for name in first)
