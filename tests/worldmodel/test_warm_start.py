"""`train-worldmodel --start-from`: training goes on from another model's weights, and never ends with a worse model."""

import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from envs.errors import UsageError
from worldmodel.budget import Cost
from worldmodel.checkpoint import content_hashes, data_seen, load_model, load_origin
from worldmodel.train import main, parse_options
from worldmodel.tuning.options import TuneOptions

SHORT = ("--preset", "tiny", "--steps", "2", "--batch", "2", "--validate-every", "2")


def train(data, out, *arguments):
    main(parse_options([*SHORT, "--data", str(data), "--out", str(out), *map(str, arguments)]))
    return out


def weights(run, file="model.safetensors"):
    return load_file(run / "model" / file)


def validations(run):
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return {line["step"]: line for line in lines if line["kind"] == "validation"}


@pytest.fixture(scope="module")
def first(tiny_dataset, tmp_path_factory):
    return train(tiny_dataset, tmp_path_factory.mktemp("runs") / "first", "--frame-gap", 2)


@pytest.fixture(scope="module")
def other_data(write_dataset, tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("other") / "data", seed=1)


def test_a_model_that_training_makes_worse_stays_as_it_was(first, other_data, tmp_path):
    run = train(other_data, tmp_path / "run", "--start-from", first, "--learning-rate", 3, "--seed", 5)
    for file in ("model.safetensors", "inference.safetensors"):
        before, after = weights(first, file), weights(run, file)
        assert before.keys() == after.keys() and all(torch.equal(before[name], after[name]) for name in before)
    origin = json.loads((run / "model" / "config.json").read_text())["origin"]
    assert origin["step"] == 0
    seen = load_origin(first)["data"]
    assert origin["start"] == {"name": str(first), "step": 2, "data": seen, "files": content_hashes(first)}
    assert (
        data_seen(run, "train") == [origin["data"]["train"], seen["train"]] and len(set(data_seen(run, "train"))) == 2
    )
    assert sorted(validations(run)) == [0, 2]
    assert np.mean(validations(run)[2]["score"]) < np.mean(validations(run)[0]["score"])


def test_training_goes_on_from_there(first, tiny_dataset, tmp_path):
    run = train(tiny_dataset, tmp_path / "run", "--start-from", first, "--learning-rate", 1e-9)
    assert validations(run)[0]["score"] == validations(first)[2]["score"]  # the same data, the same held-out clips
    trained = load_file(run / "checkpoints" / "step-00000002" / "training.safetensors")
    for name, value in weights(first).items():
        torch.testing.assert_close(trained[f"model.{name}"], value, rtol=0, atol=1e-6)


def test_what_weights_fix_comes_with_them_and_all_else_from_the_preset(first, tiny_dataset):
    to = ["--data", str(tiny_dataset), "--out", "x"]
    options = parse_options([*to, "--preset", "paper", "--start-from", str(first)])
    assert (options.architecture.width, options.architecture.masks, options.frame_gap) == (0.25, 4, 2)
    assert (options.action_column, options.steps) == ("action", 200_000)
    rival = parse_options([*to, "--start-from", "sv2p"])
    assert (rival.model, rival.losses.power) == ("sv2p", 2)


def test_the_same_motion_is_the_same_number_to_the_network(first, write_dataset, tmp_path):
    """Data in half the unit, in which everything moves faster besides."""
    scale = [0.01, 0.01, 0.01, 0.05, 0.05, 0.05, 1.0]
    run = train(write_dataset(tmp_path / "data", seed=2, action_scale=scale), tmp_path / "run", "--start-from", first)
    before, after = load_model(first), load_model(run)
    motion = torch.linspace(-0.3, 0.5, 7)  # metres and radians
    numbers = [
        (motion / torch.tensor(model.context.action_scale) - model.action_mean) / model.action_std
        for model in (before, after)
    ]
    torch.testing.assert_close(*numbers)
    assert after.context.action_std[0] == pytest.approx(2 * before.context.action_std[0])


def test_a_run_goes_on_with_the_same_start_only(first, tiny_dataset, tmp_path, monkeypatch):
    run = train(tiny_dataset, tmp_path / "run", "--start-from", first)
    monkeypatch.chdir(first.parent)
    train(tiny_dataset, run, "--start-from", "first")  # by another name
    assert sorted(validations(run)) == [0, 2]
    with pytest.raises(UsageError, match=r"start_from = .*first, not None"):
        train(tiny_dataset, run, "--frame-gap", 2)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--architecture.width", 0.5), "has width = 0.25, not 0.5"),
        (("--model", "cdna"), "has model = t3vip, not cdna"),
        (("--model", "t3vip-d"), "latents = step, not none"),
    ],
)
def test_another_architecture_cannot_start_from_it(first, tiny_dataset, tmp_path, arguments, words):
    with pytest.raises(UsageError, match=words):
        train(tiny_dataset, tmp_path / "run", "--start-from", first, *arguments)


def test_data_of_another_kind_is_refused(first, write_dataset, camera_of, tmp_path):
    with pytest.raises(UsageError, match="no model at 'nowhere'"):
        train(tmp_path, tmp_path / "run", "--start-from", "nowhere")
    large = write_dataset(tmp_path / "large", camera=camera_of(32, 24), seed=3)
    with pytest.raises(UsageError, match=r"picture height and width = .16, 24., not .24, 32."):
        train(large, tmp_path / "run", "--start-from", first)
    absolute = write_dataset(tmp_path / "absolute", seed=4, action_aggregation=["last"] * 7)
    with pytest.raises(UsageError, match="actions add up by"):
        train(absolute, tmp_path / "run", "--start-from", first)
    unknown = write_dataset(tmp_path / "unknown", seed=5, action_scale=[0.0] + [0.02] * 6)
    with pytest.raises(UsageError, match="a unit of 0"):
        train(unknown, tmp_path / "run", "--start-from", first)


def test_it_is_not_judged_by_what_it_was_trained_on(tiny_dataset, other_data, tmp_path):
    first = train(tiny_dataset, tmp_path / "first", "--validation", other_data)
    second = train(other_data, tmp_path / "second", "--start-from", first)
    for start in (first, second):
        with pytest.raises(UsageError, match="was trained on the validation set"):
            train(other_data, tmp_path / "run", "--validation", tiny_dataset, "--start-from", start)


def test_a_model_that_sees_no_actions_takes_those_of_any_data(tiny_dataset, write_dataset, tmp_path):
    blind = train(tiny_dataset, tmp_path / "blind", "--architecture.no-act-cond")
    other = write_dataset(tmp_path / "absolute", seed=4, action_aggregation=["last"] * 7)
    assert load_model(train(other, tmp_path / "run", "--start-from", blind)).context.action_aggregation[0] == "last"


def test_the_first_validation_takes_its_share_of_the_minutes(first, tiny_dataset):
    new, adapted = (
        Cost(1.0, 10.0, 0.0).steps_in(1000.0, parse_options(["--data", str(tiny_dataset), "--out", "x", *further]))
        for further in ([], ["--start-from", str(first)])
    )
    rate = 1 + 10 / 400  # a validation every 400 steps
    assert (new, adapted) == (int(990 / rate), int(980 / rate))


def test_trials_of_a_search_start_from_new_weights(first, tiny_dataset, tmp_path):
    (tmp_path / "config.json").write_text(json.dumps({"start_from": str(first)}))
    options = TuneOptions(data=tiny_dataset, out=tmp_path / "out", config=tmp_path / "config.json")
    with pytest.raises(UsageError, match="has start_from; take it out"):
        options.training  # noqa: B018
