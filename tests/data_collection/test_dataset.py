"""What is written comes back, and what is wrong is named."""

import errno
import multiprocessing
import os
import pickle
import shutil

import h5py
import numpy as np
import pytest
from shards import ATTRS, CAMERA, flip_a_byte_of, make_episode
from torch.utils.data import DataLoader

from data_collection import writer
from data_collection.dataset import RGBDDataset
from data_collection.schema import DamagedShard, episode_hash, read_shard
from data_collection.writer import intact_episodes, read_episode, write_shard
from envs.errors import UsageError


@pytest.fixture
def episodes():
    rng = np.random.default_rng(0)
    return [make_episode(rng, rows) for rows in (5, 1, 40)]


@pytest.fixture
def folder(tmp_path, episodes):
    write_shard(tmp_path / "shard-00000.h5", episodes[:2], ATTRS, [0, 1])
    write_shard(tmp_path / "shard-00001.h5", episodes[2:], ATTRS, [2])
    return tmp_path


def test_round_trip(folder, episodes):
    dataset = RGBDDataset(folder)
    assert dataset.episodes == len(dataset) == 3 and dataset.action_dim == 2
    assert dataset.episode_lengths.tolist() == [5, 1, 40]
    assert not dataset.has_ground_truth
    np.testing.assert_array_equal(dataset.camera.K, CAMERA.K)
    for name, value in ATTRS.items():
        np.testing.assert_array_equal(dataset.attrs[name], value)
    for number, written in enumerate(episodes):
        read = dataset.episode(number)
        start, stop = dataset.episode_slices[number]
        assert read.keys() == written.keys()
        for name, values in written.items():
            assert read[name].dtype == values.dtype
            np.testing.assert_array_equal(read[name], values)
            np.testing.assert_array_equal(dataset.load(name)[start:stop], values)


def test_ground_truth_is_seen_only_if_all_shards_have_it_and_it_will_be_read(tmp_path):
    rng = np.random.default_rng(0)
    write_shard(tmp_path / "shard-00000.h5", [make_episode(rng, 3, ground_truth=True)], ATTRS, [0])
    assert RGBDDataset(tmp_path).has_ground_truth
    assert RGBDDataset(tmp_path, ["rgb", "segmentation", "body_pose"]).has_ground_truth
    assert not RGBDDataset(tmp_path, ["rgb", "segmentation"]).has_ground_truth
    write_shard(tmp_path / "shard-00001.h5", [make_episode(rng, 3)], ATTRS, [1])
    assert not RGBDDataset(tmp_path).has_ground_truth
    with pytest.raises(UsageError, match=r"shard-00001.h5 has no column 'segmentation'.*--ground-truth"):
        RGBDDataset(tmp_path, ["rgb", "segmentation"])


def test_a_dataset_is_a_sequence_of_episodes(folder):
    dataset = RGBDDataset(folder)
    for number, episode in enumerate(dataset):
        same = dataset[number - len(dataset)]
        for name, values in dataset.episode(number).items():
            np.testing.assert_array_equal(episode[name], values)
            np.testing.assert_array_equal(same[name], values)
    assert number + 1 == len(dataset) == dataset.episodes
    for number in (len(dataset), -len(dataset) - 1):
        with pytest.raises(IndexError, match=f"episode {number} of a dataset of {len(dataset)}"):
            dataset[number]


def test_pytorch_loads_episodes(folder):
    dataset = RGBDDataset(folder)
    loaded = list(DataLoader(dataset, batch_size=None, num_workers=1))
    assert len(loaded) == len(dataset)
    for number, episode in enumerate(loaded):
        for name, values in dataset[number].items():
            np.testing.assert_array_equal(episode[name].numpy(), values)


def test_reader_survives_spawn(folder):
    dataset = RGBDDataset(folder)
    dataset.load("rgb")  # used before it travels
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        there = pool.apply(RGBDDataset.episode, (dataset, 2))
    here = pickle.loads(pickle.dumps(dataset)).episode(2)
    np.testing.assert_array_equal(episode_hash(there), episode_hash(here))


def test_content_hash_is_of_the_content(folder, episodes, tmp_path_factory):
    other = tmp_path_factory.mktemp("other")
    write_shard(other / "shard-00000.h5", episodes, {**ATTRS, "versions": {"numpy": "9"}}, [0, 1, 2])
    assert RGBDDataset(other).content_hash == RGBDDataset(folder).content_hash
    episodes[1]["rgb"][0, 0, 0, 0] ^= 1
    write_shard(other / "shard-00000.h5", episodes, ATTRS, [0, 1, 2])
    assert RGBDDataset(other).content_hash != RGBDDataset(folder).content_hash
    episodes[1]["rgb"][0, 0, 0, 0] ^= 1
    write_shard(other / "shard-00000.h5", episodes, {**ATTRS, "control_rate": 20.0}, [0, 1, 2])
    assert RGBDDataset(other).content_hash != RGBDDataset(folder).content_hash


def test_missing_folder_and_empty_folder(tmp_path):
    with pytest.raises(UsageError, match=r"no dataset folder .*nowhere; .*collect-rollouts"):
        RGBDDataset(tmp_path / "nowhere")
    with pytest.raises(UsageError, match=r"no shard-\*\.h5 in .*; give a folder of collect"):
        RGBDDataset(tmp_path)


def test_dataset_without_depth(folder):
    with h5py.File(folder / "shard-00001.h5", "a") as file:
        del file["depth"]
    with pytest.raises(UsageError, match=r"shard-00001\.h5 has no column 'depth'"):
        RGBDDataset(folder)
    assert RGBDDataset(folder, ["rgb", "action"]).columns == ("rgb", "action")
    with pytest.raises(UsageError, match="no column 'depth'"):
        RGBDDataset(folder, ["rgb"]).load("depth")


def _truncate(path):
    path.write_bytes(path.read_bytes()[:-100])


def _write_nonsense(path):
    path.write_bytes(b"not HDF5 at all")


def _empty(path):
    path.write_bytes(b"")


def _spoil_attribute(path):
    with h5py.File(path, "a") as file:
        file.attrs["env_id"] = "{"


def _drop_table(path):
    with h5py.File(path, "a") as file:
        del file["ep_len"]


def _shorten_table(name):
    def damage(path):
        with h5py.File(path, "a") as file:
            values = file[name][()]
            del file[name]
            file[name] = values[..., :-1]

    return damage


def _make_a_group_of_a_column(path):
    with h5py.File(path, "a") as file:
        del file["state"]
        file.create_group("state")


def _shorten_column(path):
    with h5py.File(path, "a") as file:
        values = file["reward"][:-1]
        del file["reward"]
        file["reward"] = values


def _retype_column(path):
    with h5py.File(path, "a") as file:
        values = file["depth"][()].astype(np.float32)
        del file["depth"]
        file["depth"] = values


@pytest.mark.parametrize(
    "damage",
    [
        _truncate,
        _write_nonsense,
        _empty,
        _spoil_attribute,
        _drop_table,
        *map(_shorten_table, ("ep_len", "ep_index", "ep_hash")),
        _make_a_group_of_a_column,
        _shorten_column,
        _retype_column,
    ],
)
def test_damaged_shard_is_named_when_opened(folder, damage):
    damage(folder / "shard-00001.h5")
    with pytest.raises(
        DamagedShard, match=r"shard-00001\.h5 is damaged \(.*\); drop it with: inspect-dataset .* --repair"
    ):
        RGBDDataset(folder)


def test_damaged_chunk_is_named_when_read(folder):
    flip_a_byte_of(folder / "shard-00001.h5", "rgb")
    dataset = RGBDDataset(folder)
    dataset.load("depth")
    for read in (lambda: dataset.load("rgb"), lambda: dataset.episode(2)):
        with pytest.raises(DamagedShard, match=r"shard-00001\.h5"):
            read()


def test_a_column_that_is_gone_is_named_when_read(folder):
    dataset = RGBDDataset(folder)
    with h5py.File(folder / "shard-00001.h5", "a") as file:
        del file["rgb"]
    with pytest.raises(DamagedShard, match=r"shard-00001\.h5 is damaged"):
        dataset.load("rgb")


@pytest.mark.parametrize("number", [errno.EACCES, errno.EMFILE, errno.EIO])
def test_a_shard_that_the_system_does_not_let_be_read_is_not_damaged(folder, monkeypatch, number):
    dataset, path = RGBDDataset(folder), folder / "shard-00001.h5"

    def refuse(*_):
        raise OSError(number, f"Unable to synchronously open file (errno = {number})")

    monkeypatch.setattr(h5py, "File", refuse)
    for read in (lambda: read_shard(path), lambda: dataset.load("rgb"), lambda: intact_episodes(path)):
        with pytest.raises(UsageError, match=rf"shard-0000\d\.h5 cannot be read: {os.strerror(number)}") as caught:
            read()
        assert not isinstance(caught.value, DamagedShard)


def test_a_disk_that_fails_while_a_column_is_read_is_no_other_episode(folder, monkeypatch):
    def fail(*_):
        raise KeyError("Unable to synchronously open object (file read failed: errno = 5)")  # as HDF5 has it

    monkeypatch.setattr(writer, "read_episode", fail)
    with pytest.raises(UsageError, match=r"shard-00001\.h5 cannot be read: Input/output error"):
        intact_episodes(folder / "shard-00001.h5")


def test_other_schema_version(folder):
    with h5py.File(folder / "shard-00000.h5", "a") as file:
        file.attrs["schema"] = 99
    with pytest.raises(UsageError, match="schema version 99, this program reads 1"):
        RGBDDataset(folder)


def test_shards_of_different_datasets(folder, episodes):
    write_shard(folder / "shard-00001.h5", episodes[2:], {**ATTRS, "env_id": "other/Env-v0"}, [2])
    with pytest.raises(UsageError, match=r"shard-00001\.h5 has env_id = 'other/Env-v0'.*one dataset in a folder"):
        RGBDDataset(folder)
    episodes[2]["proprio"] = episodes[2]["proprio"][:, :1]
    write_shard(folder / "shard-00001.h5", episodes[2:], ATTRS, [2])
    with pytest.raises(UsageError, match="column 'proprio' has rows of"):
        RGBDDataset(folder)


def test_shards_whose_optional_columns_differ(tmp_path):
    rng = np.random.default_rng(0)
    for number, bodies in enumerate((3, 2)):
        episode = make_episode(rng, 4, ground_truth=True)
        episode["body_pose"] = episode["body_pose"][:, :bodies]
        write_shard(tmp_path / f"shard-0000{number}.h5", [episode], ATTRS, [number])
    with pytest.raises(UsageError, match=r"column 'body_pose' has rows of \(2, 7\) in .*1\.h5 but \(3, 7\)"):
        RGBDDataset(tmp_path)


def test_what_else_is_in_a_shard_is_left_alone(folder, episodes):
    before = RGBDDataset(folder)
    with h5py.File(folder / "shard-00000.h5", "a") as file:
        file["notes/operator"] = np.arange(3)
        file["ep_language"] = ["push", "pull"]
        file.attrs["operator"], file.attrs["offset"] = "Anna", np.arange(3.0)
        file.attrs["tags"], file.attrs["nothing"] = [b"a", b"b"], h5py.Empty("f4")
    after = RGBDDataset(folder)
    assert after.columns == before.columns and after.content_hash == before.content_hash
    assert after.attrs["operator"] == "Anna" and after.attrs["offset"].tolist() == [0, 1, 2]
    assert intact_episodes(folder / "shard-00000.h5")[1] == [True, True]
    np.testing.assert_array_equal(after.episode(1)["rgb"], episodes[1]["rgb"])


def test_how_episodes_ended_is_kept_and_is_no_part_of_the_content(folder, episodes):
    before = RGBDDataset(folder)
    assert before.episode_terminated.tolist() == [False] * 3  # without the table none did
    write_shard(folder / "shard-00000.h5", episodes[:2], ATTRS, [0, 1], [False, True])
    after = RGBDDataset(folder)
    assert after.episode_terminated.tolist() == [False, True, False]
    assert after.columns == before.columns and after.content_hash == before.content_hash
    with h5py.File(folder / "shard-00000.h5", "a") as file:
        del file["ep_terminated"]
        file["ep_terminated"] = np.zeros(3, np.uint8)
    with pytest.raises(DamagedShard, match=r"ep_terminated is uint8 \(3,\), for 2 episodes"):
        RGBDDataset(folder)


def test_actions_between_the_frames_only_are_told_of_the_last_row(tmp_path, episodes):
    short = {**episodes[0], "action": episodes[0]["action"][:-1]}
    with pytest.raises(UsageError, match=r"column 'action' is float32 .*; the last frame has a row of zeros, too"):
        write_shard(tmp_path / "shard-00000.h5", [short], ATTRS, [0])


def test_writer_refuses_what_the_schema_does_not_have(tmp_path, episodes):
    path = tmp_path / "shard-00000.h5"
    for spoil in (
        lambda columns: columns.pop("depth"),
        lambda columns: columns.update(extra=columns["reward"]),
        lambda columns: columns.update(depth=columns["depth"].astype(np.float32)),
        lambda columns: columns.update(reward=columns["reward"][:-1]),
        lambda columns: columns.update(reward=columns["reward"] * np.nan),
        lambda columns: columns.update({name: values[:0] for name, values in columns.items()}),
    ):
        columns = dict(episodes[0])
        spoil(columns)
        with pytest.raises(ValueError):
            write_shard(path, [columns], ATTRS, [0])
    for chosen, numbers, ended, words in (
        ([], [], (), "no episodes for shard-00000.h5"),
        (episodes, [0, 1], (), "ep_index has 2 for 3 episodes; give one for each"),
        (episodes, [0, 1, 2], [True], "ep_terminated has 1 for 3 episodes"),
    ):
        with pytest.raises(UsageError, match=words):
            write_shard(path, chosen, ATTRS, numbers, ended)
    assert list(tmp_path.iterdir()) == []


def test_shard_is_replaced_or_left(folder, episodes, monkeypatch):
    """A writer that fails half-way leaves the shard that was there, and no other file."""
    path = folder / "shard-00001.h5"
    before = path.read_bytes()
    monkeypatch.setattr("envs.files.os.replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        write_shard(path, episodes, ATTRS, [0, 1, 2])
    assert path.read_bytes() == before and not list(folder.glob("*.tmp"))


def test_shard_copied_elsewhere_reads_alone(folder, tmp_path_factory, episodes):
    other = tmp_path_factory.mktemp("copy")
    shutil.copy(folder / "shard-00001.h5", other)
    shard = read_shard(other / "shard-00001.h5")
    np.testing.assert_array_equal(read_episode(shard, 0)["rgb"], episodes[2]["rgb"])
