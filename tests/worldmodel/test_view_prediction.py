"""`view-prediction`: the picture is there and shows the prediction; mistakes are one line."""

import imageio.v3 as imageio
import numpy as np
import pytest

from envs.command import run
from worldmodel.checkpoint import save_model
from worldmodel.view_prediction import ViewOptions, main


@pytest.fixture
def model_folder(make_model, tmp_path):
    save_model(make_model(), tmp_path / "model", {})
    return tmp_path / "model"


def view(data, model, out, *more):
    clip = ("--context", "2", "--predicted", "2", "--scale", "1")
    run(ViewOptions, main, ["--data", str(data), "--model", str(model), "--out", str(out), *clip, *more])


def test_picture_has_a_row_a_kind_and_a_column_a_step(tiny_dataset, model_folder, tmp_path):
    view(tiny_dataset, model_folder, tmp_path / "picture.png")
    picture = imageio.imread(tmp_path / "picture.png")
    assert picture.shape == (9 * (16 + 2) - 2, 2 * (24 + 2) - 2, 3)
    assert np.ptp(picture[:16, :24]) > 50  # the true frame


def test_start_decides_the_clip(tiny_dataset, model_folder, tmp_path):
    pictures = []
    for start in (0, 5):
        view(tiny_dataset, model_folder, tmp_path / "picture.png", "--start", str(start))
        pictures.append(imageio.imread(tmp_path / "picture.png"))
    assert (pictures[0] != pictures[1]).any()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--episode", "99"), "--episode is 99"),
        (("--episode", "-1"), "--episode is -1"),
        (("--start", "1000"), "--start is 1000"),
        (("--predicted", "1000"), "no episode is"),
        (("--out", "picture.jpg"), "picture.jpg"),
        (("--model", "/nowhere"), "/nowhere"),
        (("--data", "/nowhere"), "/nowhere"),
    ],
)
def test_mistakes_are_one_line(tiny_dataset, model_folder, tmp_path, capsys, arguments, message):
    with pytest.raises(SystemExit) as end:
        view(tiny_dataset, model_folder, tmp_path / "picture.png", *arguments)
    error = capsys.readouterr().err
    assert end.value.code == 2 and message in error and error.count("\n") == 1


def test_data_of_another_camera_is_refused(write_dataset, camera_of, model_folder, tmp_path, capsys):
    data = write_dataset(tmp_path / "wide", (16,), camera_of(32, 16))
    with pytest.raises(SystemExit):
        view(data, model_folder, tmp_path / "picture.png")
    assert "image size (16, 32)" in capsys.readouterr().err
