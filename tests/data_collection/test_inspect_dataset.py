"""Inspection says what is there; repair drops what is damaged and nothing else."""

import functools
import json
import shutil

import h5py
import imageio.v2 as imageio
import imageio_ffmpeg
import numpy as np
import pytest
from commands import assert_one_line_error, call, finish, options, start
from layouts import write_omnipush
from shards import ATTRS, flip_a_byte_of, make_episode

from data_collection.dataset import RGBDDataset
from data_collection.goal_statistics import goal_statistics
from data_collection.pictures import write_film
from data_collection.repair import find_damage, repair
from data_collection.schema import episode_hash
from data_collection.statistics import BY_NUMBER, column_ranges, describe, moved_shares, workspace_coverage
from data_collection.writer import write_shard
from envs.dexhand.goals import HOME
from envs.errors import UsageError
from envs.files import locked


@pytest.fixture
def folder(collected, tmp_path):
    return shutil.copytree(collected, tmp_path / "data")


def test_report_table_and_pictures(folder):
    code, out, err = call("inspect-dataset", [folder, "--clips", "3"])
    assert code == 0, err
    report = json.loads((folder / "inspection" / "inspection.json").read_text())
    dataset = RGBDDataset(folder)
    assert report["episodes"] == report["episodes_asked_for"] == 4 and report["frames"] == 36
    assert report["content_hash"] == dataset.content_hash and dataset.content_hash in out
    assert report["columns"]["depth"]["min"] == pytest.approx(1.5, abs=1e-3)
    assert report["columns"]["depth"]["max"] == pytest.approx(2.5, abs=1e-3)
    assert report["columns"]["rgb"]["max"] == 250
    assert len(report["columns"]["action"]["std"]) == 3
    assert 0 < report["workspace"]["share_of_cells_visited"] < 0.1
    sheet = imageio.imread(folder / "inspection" / "contact_sheet.png")
    assert sheet.shape == (3 * (2 * 128 + 4), 10 * (128 + 4), 3)
    film = imageio.mimread(folder / "inspection" / "episodes.mp4", memtest=False)
    assert len(film) == 9 and film[0].shape == (2 * 128 + 4, 3 * (128 + 4), 3)
    assert np.ptp(film[0]) > 100


def test_many_episodes_are_filmed_in_rows(folder, tmp_path):
    dataset, path = RGBDDataset(folder), tmp_path / "film.mp4"
    write_film(dataset, [0, 1, 2, 3] * 35, path)  # side by side they would be wider than encoders take
    film = imageio.mimread(path, memtest=False)
    height, width = film[0].shape[:2]
    assert len(film) == 9 and (height, width) == (9 * (2 * 128 + 4), 17 * (128 + 4))
    tiles = film[0].reshape(9, height // 9, 17, width // 17, 3).swapaxes(1, 2).reshape(153, height // 9, width // 17, 3)
    assert (np.ptp(tiles[:140], axis=(1, 2, 3)) > 100).all() and tiles[140:].min() > 240


def test_a_film_that_ffmpeg_does_not_write_leaves_the_old_one(folder, monkeypatch):
    path = folder / "inspection" / "episodes.mp4"
    path.parent.mkdir()
    path.write_bytes(b"the film of before")
    write = functools.partial(imageio_ffmpeg.write_frames, codec="none-such")
    monkeypatch.setattr(imageio_ffmpeg, "write_frames", write)
    assert_one_line_error(call("inspect-dataset", [folder, "--clips", "2"]), "episodes.mp4", "pixels", "a smaller film")
    assert path.read_bytes() == b"the film of before"
    assert not list(path.parent.glob("*.tmp"))


def test_ranges_are_of_whole_columns_and_only_short_rows_are_held_in_memory(collected, monkeypatch):
    dataset, loaded, load = RGBDDataset(collected), [], RGBDDataset.load
    monkeypatch.setattr(RGBDDataset, "load", lambda self, name: loaded.append(name) or load(self, name))
    ranges = column_ranges(dataset)
    assert set(loaded) <= set(BY_NUMBER) and tuple(ranges) == dataset.columns
    for name, found in ranges.items():
        whole = load(dataset, name)
        assert found["shape"] == list(whole.shape) and found["dtype"] == str(whole.dtype)
        axis = 0 if name in BY_NUMBER else None
        low, high = whole.min(axis), whole.max(axis)
        if name == "depth":
            low, high = dataset.depth_metres(np.array([low, high]))
        np.testing.assert_allclose(found["min"], low, atol=1e-4)
        np.testing.assert_allclose(found["max"], high, atol=1e-4)


def test_repair_drops_what_is_damaged_and_collecting_makes_it_again(folder):
    whole = RGBDDataset(folder).content_hash
    shard = folder / "shard-00001.h5"
    shard.write_bytes(shard.read_bytes()[:-10])
    flip_a_byte_of(folder / "shard-00003.h5", "depth")
    (folder / "shard-00009.h5.77.tmp").touch()
    assert_one_line_error(call("inspect-dataset", [folder]), "shard-00001.h5", "--repair")
    code, out, err = call("inspect-dataset", [folder, "--repair", "--no-pictures"])
    assert code == 0, err
    for line in (
        "removed shard-00009.h5.77.tmp",
        "dropped all of shard-00001.h5",
        "dropped episode 3 of shard-00003.h5",
    ):
        assert line in out
    assert "2 of 4" in out
    assert sorted(path.name for path in (folder / "damaged").iterdir()) == ["shard-00001.h5", "shard-00003.h5"]
    assert RGBDDataset(folder).episode_indices.tolist() == [0, 2]
    code, _, err = call("collect-rollouts", options(folder, **{"ground-truth": True}))
    assert code == 0, err
    assert RGBDDataset(folder).content_hash == whole
    code, out, _ = call("inspect-dataset", [folder, "--repair", "--no-pictures"])
    assert code == 0 and "nothing is damaged" in out


def test_silent_damage_is_found(folder):
    flip_a_byte_of(folder / "shard-00002.h5", "rgb")
    assert [line for line in find_damage(folder) if "shard-00002.h5: episode 2" in line]
    assert_one_line_error(call("inspect-dataset", [folder]), "shard-00002.h5", "checksum", "--repair")


def test_intact_episodes_of_a_damaged_shard_are_kept(tmp_path):
    rng = np.random.default_rng(0)
    episodes = [make_episode(rng, 1000), make_episode(rng, 1000)]  # longer than a chunk
    path = tmp_path / "shard-00000.h5"
    write_shard(path, episodes, ATTRS, [4, 5], [False, True])
    flip_a_byte_of(path, "rgb")
    assert repair(tmp_path) == ["dropped episode 4 of shard-00000.h5: checksum differs; kept as damaged/shard-00000.h5"]
    dataset = RGBDDataset(tmp_path)
    assert dataset.episode_indices.tolist() == [5] and dataset.episode_terminated.tolist() == [True]
    np.testing.assert_array_equal(episode_hash(dataset.episode(0)), episode_hash(episodes[1]))


@pytest.fixture
def half_damaged(tmp_path):
    """A shard whose first episode is damaged, with what somebody has added to it."""
    rng = np.random.default_rng(0)
    path = tmp_path / "shard-00000.h5"
    write_shard(path, [make_episode(rng, 1000), make_episode(rng, 1000)], ATTRS, [4, 5])
    with h5py.File(path, "a") as file:
        file["notes/of_mine"] = np.arange(2)
        file["ep_language"] = ["push", "pull"]
        file.attrs["offset"], file.attrs["operator"] = np.arange(3.0), "Anna"
    flip_a_byte_of(path, "rgb")
    return path


def test_repair_of_a_shard_with_more_than_ours(half_damaged):
    kept = half_damaged.read_bytes()
    repair(half_damaged.parent)
    dataset = RGBDDataset(half_damaged.parent)
    assert dataset.episode_indices.tolist() == [5] and not find_damage(half_damaged.parent)
    assert dataset.attrs["offset"].tolist() == [0, 1, 2] and dataset.attrs["operator"] == "Anna"
    assert (half_damaged.parent / "damaged" / half_damaged.name).read_bytes() == kept
    with h5py.File(half_damaged, "r") as file:
        assert "notes" not in file and "ep_language" not in file


@pytest.mark.parametrize(
    "step", ["data_collection.repair.write_shard", "data_collection.repair._copy_aside", "envs.files.os.replace"]
)
def test_a_repair_that_fails_or_is_killed_loses_nothing(half_damaged, monkeypatch, step):
    before = half_damaged.read_bytes()

    def fail(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(step, fail)
        repair(half_damaged.parent)
    assert half_damaged.read_bytes() == before and not list(half_damaged.parent.glob("*.tmp"))
    repair(half_damaged.parent)
    assert RGBDDataset(half_damaged.parent).episode_indices.tolist() == [5]


def test_repair_without_hard_links_copies(half_damaged, monkeypatch):
    before = half_damaged.read_bytes()

    def refuse(*_):
        raise OSError("no hard links here")

    monkeypatch.setattr("os.link", refuse)
    repair(half_damaged.parent)
    assert (half_damaged.parent / "damaged" / half_damaged.name).read_bytes() == before
    assert RGBDDataset(half_damaged.parent).episode_indices.tolist() == [5]


def test_repair_leaves_a_shard_alone_that_another_program_has_open(folder):
    before = sorted(folder.iterdir())
    with h5py.File(folder / "shard-00001.h5", "r+"):
        result = finish(start("inspect-dataset", [folder, "--repair", "--no-pictures"]))
    assert_one_line_error(result, "shard-00001.h5 cannot be read", "temporarily unavailable")
    assert sorted(folder.glob("[!.]*")) == [path for path in before if path.name[0] != "."]
    assert not find_damage(folder)


@pytest.mark.parametrize("command", ["collect-rollouts", "inspect-dataset", "import-dataset"])
def test_a_folder_that_is_none_of_ours_keeps_what_it_has(tmp_path, command):
    for name in ("shard.h5.tmp", "notes.tmp", "notes.txt.12.tmp"):
        (tmp_path / name).touch()
    if command != "inspect-dataset":
        (tmp_path / "shard-00000.h5").touch()
    there = sorted(path.name for path in tmp_path.iterdir())
    source = write_omnipush(tmp_path.parent / f"{tmp_path.name}-source")
    arguments = {
        "collect-rollouts": options(tmp_path),
        "inspect-dataset": [tmp_path, "--repair"],
        "import-dataset": ["--format", "omnipush", "--image-size", "16", source, tmp_path],
    }
    assert_one_line_error(call(command, arguments[command]), str(tmp_path))
    assert sorted(path.name for path in tmp_path.iterdir() if path.name != ".lock") == there


def test_only_our_own_leftovers_are_removed(folder):
    (folder / "work.tmp").mkdir()
    (folder / "work.12.tmp").mkdir()
    (folder / "notes.tmp").touch()
    (folder / "dataset.json.12.tmp").touch()
    assert repair(folder) == ["removed dataset.json.12.tmp, left by a killed writer"]
    code, _, err = call("collect-rollouts", options(folder, **{"ground-truth": True}))
    assert code == 0, err
    assert {"work.tmp", "work.12.tmp", "notes.tmp"} <= {path.name for path in folder.iterdir()}


def test_repair_waits_for_the_collector(folder, tmp_path):
    with locked(folder), pytest.raises(UsageError, match="another process is writing"):
        repair(folder)
    assert_one_line_error(call("inspect-dataset", [tmp_path / "nowhere", "--repair"]), "nowhere")


def test_missing_folder_and_unknown_flag(tmp_path):
    assert_one_line_error(call("inspect-dataset", [tmp_path / "nowhere"]), "nowhere", "collect-rollouts")
    code, _, err = call("inspect-dataset", [tmp_path, "--colour"])
    assert code == 2 and "--colour" in err and "Traceback" not in err


def test_moved_shares_count_episodes():
    scene = np.zeros((3 * 10, 24))
    slices = np.array([[0, 10], [10, 20], [20, 30]])
    scene[5:10, 1] = 0.1  # the drawer opens in the first episode
    scene[25:, 5] = 1.0  # the LED is lit in the third
    scene[:, 6] = np.repeat([0.1, 0.2, 0.3], 10)  # the red block lies elsewhere in each, and stays there
    scene[13:17, 14] = 0.05  # the blue block is lifted in the second
    shares = moved_shares(scene, slices)
    expected = {"drawer": 1 / 3, "led": 1 / 3, "block_blue": 1 / 3}
    assert shares == {name: pytest.approx(expected.get(name, 0.0), abs=1e-3) for name in shares}


def test_workspace_coverage_of_known_positions():
    workspace = np.array([[0.0, 0, 0], [0.5, 0.5, 0.5]])
    centres = (np.stack(np.meshgrid(*[np.arange(10)] * 3), axis=-1).reshape(-1, 3) + 0.5) * 0.05
    full = workspace_coverage(centres, workspace)
    assert full["share_of_cells_visited"] == 1 and full["evenness"] == pytest.approx(1)
    assert full["share_of_frames_inside"] == 1
    half = workspace_coverage(np.concatenate([centres[:250], centres[:250] + 9]), workspace)
    assert half["share_of_cells_visited"] == 0.25 and half["share_of_frames_inside"] == 0.5


def test_anothers_dataset_is_described_without_what_is_only_known_of_ours(tmp_path):
    episode = make_episode(np.random.default_rng(0), 4)
    episode["scene_obs"] = np.zeros((4, 3), np.float32)
    for number, env_id in enumerate(("lab/TabletopSort-v0", "lab/DexHandover-v0")):
        folder = tmp_path / str(number)
        folder.mkdir()
        attrs = {**ATTRS, "env_id": env_id, "workspace": [0.3, 0.4]}
        write_shard(folder / "shard-00000.h5", [episode], attrs, [0])
        assert not {"workspace", "moved", "goals"} & describe(RGBDDataset(folder)).keys()


def test_goals_of_a_hand_are_counted_where_they_change():
    def pose(degrees):
        half = np.radians(degrees) / 2
        return [*HOME, np.cos(half), 0, 0, np.sin(half)]

    rows = [(0, 60), (40, 60), (55, 60)]  # cube and goal, degrees: reached, and the next goal is given
    rows += [(70, 100), (92, 100), (80, 20), (70, 20)]  # reached in two steps; the third goal is not
    rows += [(0, 30), (10, 30)]  # the next episode
    scene_obs = np.array([pose(cube) + pose(goal) for cube, goal in rows], np.float32)
    scene_obs[-1, 2] = 0.05  # dropped
    found = goal_statistics(scene_obs, np.array([[0, 7], [7, 9]]))
    assert found == {
        "given": 4,
        "reached": 0.5,
        "median_steps_to_reach": 2.0,
        "median_degrees_at_start": 52.5,  # 60, 45, 72, 30
        "median_degrees_at_end": 14.0,  # 5, 8, 50, 20
        "episodes_dropped": 0.5,
    }
