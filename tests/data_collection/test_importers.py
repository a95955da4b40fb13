"""What stands in the public layouts arrives in the dataset: pictures, camera, actions and states."""

import json
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from commands import assert_one_line_error, call
from hypothesis import given
from hypothesis import strategies as st
from layouts import change_frame, write_calvin, write_dexhand, write_intrinsics, write_omnipush
from PIL import Image

from data_collection.actions import aggregate_actions
from data_collection.dataset import RGBDDataset
from data_collection.importers import SourceOptions, open_source
from data_collection.importers.images import average_colour, nearest_depth, resize_camera
from envs.camera import CameraModel
from envs.errors import UsageError
from worldmodel.train import parse_options
from worldmodel.training_data import open_data


def imported(form, source, folder, *options):
    """Import with one process and open the result; nothing may be damaged."""
    code, out, err = call("import-dataset", ["--format", form, source, folder, "--workers", "1", *options])
    assert code == 0 and "0 damaged" in out, out + err
    return RGBDDataset(folder)


def block_means(rgb, size):
    """Mean over each of size x size blocks."""
    step = len(rgb) // size
    return rgb.reshape(size, step, size, step, 3).mean(axis=(1, 3))


@pytest.fixture(scope="module")
def calvin(tmp_path_factory):
    root = tmp_path_factory.mktemp("calvin") / "task_D_D"
    return write_calvin(root)


def test_calvin_arrives(calvin, tmp_path):
    dataset = imported("calvin", calvin.parent, tmp_path / "data", "--image-size", "8")
    assert dataset.episode_lengths.tolist() == [25, 15]
    assert dataset.attrs["env_id"] == "calvin/D" and dataset.attrs["control_rate"] == 30
    episode = dataset.episode(1)
    for row in range(15):
        with np.load(calvin / f"episode_{30 + row:07d}.npz") as frame:
            np.testing.assert_allclose(episode["rgb"][row], block_means(frame["rgb_static"], 8), atol=1.01)
            expected = frame["depth_static"][2::5, 2::5]  # the middle of each 5x5 block
            np.testing.assert_allclose(dataset.depth_metres(episode["depth"][row]), expected, atol=3e-5)
            np.testing.assert_array_equal(episode["proprio"][row], frame["robot_obs"].astype(np.float32))
            np.testing.assert_array_equal(episode["scene_obs"][row], frame["scene_obs"].astype(np.float32))
            np.testing.assert_array_equal(episode["state"][row], np.r_[frame["robot_obs"], frame["scene_obs"]])
            action = frame["rel_actions"] if row < 14 else np.zeros(7)
            np.testing.assert_array_equal(episode["action"][row], action.astype(np.float32))


def test_calvin_camera_is_the_published_one(tmp_path):
    folder = write_calvin(tmp_path / "task_ABC_D", [(0, 2)], "validation", size=200)
    camera = imported("calvin", folder, tmp_path / "data").camera
    assert (camera.width, camera.height, camera.near, camera.far) == (64, 64, 3.7, 6.3)
    assert camera.K[0, 0] == pytest.approx(365.8, abs=0.05) and camera.K[1, 1] == pytest.approx(camera.K[0, 0])
    assert camera.K[0, 2] == camera.K[1, 2] == pytest.approx(31.5)
    eye, target = np.array([2.871, -2.167, 2.555]), np.array([-0.026, -0.030, 0.392])
    np.testing.assert_allclose(camera.world_T_camera[:3, 3], eye, atol=1e-3)
    there = camera.to_camera(target)
    assert there[2] == pytest.approx(4.20, abs=0.01)  # metres
    np.testing.assert_allclose(camera.project(there), [31.5, 31.5], atol=0.2)
    above = camera.project(camera.to_camera(target + np.array([0, 0, 0.1])))
    robot = camera.project(camera.to_camera(np.array([-0.34, -0.46, 0.44])))  # the arm stands to the left
    assert above[1] < 31.5 - 6 and abs(above[0] - 31.5) < 5 and robot[0] < 31.5


def test_calvin_scene_from_folder_config_or_option(tmp_path):
    validation = write_calvin(tmp_path / "task_ABC_D", [(0, 2)], "validation")
    other = write_calvin(tmp_path / "mine", [(0, 2)], "training", scene="calvin_scene_B")
    size = ("--image-size", "8")
    assert imported("calvin", validation, tmp_path / "0", *size).attrs["env_id"] == "calvin/D"
    assert imported("calvin", other, tmp_path / "1", *size).attrs["env_id"] == "calvin/B"
    assert imported("calvin", other, tmp_path / "2", *size, "--scene", "C").attrs["env_id"] == "calvin/C"


def test_a_depth_range_that_is_none_is_not_blamed_on_the_config(calvin, tmp_path):
    arguments = ["--format", "calvin", calvin, tmp_path / "data", "--near", "7"]
    code, _, err = call("import-dataset", arguments)
    assert code == 2 and "near=7.0, far=6.3" in err and "merged_config" not in err


def test_long_play_is_cut_without_losing_an_action(calvin, tmp_path):
    dataset = imported("calvin", calvin, tmp_path / "data", "--image-size", "8", "--steps", "10")
    assert dataset.episode_lengths.tolist() == [9, 9, 9, 8, 8]
    for first, last, numbers in ((0, 24, (0, 1, 2)), (30, 44, (3, 4))):
        actions = [dataset.episode(number)["action"][:-1] for number in numbers]
        frames = [np.load(calvin / f"episode_{i:07d}.npz")["rel_actions"] for i in range(first, last)]
        np.testing.assert_array_equal(np.concatenate(actions), np.array(frames, np.float32))
    before, after = dataset.episode(0), dataset.episode(1)
    np.testing.assert_array_equal(before["rgb"][-1], after["rgb"][0])


def test_calvin_actions_add_up_over_a_gap(calvin, tmp_path):
    dataset = imported("calvin", calvin, tmp_path / "data", "--image-size", "8")
    actions = dataset.episode(0)["action"][3:6].astype(float)
    total = aggregate_actions(actions, dataset.attrs["action_aggregation"], dataset.attrs["action_scale"])
    place, angles = np.zeros(3), np.zeros(3)  # of the hand: differences from frame to frame
    for action in actions:
        place, angles = place + 0.02 * action[:3], angles + 0.05 * action[3:6]
    np.testing.assert_allclose(0.02 * total[:3], place, atol=1e-9)
    np.testing.assert_allclose(0.05 * total[3:6], angles, atol=1e-9)
    assert total[6] == actions[-1, 6] != actions[0, 6]


def test_calvin_episodes_of_another_table(calvin, tmp_path):
    np.save(tmp_path / "ids.npy", np.array([[32, 40]]))
    dataset = imported("calvin", calvin, tmp_path / "data", "--image-size", "8", "--ids", tmp_path / "ids.npy")
    assert dataset.episode_lengths.tolist() == [9]


def test_dexhand_arrives(tmp_path):
    root = write_dexhand(tmp_path / "dexhand", episodes=11, frames=4)
    dataset = imported("dexhand", root, tmp_path / "data", "--image-size", "20")
    assert dataset.episodes == 11 and dataset.attrs["action_aggregation"] == ["sum"] * 24
    assert (dataset.camera.near, dataset.camera.far) == (0.8264, 1.3312) and dataset.attrs["control_rate"] == 25
    expected = [[24, 0, 9.25], [0, 22, 10.25], [0, 0, 1]]  # half of 40 pixels: (19 + 0.5) / 2 - 0.5
    np.testing.assert_allclose(dataset.camera.K, expected)
    np.testing.assert_array_equal(dataset.camera.world_T_camera, np.eye(4))
    for number in (0, 10):  # not in the order of the alphabet
        episode, folder = dataset.episode(number), root / "training" / str(number)
        np.testing.assert_allclose(episode["proprio"][2], np.loadtxt(folder / "joints2.txt"), atol=1e-6)
        np.testing.assert_allclose(episode["action"][:3], 0.01, atol=1e-6)
        assert not episode["action"][3].any()
        raw = np.asarray(Image.open(folder / "depthsub3.png")).astype(float)
        np.testing.assert_allclose(dataset.depth_metres(episode["depth"][3]), raw[1::2, 1::2] / 65535 * 10, atol=1e-5)
        colour = np.asarray(Image.open(folder / "rgbsub3.png"))
        np.testing.assert_allclose(episode["rgb"][3], block_means(colour, 20), atol=1.01)


def test_omnipush_arrives(tmp_path):
    root = write_omnipush(tmp_path / "omnipush")
    dataset = imported("omnipush", root, tmp_path / "data", "--image-size", "16")
    assert dataset.episode_lengths.tolist() == [12] * 4 and dataset.attrs["action_aggregation"] == ["last"] * 3
    assert (dataset.camera.near, dataset.camera.far) == (0.35, 1.2)
    episode, tip = dataset.episode(3), np.load(root / "train" / "1a2a3a4a" / "1" / "actions.npy")
    np.testing.assert_allclose(episode["proprio"], tip, atol=1e-6)
    np.testing.assert_allclose(episode["action"][:-1], tip[1:], atol=1e-6)  # where the tip is in the next frame
    total = aggregate_actions(episode["action"][2:5], dataset.attrs["action_aggregation"])
    np.testing.assert_allclose(total, tip[5], atol=1e-6)
    depth = dataset.depth_metres(episode["depth"])
    assert depth.min() == pytest.approx(1.0, abs=1e-4) and depth.max() == pytest.approx(1.1, abs=1e-4)


def test_a_test_split_is_not_trained_on(tmp_path):
    for split, refused in (("test", True), ("train", False)):
        root = write_omnipush(tmp_path / split, split=split)
        dataset = imported("omnipush", root, tmp_path / f"{split}-data", "--image-size", "16")
        assert dataset.attrs["env_kwargs"] == {"split": split}
        options = parse_options(["--preset", "tiny", "--data", str(dataset.path), "--out", str(tmp_path / "run")])
        with pytest.raises(UsageError, match="for testing only") if refused else nullcontext():
            open_data(options)


@pytest.mark.parametrize("path", [".", "../test", "object/..", "link"])
def test_a_split_keeps_its_name_however_its_folder_is_named(tmp_path, monkeypatch, path):
    root = write_omnipush(tmp_path / "omnipush", objects=("object",), pushes=1, split="test")
    (root / "test" / "link").symlink_to(root / "test")
    monkeypatch.chdir(root / "test")
    source = open_source("omnipush", SourceOptions(Path(path), image_size=16))
    assert source.split == "test"
    assert not source.notes  # the intrinsics are beside the split
    training = write_calvin(tmp_path / "task_ABC_D", [(0, 2)], "training")
    (training / "object").mkdir()
    (training / "link").symlink_to(training)
    monkeypatch.chdir(training)
    source = open_source("calvin", SourceOptions(Path(path.replace("test", "training")), image_size=16))
    assert (source.split, source.env_id) == ("training", "calvin/ABC")


def test_omnipush_without_intrinsics_takes_the_published_ones(tmp_path):
    root = write_omnipush(tmp_path / "omnipush", pushes=1, intrinsics=False)
    dataset = imported("omnipush", root, tmp_path / "data", "--image-size", "48")
    np.testing.assert_allclose(dataset.camera.K[:2, :2], np.diag([928.70, 928.17]) / 15)
    np.testing.assert_allclose(dataset.camera.K[:2, 2], (np.array([377.5, 356.48]) + 0.5) / 15 - 0.5)
    assert "published intrinsics" in json.loads((tmp_path / "data" / "import.json").read_text())["notes"][0]


def test_depth_range_and_scale_are_options(calvin, tmp_path):
    folder = write_calvin(tmp_path / "task_D_D", [(0, 2)])
    for number in range(3):
        with np.load(folder / f"episode_{number:07d}.npz") as frame:
            doubled = frame["depth_static"] * 2
        change_frame(folder, number, depth_static=doubled)
    options = ("--image-size", "8", "--depth-scale", "0.5", "--near", "4", "--far", "4.5")
    dataset = imported("calvin", folder, tmp_path / "data", *options)
    depth = dataset.depth_metres(dataset.episode(0)["depth"])
    assert dataset.camera.near == 4 and depth.min() == pytest.approx(4.1, abs=1e-4) and depth.max() == 4.5


@given(st.integers(8, 60), st.integers(8, 60), st.integers(1, 60), st.integers(1, 60))
def test_what_a_resized_camera_sees_is_where_the_resized_picture_has_it(height, width, rows, columns):
    rows, columns = min(rows, height), min(columns, width)
    K = np.array([[50.0, 0, width / 3], [0, 60.0, height / 2], [0, 0, 1]])
    camera = CameraModel(width, height, K, np.eye(4), 0.5, 2.0)
    small = resize_camera(camera, rows, columns)
    point = np.array([0.03, -0.02, 1.0])
    u, v = camera.project(point)
    # The picture's borders lie half a pixel outside of the outer pixel centres, in both sizes.
    share = np.array([(u + 0.5) / width, (v + 0.5) / height])
    np.testing.assert_allclose(small.project(point), share * [columns, rows] - 0.5, atol=1e-9)
    ramp = np.arange(height, dtype=np.float32)[:, None].repeat(width, 1)
    centres = (np.arange(rows) + 0.5) * height / rows - 0.5
    assert np.abs(nearest_depth(ramp, rows, columns)[:, 0] - centres).max() <= 0.5 + 1e-6


def test_colour_keeps_its_mean_and_depth_its_values():
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (200, 200, 3), np.uint8)
    small = average_colour(rgb, 64, 64)
    assert small.shape == (64, 64, 3) and abs(small.mean() - rgb.mean()) < 0.5 and small.std() < rgb.std() / 2
    depth = rng.choice([1.0, 2.0], (200, 200))
    assert set(np.unique(nearest_depth(depth, 64, 64))) == {1.0, 2.0}
    with pytest.raises(UsageError, match="--image-size 300 is more than the 200x200"):
        resize_camera(CameraModel.from_fovy(200, 200, 10, np.eye(4), 1, 2), 300, 300)


def test_a_source_that_is_not_one(tmp_path, calvin):
    out = tmp_path / "data"
    for form, source, words in (
        ("calvin", tmp_path / "nowhere", ("nowhere", "no folder")),
        ("calvin", tmp_path, ("ep_start_end_ids.npy", "--ids")),
        ("dexhand", tmp_path, ("rgbsub", "colour-only")),
        ("dexhand", calvin, ("rgbsub",)),
    ):
        assert_one_line_error(call("import-dataset", ["--format", form, source, out]), *words)
        assert not out.exists()
    folder = write_calvin(tmp_path / "task_D_D", [(0, 2)])
    config = folder / ".hydra" / "merged_config.yaml"
    text = config.read_text()
    for wrong, words in (
        (text.replace("fov: 10", "fow: 10"), ("fov",)),
        ("a: [", ("merged_config",)),
        (None, ("camera",)),
    ):
        config.unlink() if wrong is None else config.write_text(wrong)
        assert_one_line_error(call("import-dataset", ["--format", "calvin", folder, out]), *words)
    root = write_dexhand(tmp_path / "dexhand", 1, 3)
    (root / "intrinsics.txt").write_text("fx fy cx\n1 2 3\n")
    assert_one_line_error(call("import-dataset", ["--format", "dexhand", root, out]), "intrinsics.txt", "cy")
    (root / "intrinsics.txt").unlink()
    assert_one_line_error(call("import-dataset", ["--format", "dexhand", root, out]), "no intrinsics.txt")
    write_intrinsics(root, 40)
    arguments = ["--format", "dexhand", root, out, "--split", "test"]
    assert_one_line_error(call("import-dataset", arguments), "'test'", "training")
