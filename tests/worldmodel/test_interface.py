"""What may differ between where a model was made and where it is used, and what may not."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from data_collection.dataset import RGBDDataset
from envs.camera import CameraModel
from envs.errors import UsageError
from worldmodel.interface import Interface, check_fits, mismatch


def make_interface(fovy=40.0, width=24, near=1.0, pose=None, **changes):
    camera = CameraModel.from_fovy(width, 16, fovy, np.eye(4) if pose is None else pose, near, 3.0)
    made = Interface("some/Squares-v0", camera, ("sum", "sum", "last"), (0.02, 0.02, 1.0), 30.0)
    return replace(made, **changes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"width": 32}, "image size (16, 32), not (16, 24)"),
        ({"fovy": 10.0}, "intrinsics fx, fy, cx, cy (91."),
        ({"near": 0.5}, "depth range (0.5, 3.0), not (1.0, 3.0)"),
        ({"action_scale": (0.02, 1.0), "action_aggregation": ("sum", "last")}, "action size 2, not 3"),
        ({"action_scale": (0.02, 0.01, 1.0)}, "action scale (0.02, 0.01, 1.0), not (0.02, 0.02, 1.0)"),
        ({"action_aggregation": ("last", "sum", "last")}, "action aggregation ('last', 'sum', 'last')"),
    ],
)
def test_another_camera_or_other_actions_do_not_do(changes, words):
    difference = mismatch(make_interface(**changes), make_interface())
    assert difference is not None and words in difference


def test_another_scene_seen_from_elsewhere_does():
    pose = np.eye(4)
    pose[:3, 3] = 1
    assert mismatch(make_interface(pose=pose, env_id="some/Circles-v0", control_rate=10.0), make_interface()) is None
    assert mismatch(make_interface(near=1.0005), make_interface()) is None  # as good as the same


def test_a_model_is_held_against_the_column_that_it_takes(make_model, write_dataset, tmp_path):
    model, folder = make_model(), write_dataset(tmp_path / "data", [12, 12])
    assert check_fits("model", model, RGBDDataset(folder)) == []
    other = replace(model.context, env_id="others/Squares-v0", control_rate=10.0)
    model.context, before = other, model.context
    assert check_fits("model", model, RGBDDataset(folder)) == [
        f"{folder} has 30 control steps a second, model was trained on 10",
        f"{folder} comes from some/Squares-v0, model was trained on others/Squares-v0",
    ]
    model.context = before
    joints = {"action_column": "joint_delta", "action_aggregation": ("sum",) * 5, "action_scale": (1.0,) * 5}
    model.context = replace(model.context, **joints)
    with pytest.raises(UsageError, match="no column 'joint_delta'"):
        check_fits("model", model, RGBDDataset(folder))
    for shard in folder.glob("*.h5"):
        with h5py.File(shard, "r+") as file:
            file["joint_delta"] = np.zeros((len(file["action"]), 5), np.float32)
    assert check_fits("model", model, RGBDDataset(folder)) == []
    model.context = replace(model.context, action_aggregation=("sum",) * 4, action_scale=(1.0,) * 4)
    with pytest.raises(UsageError, match="has action size 5, not 4, which model was trained on"):
        check_fits("model", model, RGBDDataset(folder))


def test_a_model_of_absolute_actions_does_not_fit_others(make_model, write_dataset, tmp_path):
    model, folder = make_model(), write_dataset(tmp_path / "data", [12, 12])
    model.context = replace(model.context, action_column="action_followed")
    with pytest.raises(UsageError, match=r"^hand was trained on absolute actions.* has others; give data of its kind"):
        check_fits("hand", model, RGBDDataset(folder))
