"""Datasets in the formats of other projects, opened as those open them."""

import signal
import sys

import h5py
import numpy as np
import pytest
from commands import assert_one_line_error, call
from shards import ATTRS, CAMERA, make_episode

from data_collection.dataset import RGBDDataset
from data_collection.exporters.minari_dataset import action_space
from data_collection.writer import write_shard


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    rng = np.random.default_rng(0)
    attrs = {**ATTRS, "env_id": "calvin/D", "workspace": [[0.0] * 3, [1.0] * 3], "offset": np.arange(2.0)}

    def episode(rows):
        turned = rng.normal(size=(rows, 3)).astype(np.float32)
        return {**make_episode(rng, rows, ground_truth=True), "joint_delta": turned}

    write_shard(folder / "shard-00000.h5", [episode(5)], attrs, [0])
    write_shard(folder / "shard-00001.h5", [episode(rows) for rows in (3, 8)], attrs, [1, 2], [True, False])
    return folder


def test_minari_opens_the_export(folder, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    arguments = [folder, "--to", "minari", "--name", "calvin/play-d-v0", "--out", tmp_path, "--author", "A. Person"]
    code, out, err = call("export-dataset", arguments)
    assert code == 0 and "3 episodes in" in out, err
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    assert list(minari.list_local_datasets()) == ["calvin/play-d-v0"]
    theirs, ours = minari.load_dataset("calvin/play-d-v0"), RGBDDataset(folder)
    assert theirs.total_episodes == 3 and theirs.total_steps == 4 + 2 + 7
    metadata = theirs.storage.metadata
    assert metadata["author"] == {"A. Person"} and metadata["rgbd"]["camera"]["K"] == CAMERA.K.tolist()
    assert metadata["rgbd"]["action_aggregation"] == ["sum", "last"] and metadata["rgbd"]["seed"] == ATTRS["seed"]
    assert metadata["rgbd"]["workspace"] == [[0, 0, 0], [1, 1, 1]] and metadata["rgbd"]["offset"] == [0, 1]
    for number, episode in enumerate(theirs.iterate_episodes()):
        expected = ours.episode(number)
        np.testing.assert_array_equal(episode.observations["rgb"].transpose(0, 2, 3, 1), expected["rgb"])
        depth = ours.depth_metres(expected["depth"])
        np.testing.assert_allclose(episode.observations["depth"], depth, atol=1e-6)
        np.testing.assert_array_equal(episode.actions, expected["action"][:-1])
        np.testing.assert_array_equal(episode.rewards, expected["reward"][:-1])
        np.testing.assert_array_equal(episode.infos["segmentation"], expected["segmentation"])
        assert set(episode.infos) == {"state", "joint_delta", "segmentation", "body_pose"}
        np.testing.assert_array_equal(episode.infos["state"], expected["state"])
        np.testing.assert_array_equal(episode.infos["joint_delta"], expected["joint_delta"])
        terminated = number == 1
        assert episode.terminations.tolist() == [False] * (len(episode) - 1) + [terminated]
        assert episode.truncations.tolist() == [False] * (len(episode) - 1) + [not terminated]
        for row in range(len(depth)):
            frame = {name: values[row] for name, values in episode.observations.items()}
            assert theirs.observation_space.contains(frame)
        assert theirs.action_space.contains(episode.actions[0])
    assert_one_line_error(call("export-dataset", arguments), "is there already", "minari delete calvin/play-d-v0")
    assert_one_line_error(call("export-dataset", [*arguments[:4], "play d", *arguments[5:]]), "play d", "no name")
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(
    ("attrs", "low", "high"),
    [
        ({"env_id": "t3vip/TabletopC-v0"}, [-1, -1], [1, 1]),
        ({"env_id": "envs:t3vip/DexHand-v0"}, [-1, -1], [1, 1]),
        ({"env_id": "dexhand"}, [-np.inf, -np.inf], [np.inf, np.inf]),  # imported: no commands, but differences
        ({"env_id": "some/Env-v0", "action_bounds": [[-2, 0], [3, 1]]}, [-2, 0], [3, 1]),
    ],
)
def test_actions_keep_the_bounds_that_are_known(tmp_path, attrs, low, high):
    episode = make_episode(np.random.default_rng(0), 3)
    write_shard(tmp_path / "shard-00000.h5", [episode], {**ATTRS, **attrs}, [0])
    space = action_space(RGBDDataset(tmp_path))
    assert (space.low.tolist(), space.high.tolist(), space.dtype) == (low, high, np.float32)


@pytest.mark.parametrize("told", [["--out", "root"], []])
def test_minaris_folder_may_be_relative(folder, tmp_path, monkeypatch, told):
    minari = pytest.importorskip("minari")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", "root")
    code, _, err = call("export-dataset", [folder, "--to", "minari", "--name", "calvin/play-d-v0", *told])
    assert code == 0, err
    assert minari.load_dataset("calvin/play-d-v0").total_episodes == 3


def test_an_interrupted_export_leaves_nothing(folder, tmp_path, monkeypatch):
    pytest.importorskip("minari")
    from data_collection.exporters import flat_file, minari_dataset

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(minari_dataset, "episode_buffer", interrupted)
    monkeypatch.setattr(flat_file, "_columns", interrupted)
    for to in (
        ["minari", "--name", "calvin/d-v0", "--out", tmp_path],
        ["stable-worldmodel", "--out", tmp_path / "d.h5"],
    ):
        assert call("export-dataset", [folder, "--to", *to])[0] == 130
    assert not list(tmp_path.iterdir())


def test_a_terminated_export_leaves_nothing(folder, tmp_path, monkeypatch, capsys):
    pytest.importorskip("minari")
    from data_collection import export_dataset
    from data_collection.exporters import flat_file, minari_dataset

    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    for module, name, to in (
        (minari_dataset, "episode_buffer", ["minari", "--name", "calvin/d-v0", "--out", tmp_path]),
        (flat_file, "_columns", ["stable-worldmodel", "--out", tmp_path / "d.h5"]),
    ):
        monkeypatch.setattr(module, name, lambda *_: signal.raise_signal(signal.SIGTERM))
        monkeypatch.setattr(sys, "argv", ["export-dataset", str(folder), "--to", *map(str, to)])
        try:
            with pytest.raises(SystemExit) as stop:
                export_dataset.command()
        finally:
            signal.signal(signal.SIGTERM, before)
        assert stop.value.code == 143 and "terminated; nothing was written" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_without_minari_the_remedy_is_named(folder, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "minari", None)
    result = call("export-dataset", [folder, "--to", "minari", "--name", "d-v0", "--out", tmp_path])
    assert_one_line_error(result, "pip install 'minari<0.5.4'")


class TheirReader:
    """What stable-worldmodel 0.1.1 does with a file (`HDF5Dataset`), in its own few lines: it opens the file for
    concurrent reading, takes every dataset but ep_len and ep_offset for a column unless it is told which to load, and
    cuts each at ep_offset + frame."""

    def __init__(self, path, frameskip, num_steps, keys_to_load=None):
        self.file = h5py.File(path, "r", swmr=True)
        self.lengths, self.offsets = self.file["ep_len"][:], self.file["ep_offset"][:]
        self.keys = keys_to_load or [key for key in self.file if key not in ("ep_len", "ep_offset")]
        self.frameskip, self.num_steps, span = frameskip, num_steps, num_steps * frameskip
        self.clips = [(e, s) for e, length in enumerate(self.lengths) for s in range(length - span + 1)]

    def __getitem__(self, index):
        episode, start = self.clips[index]
        first = self.offsets[episode] + start
        rows = {key: self.file[key][first : first + self.num_steps * self.frameskip] for key in self.keys}
        steps = {key: values if key == "action" else values[:: self.frameskip] for key, values in rows.items()}
        return {**steps, "action": steps["action"].reshape(self.num_steps, -1)}


def test_native_shards_open_in_stable_worldmodel(folder):
    dataset = RGBDDataset(folder)
    reader = TheirReader(folder / "shard-00001.h5", 3, 2, ["rgb", "depth", "action", "proprio"])
    assert reader.lengths.dtype.kind == reader.offsets.dtype.kind == "i" and reader.clips == [(1, 0), (1, 1), (1, 2)]
    clip, episode = reader[1], dataset.episode(2)
    np.testing.assert_array_equal(clip["rgb"], episode["rgb"][1:7:3])
    np.testing.assert_array_equal(clip["action"], episode["action"][1:7].reshape(2, 6))


def test_one_file_for_stable_worldmodel(folder, tmp_path):
    path = tmp_path / "new" / "d.h5"
    code, out, err = call("export-dataset", [folder, "--to", "stable-worldmodel", "--out", path])
    assert code == 0 and str(path) in out, err
    dataset, reader = RGBDDataset(folder), TheirReader(path, 2, 2)
    assert reader.keys == ["action", "depth", "joint_delta", "pixels", "proprio", "reward", "state"]
    assert [len(clips) for clips in ([c for c in reader.clips if c[0] == e] for e in range(3))] == [2, 0, 5]
    clip, episode = reader[-1], dataset.episode(2)
    np.testing.assert_array_equal(clip["pixels"], episode["rgb"][4:8:2])
    np.testing.assert_array_equal(clip["depth"], dataset.depth_metres(episode["depth"])[4:8:2])
    assert all(len(reader.file[key]) == 16 for key in reader.keys)
    arguments = [folder, "--to", "stable-worldmodel", "--out", path]
    assert_one_line_error(call("export-dataset", arguments), "is there already")
    assert_one_line_error(call("export-dataset", [*arguments, "--name", "d-v0"]), "--name is for Minari")
    assert_one_line_error(call("export-dataset", arguments[:3]), "no --out")
