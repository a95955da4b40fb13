"""Films are whole, or not there."""

import functools

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest

from data_collection.video import write_video
from envs.errors import UsageError


def test_a_film_holds_every_picture_in_order(tmp_path):
    shades = [20, 90, 160, 230]
    write_video(tmp_path / "film.mp4", (np.full((48, 66, 3), shade, np.uint8) for shade in shades), fps=10)
    film = iio.imread(tmp_path / "film.mp4")
    assert film.shape == (4, 48, 66, 3)
    np.testing.assert_allclose(film.mean((1, 2, 3)), shades, atol=3)
    assert iio.immeta(tmp_path / "film.mp4")["fps"] == 10
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


@pytest.mark.parametrize(("count", "words"), [(3, "66 x 48 pixels, [123] pictures"), (0, "no size, 0 pictures")])
def test_a_film_that_ffmpeg_does_not_write_leaves_the_old_one(tmp_path, monkeypatch, count, words):
    (tmp_path / "film.mp4").write_bytes(b"the film of before")
    write = functools.partial(imageio_ffmpeg.write_frames, codec="none-such")
    monkeypatch.setattr(imageio_ffmpeg, "write_frames", write)
    with pytest.raises(UsageError, match=rf"film.mp4 \({words}\); make room for it"):
        write_video(tmp_path / "film.mp4", [np.zeros((48, 66, 3), np.uint8)] * count, fps=10)
    assert (tmp_path / "film.mp4").read_bytes() == b"the film of before"
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]
