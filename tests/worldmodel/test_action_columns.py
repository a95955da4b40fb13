"""What each way of telling actions explains of the joints' motion."""

import h5py
import numpy as np
import pytest

from data_collection.dataset import RGBDDataset
from envs.errors import UsageError
from worldmodel import train
from worldmodel.action_columns import Config, explained, main
from worldmodel.clips import actions_followed

COLUMNS = ["action", "action_change", "action_followed"]


def joints_that_follow(folder):
    """Give a dataset of absolute commands joints that go where a soft servo takes them."""
    dataset = RGBDDataset(folder)
    followed = actions_followed(dataset.load("action"), dataset.episode_slices, dataset.attrs["control_rate"])
    deltas = followed @ np.random.default_rng(0).normal(size=(followed.shape[1], 3))
    done = 0
    for shard in sorted(folder.glob("*.h5")):
        with h5py.File(shard, "r+") as file:
            rows = len(file["action"])
            file["joint_delta"] = deltas[done : done + rows].astype(np.float32)
            done += rows
    return folder


@pytest.fixture
def servoed(tmp_path, write_dataset):
    return joints_that_follow(write_dataset(tmp_path, [40] * 8, action_aggregation=["last"] * 7))


@pytest.mark.parametrize("gap", [1, 3])
def test_what_the_joints_follow_explains_them(servoed, gap):
    shares = explained(RGBDDataset(servoed), gap, COLUMNS)
    assert shares["action_followed"] == pytest.approx(1.0, abs=1e-3)
    assert shares["action"] < 0.9 and shares["action_change"] < 0.9


def test_a_line_a_column(servoed, capsys):
    main(Config(servoed, gap=(2,)))
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["column", *COLUMNS] and lines[-1].endswith(" 1.00")


def test_a_model_is_told_what_the_joints_follow_unless_asked_otherwise(servoed, tmp_path):
    told = ["--preset", "tiny", "--data", str(servoed), "--out", str(tmp_path / "run"), "--steps", "2"]
    for _ in range(2):  # the second goes on, and has nothing left to do
        train.main(train.parse_options(told))
    for config in ("config.json", "model/config.json"):
        assert '"action_column": "action_followed"' in (tmp_path / "run" / config).read_text()
    with pytest.raises(UsageError, match="action_column = action_followed, not action;"):
        train.main(train.parse_options([*told, "--action-column", "action"]))


def test_commands_that_are_changes_are_refused(tmp_path, write_dataset):
    with pytest.raises(UsageError, match="not all absolute: there is only one way"):
        main(Config(write_dataset(tmp_path, [12, 12])))


def test_one_episode_is_too_few(tmp_path, write_dataset):
    folder = joints_that_follow(write_dataset(tmp_path, [12], action_aggregation=["last"] * 7))
    with pytest.raises(UsageError, match="1 episode; some are to be fitted"):
        explained(RGBDDataset(folder), 1, COLUMNS)
    with pytest.raises(UsageError, match="frame gaps of at least 1"):
        Config(folder, gap=(0,))
