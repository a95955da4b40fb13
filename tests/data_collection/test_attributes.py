"""A shard says all about its columns, and what it says fits them: when it is written, and when it is opened."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from commands import assert_one_line_error, call
from shards import ATTRS, CAMERA, flip_a_byte_of, make_episode

from data_collection.dataset import RGBDDataset
from data_collection.repair import repair
from data_collection.schema import DamagedShard
from data_collection.writer import write_shard
from envs.camera import CameraModel
from envs.errors import UsageError

DOCUMENT = Path(__file__).parents[2] / "docs" / "data.md"
OTHER_CAMERA = CameraModel.from_fovy(24, 24, 30.0, np.eye(4), 1.0, 3.0)


@pytest.fixture
def episode():
    return make_episode(np.random.default_rng(0), 5)


@pytest.fixture
def shard(tmp_path, episode):
    write_shard(tmp_path / "shard-00000.h5", [episode], ATTRS, [0])
    return tmp_path / "shard-00000.h5"


def set_attribute(path, name, value):
    with h5py.File(path, "a") as file:
        file.attrs[name] = json.dumps(value)


@pytest.mark.parametrize("name", sorted(ATTRS))
def test_none_may_be_missing(tmp_path, episode, name):
    attrs = {key: value for key, value in ATTRS.items() if key != name}
    with pytest.raises(UsageError, match=f"without attribute '{name}'"):
        write_shard(tmp_path / "shard-00000.h5", [episode], attrs, [0])
    assert not list(tmp_path.iterdir())


UNFIT = [
    ({"action_aggregation": ["sum"]}, r"actions of 2 numbers, but action_aggregation \['sum'\]"),
    ({"action_scale": [0.1] * 5}, "actions of 2 numbers, but action_scale"),
    ({"action_aggregation": ["sum", "add"]}, "unknown aggregation 'add'"),
    ({"action_aggregation": ["rotate", "sum"]}, "'rotate' comes in threes"),
    ({"camera": OTHER_CAMERA.to_dict()}, r"'rgb' of \(12, 16, 3\), but its camera takes \(24, 24, 3\)"),
    ({"camera": CAMERA.to_json()}, "camera has str; .* to_dict"),
]


@pytest.mark.parametrize(("changed", "words"), UNFIT)
def test_what_does_not_fit_is_not_written(tmp_path, episode, changed, words):
    with pytest.raises(UsageError, match=words):
        write_shard(tmp_path / "shard-00000.h5", [episode], {**ATTRS, **changed}, [0])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("changed", "words"), UNFIT)
def test_what_does_not_fit_is_not_opened(shard, changed, words):
    for name, value in changed.items():
        set_attribute(shard, name, value)
    with pytest.raises(UsageError, match=f"shard-00000.h5.*{words}") as caught:
        RGBDDataset(shard.parent)
    assert not isinstance(caught.value, DamagedShard)


def test_numbers_of_the_camera_follow_from_it(shard, episode):
    attrs = RGBDDataset(shard.parent).attrs
    for name in ("K", "world_T_camera", "near", "far"):
        np.testing.assert_array_equal(attrs[name], getattr(CAMERA, name))
    write_shard(shard, [episode], {**ATTRS, "K": CAMERA.K, "near": CAMERA.near}, [0])
    for name, value in (("K", np.eye(3)), ("near", 9.0)):
        with pytest.raises(UsageError, match=f"attribute {name} is not what the camera has; leave it out"):
            write_shard(shard, [episode], {**ATTRS, name: value}, [0])


@pytest.mark.parametrize("name", ["body_names", "schema"])
def test_a_shard_without_an_attribute_is_not_taken_for_damaged(shard, name):
    with h5py.File(shard, "a") as file:
        del file.attrs[name]
    for options in ([], ["--repair"]):
        assert_one_line_error(call("inspect-dataset", [shard.parent, *options]), f"no attribute '{name}'")
    assert shard.exists() and not (shard.parent / "damaged").exists()


def test_repair_moves_nothing_that_it_cannot_write_again(tmp_path):
    rng = np.random.default_rng(0)
    path = tmp_path / "shard-00000.h5"
    write_shard(path, [make_episode(rng, 1000), make_episode(rng, 1000)], ATTRS, [0, 1])
    flip_a_byte_of(path, "rgb")
    set_attribute(path, "action_scale", [1.0])
    with pytest.raises(UsageError, match="action_scale"):
        repair(tmp_path)
    assert path.exists() and not (tmp_path / "damaged").exists()


def test_the_documents_example_makes_a_dataset(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = DOCUMENT.read_text().partition("## Your own data")[2]
    code = text.partition("```python\n")[2].partition("```")[0]
    exec(compile(code, str(DOCUMENT), "exec"), {})
    dataset = RGBDDataset(tmp_path / "data" / "mine")
    assert dataset.episode_lengths.tolist() == [61] * 20 and dataset.camera.width == 64
    depth = dataset.depth_metres(dataset.episode(1)["depth"])
    assert (depth.min(), depth.max()) == pytest.approx((1.1, 1.2), abs=1e-4)
