"""Training learns, goes on exactly where it stopped, and survives frames that are no numbers."""

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from data_collection.dataset import RGBDDataset
from envs.errors import UsageError
from worldmodel.clips import Clips, ClipSource
from worldmodel.held_out import ValidationSet
from worldmodel.journal import Journal
from worldmodel.motion_scores import flow_statistics
from worldmodel.options import PRESETS, Schedule
from worldmodel.rollout import unroll
from worldmodel.trainer import MAX_BAD_STEPS, Trainer


@pytest.fixture
def make_trainer(make_model, source, tmp_path):
    def make(out="run", kind=None, **options):
        chosen = replace(PRESETS["tiny"], data=Path("squares"), out=tmp_path / out, **{"batch": 2, **options})
        chosen.out.mkdir(exist_ok=True)
        model = make_model(moving=False, **(kind or {}))
        return Trainer(model, chosen, source, ValidationSet(source, 2, 4, 2, 2), {"seed": chosen.seed})

    return make


def checkpoint(out, step):
    return load_file(out / "checkpoints" / f"step-{step:08d}" / "training.safetensors")


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_run_that_was_stopped_ends_with_the_same_bits(make_trainer, precision, monkeypatch):
    options = {"steps": 6, "save_every": 3, "validate_every": 3, "precision": precision}
    straight = make_trainer("straight", **options)
    straight.run()
    stopped, update = make_trainer("stopped", **options), Trainer.update

    def interrupted(self, clips):
        if self.step == 4:
            raise KeyboardInterrupt
        return update(self, clips)

    closed, close = [], Journal.close
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Trainer, "update", interrupted)
        patch.setattr(Journal, "close", lambda self: (closed.append(self), close(self)))
        stopped.run()
    assert len(closed) == 1
    torch.manual_seed(123)  # nothing may hang on the state of the global generator
    resumed = make_trainer("stopped", seed=0, **options)
    resumed.run()
    ours, theirs = checkpoint(straight.options.out, 6), checkpoint(resumed.options.out, 6)
    assert ours.keys() == theirs.keys() and any(name.startswith("adam.exp_avg_sq.inference") for name in ours)
    for name, value in ours.items():
        assert torch.equal(value, theirs[name]), name
    assert resumed.step == 6 and resumed.best == straight.best
    before = checkpoint(straight.options.out, 3)
    assert not torch.equal(before["model.transforms.last.weight"], ours["model.transforms.last.weight"])


def test_a_run_that_goes_on_keeps_all_that_was_told_up_to_there(tmp_path):
    for start, steps in ((0, (1, 2, 3, 4)), (3, (4, 5))):  # the first was killed after its checkpoint of step 3
        journal = Journal(tmp_path, start)
        for step in steps:
            journal.write("validation", step, {"score": 10.0 * start + step})
        journal.close()
        time.sleep(1.1)  # TensorBoard reads files in the order of their names, which tell the second
    expected = [(1, 1.0), (2, 2.0), (3, 3.0), (4, 34.0), (5, 35.0)]
    lines = [json.loads(line) for line in journal.path.read_text().splitlines()]
    assert [(line["step"], line["score"]) for line in lines] == expected
    board = EventAccumulator(str(tmp_path / "tensorboard"))
    board.Reload()
    assert [(event.step, event.value) for event in board.Scalars("validation/score")] == expected


def test_it_learns_a_clip_by_heart_and_how_the_square_moves(make_trainer, tiny_dataset):
    """Sixty steps on one clip; the true flow is never shown to it."""
    source = ClipSource(RGBDDataset(tiny_dataset), 5)
    starts = source.starts(3)
    way = np.abs(source.actions_at(starts, 3)[..., :2]).sum((1, 2))
    chosen = starts[way.argmax()][None]
    clips, truth = source.at(chosen, 3), source.truth_at(chosen, 3)
    schedule = Schedule(clip_lengths=((1.0, 3),), truth_until=1e6)  # true frames only
    trainer = make_trainer(kind={"latents": "none"}, steps=60, schedule=schedule, learning_rate=4e-3)

    @torch.no_grad()
    def errors():
        rollout = unroll(trainer.model.eval(), clips, 2, truth=1.0)
        rgb = (rollout.stack("rgb") - clips.rgb[:, 1:]).abs().mean()
        depth = (rollout.stack("depth") - clips.depth[:, 1:]).abs().mean()
        flow = flow_statistics(rollout.stack("scene_flow"), truth.scene_flow, truth.hand)
        return float(rgb), float(depth), float(flow["moving_error"] / flow["moving_length"])

    before = errors()
    for _ in range(trainer.options.steps):
        trainer.model.train()
        trainer.update(clips)
        trainer.step += 1
    after = errors()
    assert before[2] == pytest.approx(1, abs=0.05)
    assert after[0] < 0.6 * before[0] and after[1] < 0.8 * before[1] and after[2] < 0.7


def test_the_schedules_follow_the_fraction_of_the_run(make_trainer):
    trainer = make_trainer(steps=1000)

    def rate(step):
        trainer.step = step
        return trainer.learning_rate

    rates = [rate(step) for step in range(0, 1000, 10)]
    assert rates[0] < 0.1 * max(rates) and max(rates) == pytest.approx(1e-3, rel=0.01)
    assert rates.index(max(rates)) <= 3 and rates[-1] == pytest.approx(5e-5, rel=0.1)
    assert Schedule().clip_length(0.0) == 4 and Schedule().clip_length(0.5) == 8 and Schedule().clip_length(1.0) == 12


def test_latents_come_from_the_prior_first_and_then_from_the_clip(make_trainer, source):
    trainer = make_trainer(steps=100, schedule=Schedule(kl_ramp=(0.5, 0.6)))
    clips = source.at(source.spread(2, 4), 4)

    def terms():
        return {name: float(value) for name, value in trainer.differentiate(trainer.inputs(clips)).items()}

    assert "kl" not in terms() and terms() == terms()  # the noise comes from seed and step
    trainer.step = 30
    without_weight = terms()
    assert without_weight["kl"] > 0
    assert trainer.inference.heads.weight.grad.abs().max() > 0  # though the KL's weight is still 0
    trainer.step = 70
    assert terms()["kl"] == pytest.approx(without_weight["kl"], rel=1e-4)
    assert terms()["loss"] != without_weight["loss"]


def test_without_jitter_clips_are_as_they_were_recorded(make_trainer):
    recorded, changed = (make_trainer(colour_jitter=strength).next_clips() for strength in (0.0, 0.3))
    assert torch.equal(recorded.depth, changed.depth) and not torch.equal(recorded.rgb, changed.rgb)
    torch.testing.assert_close(recorded.rgb * 255, (recorded.rgb * 255).round())


def spoiled(clips):
    rgb = clips.rgb.clone()
    rgb[0, -1, 0, 0, 0] = torch.nan
    return Clips(rgb, clips.depth, clips.actions)


def test_a_loss_that_is_no_number_is_skipped_and_ends_the_run_in_the_long_run(make_trainer, source):
    trainer = make_trainer()
    clips = source.at(source.spread(2, 4), 4)
    weights = {name: value.clone() for name, value in trainer.model.state_dict().items()}

    def untouched():
        return all(torch.equal(value, weights[name]) for name, value in trainer.model.state_dict().items())

    for _ in range(MAX_BAD_STEPS - 1):
        trainer.update(spoiled(clips))
    assert untouched()
    trainer.update(clips)  # a good one in between: counting starts anew
    assert not untouched()
    for _ in range(MAX_BAD_STEPS - 1):
        trainer.update(spoiled(clips))
    with pytest.raises(UsageError, match=r"in a row: loss \(terms: loss, rgb\); look for bad frames"):
        trainer.update(spoiled(clips))
    assert all(value.isfinite().all() for value in trainer.model.state_dict().values())


def test_gradients_that_are_no_numbers_end_the_run_too(make_trainer, source, monkeypatch):
    trainer = make_trainer()
    clips = source.at(source.spread(2, 4), 4)
    trainer.parameters[0].register_hook(lambda gradient: gradient * torch.nan)
    weights = [parameter.clone() for parameter in trainer.parameters]
    for _ in range(MAX_BAD_STEPS - 1):
        trainer.update(clips)
    with pytest.raises(UsageError, match="10 steps in a row: gradient; look for bad frames"):
        trainer.update(clips)
    assert all(torch.equal(now, before) for now, before in zip(trainer.parameters, weights, strict=True))


def test_other_data_is_no_way_to_go_on(make_trainer):
    first = make_trainer(steps=2, save_every=1)
    first.origin["data"] = {"train": "a1", "validation": "b1"}
    first.run()
    same, other = make_trainer(steps=2), make_trainer(steps=2)
    same.origin["data"] = dict(first.origin["data"])
    same.run()
    other.origin["data"] = {"train": "a2", "validation": "b1"}
    with pytest.raises(UsageError, match=r"the data has changed since step 2 of .*run \(train\); restore it, or give"):
        other.run()


def test_frames_full_of_nothing_do_no_harm(make_trainer, source):
    trainer = make_trainer()
    clips = source.at(source.spread(2, 4), 4)
    trainer.update(Clips(clips.rgb * torch.nan, clips.depth * torch.inf, clips.actions * torch.nan))
    assert all(value.isfinite().all() for value in trainer.model.state_dict().values())
    assert trainer.bad_steps == 1
