"""What is wrong with somebody's recordings is named, an episode a line, and costs that episode only."""

import json

import numpy as np
import pytest
from commands import call
from layouts import calvin_frame, change_frame, write_calvin, write_dexhand, write_omnipush, write_png

from data_collection.dataset import RGBDDataset


def report_of(form, source, folder, *options):
    """Import, and give the report: {episode: (status, its lines)}."""
    size = "8" if form == "calvin" else "20"
    arguments = ["--format", form, source, folder, "--workers", "1", "--image-size", size, *options]
    code, out, err = call("import-dataset", arguments)
    assert code == 0, err
    report = json.loads((folder / "import.json").read_text())
    damaged = [entry for entry in report["episodes"] if entry["status"] == "damaged"]
    assert report["damaged"] == len(damaged) and report["complete"]
    for entry in damaged:
        assert entry["report"][0] in out and entry["report"][0] in err and "\n" not in entry["report"][0]
    assert RGBDDataset(folder).episodes == report["imported"]
    return {entry["episode"]: (entry["status"], " ".join(entry["report"])) for entry in report["episodes"]}


DEPTH = calvin_frame(4, np.random.default_rng(0))["depth_static"]
Z_BUFFER = (10 * (DEPTH - 0.01) / (DEPTH * (10 - 0.01))).astype(np.float32)
NAN = np.where(np.arange(40) == 3, np.nan, DEPTH).astype(np.float32)
ACTION = calvin_frame(4, np.random.default_rng(0))["rel_actions"]
ROBOT = calvin_frame(4, np.random.default_rng(0))["robot_obs"]
CALVIN = {
    "no key": ({"depth_static": None}, "no depth_static in episode_0000004.npz"),
    "millimetres as integers": ({"depth_static": (DEPTH * 1000).astype(np.uint16)}, "depth_static of episode_0000004"),
    "colour of another size": ({"rgb_static": np.zeros((20, 20, 3), np.uint8)}, "rgb_static of episode_0000004"),
    "colour as floats": ({"rgb_static": np.zeros((40, 40, 3), np.float32)}, "not uint8"),
    "NaN in depth": ({"depth_static": NAN}, "not finite"),
    "NaN in an action": (
        {"rel_actions": ACTION * np.nan},
        "rel_actions of episode_0000004.npz has values that are not",
    ),
    "six numbers": ({"rel_actions": ACTION[:6]}, "rel_actions of episode_0000004.npz is float64 (6,)"),
    "a half-open gripper": ({"rel_actions": np.r_[ACTION[:6], 0.04]}, "gripper at 0.04"),
    "one frame without depth": ({"depth_static": DEPTH * 0}, "no pixel of frame 1 has a depth"),
    "one frame doubled": ({"depth_static": DEPTH * 2}, "doubled: median depth 9.2 m in frame 1"),
    "objects": ({"scene_obs": np.array([{"a": 1}] * 24)}, "episode_0000004.npz does not unpack"),
}


@pytest.mark.parametrize("kind", CALVIN)
def test_a_damaged_calvin_frame_costs_its_episode(tmp_path, kind):
    changed, words = CALVIN[kind]
    folder = write_calvin(tmp_path / "task_D_D", [(0, 2), (3, 5), (6, 8)])
    change_frame(folder, 4, **changed)
    report = report_of("calvin", folder, tmp_path / "data")
    assert report[1][0] == "damaged" and words in report[1][1], report[1]
    assert report[0] == report[2] == ("imported", "")


def test_damaged_calvin_files(tmp_path):
    folder = write_calvin(tmp_path / "task_D_D", [(0, 2), (3, 5), (6, 8), (9, 11), (20, 20), (30, 32)])
    (folder / "episode_0000001.npz").unlink()
    half = folder / "episode_0000004.npz"
    half.write_bytes(half.read_bytes()[:2000])
    unknown = folder / "episode_0000010.npz"  # its directory of files says that they are packed in method 99
    content = unknown.read_bytes()
    place = content.index(b"PK\x01\x02") + 10
    unknown.write_bytes(content[:place] + bytes([99]) + content[place + 1 :])
    np.save(folder / "other.npy", np.zeros(3))
    (folder / "other.npy").rename(folder / "episode_0000007.npz")
    np.save(folder / "ep_lens.npy", np.array([3, 3, 3, 4, 1, 3]))
    report = report_of("calvin", folder, tmp_path / "data")
    assert report[0] == ("damaged", "episode_0000001.npz is missing")
    assert "episode_0000004.npz does not unpack" in report[1][1]
    assert "episode_0000007.npz is no npz" in report[2][1]
    assert "episode_0000010.npz does not unpack (NotImplementedError)" in report[3][1]
    assert report[5] == ("imported", "") and report[4] == ("damaged", "1 frames are no episode")
    assert "ep_lens.npy does not follow" in json.loads((tmp_path / "data" / "import.json").read_text())["notes"][0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda depth: depth * 2,
            "doubled: median depth 9.2 m in frame 0 where about 4.20 m is expected; read it with --depth-scale 0.5",
        ),
        (
            lambda depth: depth / 2,
            "halved: median depth 2.3 m in frame 0 where about 4.20 m is expected; read it with --depth-scale 2",
        ),
        (lambda depth: depth * 1000, "in millimetres"),
        (lambda depth: Z_BUFFER, "raw z-buffer"),
        (lambda depth: depth * 0 + 0.1, "median depth 0.1 m"),
        (lambda depth: depth * 0, "no pixel of frame 0 has a depth"),
    ],
)
def test_wrong_units_of_calvin_depth(tmp_path, change, words):
    folder = write_calvin(tmp_path / "task_D_D", [(0, 2), (3, 5)])
    for number in (3, 4, 5):
        change_frame(folder, number, depth_static=change(DEPTH).astype(np.float32))
    report = report_of("calvin", folder, tmp_path / "data")
    assert report[0] == ("imported", "") and report[1][0] == "damaged" and words in report[1][1], report[1]


def test_notes_on_calvin_actions(tmp_path):
    folder = write_calvin(tmp_path / "task_D_D", [(0, 9), (10, 19), (20, 29), (30, 39)])
    for number in range(10, 20):
        change_frame(folder, number, rel_actions=np.r_[0.004, 0, 0, 0, 0, 0, 1])  # metres
    change_frame(folder, 21, robot_obs=np.r_[ROBOT[:14], 0.0])
    change_frame(folder, 22, rel_actions=np.r_[0.2, 0, 0, 0, 0, -3, 1])
    for number in range(30, 33):
        change_frame(folder, number, rel_actions=np.r_[0.2, 0, 0, 0, 0, -1, 1])
    report = report_of("calvin", folder, tmp_path / "data")
    assert report[0] == ("imported", "")
    assert report[1][0] == "imported" and "moves the arm by 1 m, not by 0.02 m" in report[1][1]
    assert report[2][0] == "imported" and "relative actions up to 3" in report[2][1]
    assert "robot_obs has the gripper at 0 (1 of 10)" in report[2][1]
    assert report[3][0] == "imported" and "33% of the relative actions are clipped to -1 or 1" in report[3][1]


def test_damaged_dexhand(tmp_path):
    root = write_dexhand(tmp_path / "dexhand", episodes=12, frames=25)
    folders = [root / "training" / str(i) for i in range(12)]
    picture = np.full((40, 40), int(1.1 / 10 * 65535), np.uint16)
    (folders[1] / "joints3.txt").unlink()
    (folders[2] / "depthsub24.png").unlink()
    (folders[3] / "joints3.txt").write_text("1 2 3")
    (folders[4] / "joints3.txt").write_text(" ".join(["nan"] * 24))
    write_png(folders[5] / "depthsub3.png", (picture // 256).astype(np.uint8))
    write_png(folders[6] / "rgbsub3.png", np.zeros((40, 40), np.uint8))
    (folders[7] / "rgbsub3.png").write_bytes((folders[7] / "rgbsub3.png").read_bytes()[:200])
    for i in range(25):
        write_png(folders[8] / f"depthsub{i}.png", picture * 2)
        write_png(folders[9] / f"depthsub{i}.png", (picture * 0 + 1100))  # millimetres
        (folders[11] / f"joints{i}.txt").write_text(" ".join(["57.3"] * 24))
    for path in folders[10].iterdir():
        path.unlink()
    report = report_of("dexhand", root, tmp_path / "data")
    assert report[0] == ("imported", "")
    for number, words in {
        1: "joints3 is missing (25 rgbsub, 25 depthsub, 24 joints)",
        2: "depthsub24 is missing",
        3: "joints3.txt has 3 numbers, not 24",
        4: "joints3.txt has values that are not finite",
        5: "depthsub3.png is uint8",
        6: "rgbsub3.png is uint8 (40, 40)",
        7: "rgbsub3.png does not unpack",
        8: "depth is doubled",
        9: "in millimetres: median depth 0.1678 m in frame 0 where about 1.08 m is expected",
        10: "0 frames are no episode",
    }.items():
        assert report[number][0] == "damaged" and words in report[number][1], report[number]
    assert report[11][0] == "imported" and "degrees" in report[11][1]


def test_odd_frame_counts_are_noted(tmp_path):
    hand, push = write_dexhand(tmp_path / "dexhand", 1, 24), write_omnipush(tmp_path / "omnipush", ["1a1a1a1a"], 1, 13)
    assert report_of("dexhand", hand, tmp_path / "0")[0] == ("imported", "24 frames, not 25")
    assert report_of("omnipush", push, tmp_path / "1")[0] == ("imported", "13 frames, not a multiple of 12")


def test_damaged_omnipush(tmp_path):
    root = write_omnipush(tmp_path / "omnipush", ["1a1a1a1a"], pushes=8)
    pushes = [root / "train" / "1a1a1a1a" / str(i) for i in range(8)]
    (pushes[1] / "actions.npy").unlink()
    np.save(pushes[2] / "actions.npy", np.zeros((11, 3)))
    np.save(pushes[3] / "actions.npy", np.full((12, 3), np.nan))
    np.save(pushes[4] / "actions.npy", np.full((12, 3), 300.0))
    for i in range(12):
        write_png(pushes[5] / f"depthsub{i}.png", np.full((48, 48), 1100, np.uint16))
    for i in range(12):
        write_png(pushes[6] / f"depthsub{i}.png", np.full((48, 48), 65535, np.uint16))  # where doubling ends
    actions = pushes[7] / "actions.npy"
    actions.write_bytes(actions.read_bytes().replace(b"{'descr'", b"{'descr("))
    report = report_of("omnipush", root, tmp_path / "data")
    assert report[6][0] == "damaged" and "at the end of its scale: doubled?" in report[6][1]
    assert report[7][0] == "damaged" and "actions.npy does not unpack" in report[7][1]
    assert report[0] == ("imported", "") and report[1] == ("damaged", "actions.npy is missing")
    assert report[2] == ("damaged", "actions.npy is float64 (11, 3), not float (12, 3)")
    assert report[3] == ("damaged", "actions.npy has values that are not finite")
    assert report[4][0] == "imported" and "millimetres" in report[4][1]
    assert report[5][0] == "damaged" and "--depth-scale 54.6125" in report[5][1]
