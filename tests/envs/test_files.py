"""Files are whole or not there."""

import os

import imageio.v3 as iio
import pytest

from envs import check_rendering
from envs.files import written_aside
from envs.planar_push import pictures as pushes
from envs.tabletop import pictures as scenes


def test_what_is_no_file_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with written_aside(tmp_path / "pipe") as aside:
        assert aside == tmp_path / "pipe"
    assert [path.name for path in tmp_path.iterdir()] == ["pipe"] and (tmp_path / "pipe").is_fifo()


def check(folder):
    config = check_rendering.Config(size=32, supersample=1, seconds=0.01, json=folder / "found.json")
    check_rendering.main(config)


def draw_scenes(folder):
    scenes.main(scenes.Config(folder, size=16))


def draw_pushes(folder):
    pushes.main(pushes.Config(folder, size=16))


@pytest.mark.parametrize("write", [check, draw_scenes, draw_pushes])
def test_an_old_file_is_replaced_or_left(tmp_path, monkeypatch, write):
    write(tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert before and not [name for name in before if name.endswith(".tmp")]

    def fail(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", fail)  # a full disk may be told as late as here
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert all(iio.imread(tmp_path / name).ptp() > 0 for name in before if name.endswith(".png"))
