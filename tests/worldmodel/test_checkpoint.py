"""What is saved comes back; what is unfinished is not there; what is damaged is named."""

import json
import shutil

import pytest
import torch

from envs.errors import UsageError
from worldmodel import checkpoint
from worldmodel.checkpoint import (
    CONFIG,
    INFERENCE,
    STATE,
    TRAINING,
    WEIGHTS,
    find_model,
    load_inference,
    load_model,
    load_training,
    save_model,
    save_training,
)
from worldmodel.inference import inference_network


@pytest.fixture
def saved(make_model, tmp_path):
    model = make_model(latents="clip", masks=3)
    save_model(model, tmp_path / "model", {"seed": 5})
    return model, tmp_path / "model"


def same(ours, theirs):
    ours, theirs = ours.state_dict(), theirs.state_dict()
    return ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in ours)


def test_a_model_comes_back_from_its_folder_and_from_its_run(saved):
    model, folder = saved
    for place in (folder, folder.parent, str(folder)):
        loaded = load_model(place, precision="float32")
        assert same(model, loaded) and not loaded.training
        assert loaded.config == model.config and loaded.context == model.context
        assert loaded.camera.to_json() == model.camera.to_json() and loaded.frame_gap == 3 and loaded.action_dim == 7
    assert json.loads((folder / CONFIG).read_text())["origin"] == {"seed": 5}
    rgb, depth, actions = torch.rand(1, 2, 3, 16, 24), torch.full((1, 2, 1, 16, 24), 2.0), torch.ones(1, 2, 7)
    with torch.no_grad():
        ours, theirs = (m.step(m.observe(rgb, depth, actions[:, :1]), actions[:, 1])[1] for m in (model, loaded))
    torch.testing.assert_close(ours.rgb, theirs.rgb)


def test_a_precision_that_there_is_not_is_named(saved):
    with pytest.raises(UsageError, match="precision is 'fp16'; give one of auto, float32, bfloat16"):
        load_model(saved[1], precision="fp16")


def test_a_newer_model_replaces_the_older_one(saved, make_model):
    _, folder = saved
    newer = make_model(seed=1)
    save_model(newer, folder, {})
    assert same(newer, load_model(folder))
    assert [path.name for path in folder.parent.iterdir()] == ["model"]


def test_the_inference_network_may_stand_beside_the_model(saved):
    model, folder = saved
    assert load_inference(folder, load_model(folder)) is None
    network = inference_network(model)
    save_model(model, folder, {}, network)
    loaded = load_inference(folder, load_model(folder))
    assert same(model, load_model(folder)) and same(network, loaded) and not loaded.training
    (folder / INFERENCE).write_bytes(b"no tensors")
    assert same(model, load_model(folder))
    with pytest.raises(UsageError, match=f"{INFERENCE} cannot be read"):
        load_inference(folder, model)


def test_killed_between_the_renames_the_older_model_is_still_found(saved):
    model, folder = saved
    folder.rename(folder.with_name("model.old"))
    (folder.parent / "model.tmp").mkdir()
    assert same(model, load_model(folder.parent))
    save_model(model, folder, {})  # and the next save goes through
    assert same(model, load_model(folder))


def test_shipped_models_go_by_name(saved, tmp_path, monkeypatch):
    model, folder = saved
    monkeypatch.setattr(checkpoint, "PRETRAINED", tmp_path / "shipped")
    shutil.copytree(folder, tmp_path / "shipped" / "squares")
    assert same(model, load_model("squares"))
    shutil.copytree(folder, tmp_path / "shipped" / "planar-push" / "squares")
    assert find_model("planar-push/squares") == tmp_path / "shipped" / "planar-push" / "squares"
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    shutil.copytree(folder, "squares")  # one's own of that name
    for name in ("squares", "./squares"):
        assert find_model(name).resolve() == tmp_path / "here" / "squares"
    with pytest.raises(UsageError, match=r"no model at 'circles'; .* shipped name \(squares, planar-push/squares\)"):
        load_model("circles")


def truncate(path):
    path.write_bytes(path.read_bytes()[:-100])


DAMAGE = {
    "weights cut short": lambda folder: truncate(folder / WEIGHTS),
    "weights are something else": lambda folder: (folder / WEIGHTS).write_text("hello"),
    "config cut short": lambda folder: truncate(folder / CONFIG),
    "config is binary": lambda folder: (folder / CONFIG).write_bytes(b"\xff\xfe\x00\x81"),
    "config of something else": lambda folder: (folder / CONFIG).write_text("{}"),
    "an option unknown here": lambda folder: edit(folder / CONFIG, "model", colour="red"),
    "an option that it does not say": lambda folder: edit(folder / CONFIG, "model", translation_unit=None),
    "weights of another width": lambda folder: edit(folder / CONFIG, "model", width=0.5),
    "no weights": lambda folder: (folder / WEIGHTS).unlink(),
    "no config": lambda folder: (folder / CONFIG).unlink(),
}


def edit(path, section, **changed):
    document = json.loads(path.read_text())
    document[section].update(changed)
    document[section] = {name: value for name, value in document[section].items() if value is not None}
    path.write_text(json.dumps(document))


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_model_is_one_line_that_names_it(saved, damage):
    _, folder = saved
    DAMAGE[damage](folder)
    with pytest.raises(UsageError) as raised:
        load_model(folder)
    assert str(folder) in str(raised.value) and "\n" not in str(raised.value) and ";" in str(raised.value)


class Run:
    """A module and its optimiser after some steps."""

    def __init__(self, steps=0):
        torch.manual_seed(0)
        self.modules = {"model": torch.nn.Linear(3, 2), "inference": torch.nn.Linear(2, 1)}
        self.optimiser = torch.optim.Adam([p for m in self.modules.values() for p in m.parameters()], lr=0.1)
        for _ in range(steps):
            self.learn()

    def learn(self):
        self.optimiser.zero_grad()
        self.modules["inference"](self.modules["model"](torch.ones(1, 3))).sum().backward()
        self.optimiser.step()

    def save(self, run, step):
        save_training(run, self.modules, self.optimiser, {"step": step})

    def weights(self):
        return torch.cat([p.detach().flatten() for m in self.modules.values() for p in m.parameters()])


def test_training_goes_on_with_weights_and_moments(tmp_path):
    first, second = Run(steps=3), Run()
    assert load_training(tmp_path, second.modules, second.optimiser) is None
    first.save(tmp_path, 3)
    assert load_training(tmp_path, second.modules, second.optimiser) == {"step": 3}
    assert torch.equal(first.weights(), second.weights())
    first.learn()
    second.learn()  # the same only with Adam's moments and step
    assert torch.equal(first.weights(), second.weights())


def test_moments_are_laid_out_as_their_weights_are(tmp_path):
    """As Adam makes them at its first step; the fused one takes no others."""
    run = Run()
    run.modules["model"] = torch.nn.Conv2d(3, 4, 3).to(memory_format=torch.channels_last)
    weights = run.modules["model"].weight
    run.optimiser = torch.optim.Adam(run.modules["model"].parameters())
    run.modules["model"](torch.ones(1, 3, 8, 8)).square().sum().backward()
    run.optimiser.step()
    made = {key: run.optimiser.state[weights][key].clone() for key in ("exp_avg", "exp_avg_sq")}
    run.save(tmp_path, 1)
    load_training(tmp_path, run.modules, run.optimiser)
    for key, value in made.items():
        loaded = run.optimiser.state[weights][key]
        assert torch.equal(loaded, value) and loaded.stride() == value.stride() == weights.stride()


def test_the_two_newest_are_kept_and_unfinished_ones_ignored(tmp_path):
    run = Run(steps=1)
    for step in (1, 2, 3):
        run.save(tmp_path, step)
    folder = tmp_path / "checkpoints"
    assert sorted(path.name for path in folder.iterdir()) == ["step-00000002", "step-00000003"]
    shutil.copytree(folder / "step-00000003", folder / "step-00000004.tmp")  # killed while it was written
    (folder / "step-00000005").mkdir()
    assert load_training(tmp_path, run.modules, run.optimiser) == {"step": 3}


@pytest.mark.parametrize(
    "damage",
    [
        lambda folder: truncate(folder / TRAINING),
        lambda folder: (folder / TRAINING).unlink(),
        lambda folder: (folder / STATE).write_bytes(b"\xff{"),
    ],
)
def test_a_damaged_checkpoint_is_named(tmp_path, damage):
    run = Run(steps=1)
    run.save(tmp_path, 1)
    folder = tmp_path / "checkpoints" / "step-00000001"
    damage(folder)
    with pytest.raises(UsageError, match=r"does not fit .* remove it, or give another --out") as raised:
        load_training(tmp_path, run.modules, run.optimiser)
    assert str(folder) in str(raised.value) and "\n" not in str(raised.value)


def test_a_checkpoint_of_another_network_is_named(tmp_path):
    Run().save(tmp_path, 1)
    other = Run()
    other.modules["model"] = torch.nn.Linear(4, 2)
    with pytest.raises(UsageError, match="does not fit"):
        load_training(tmp_path, other.modules, other.optimiser)
