"""Light meshes and their cache."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from envs import meshes


@pytest.fixture()
def pyramid(tmp_path):
    path = tmp_path / "pyramid.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    return path


def test_the_own_cache_wins_and_is_read_again(pyramid, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "theirs"))
    assert meshes.cache_dir() == tmp_path / "theirs" / "t3vip"
    monkeypatch.setenv("T3VIP_CACHE", str(tmp_path / "own"))
    first = meshes.light_mesh([pyramid])
    assert len(first.faces) == 4 and not (tmp_path / "theirs").exists()
    assert [path.suffix for path in (tmp_path / "own" / "meshes").iterdir()] == [".npz"]
    monkeypatch.setattr(meshes, "read_mesh", None)  # it is not read again
    again = meshes.light_mesh([pyramid])
    np.testing.assert_array_equal(first.faces, again.faces)
    np.testing.assert_array_equal(first.vertices, again.vertices)


@pytest.mark.parametrize("cache", ["/proc/none", "file"])
def test_a_cache_that_cannot_be_written_costs_only_time(pyramid, tmp_path, monkeypatch, cache):
    (tmp_path / "file").touch()
    monkeypatch.setenv("T3VIP_CACHE", str(tmp_path / Path(cache)))
    assert len(meshes.light_mesh([pyramid]).faces) == 4


def test_a_full_disk_leaves_nothing_behind(pyramid, tmp_path, monkeypatch):
    def full(file, **arrays):
        raise OSError(28, "No space left on device")

    monkeypatch.setenv("T3VIP_CACHE", str(tmp_path))
    monkeypatch.setattr(meshes.np, "savez_compressed", full)
    assert len(meshes.light_mesh([pyramid]).faces) == 4
    assert not list((tmp_path / "meshes").iterdir())


@pytest.mark.parametrize("left", [0, 100])
def test_a_damaged_cache_is_made_anew(pyramid, tmp_path, monkeypatch, left):
    monkeypatch.setenv("T3VIP_CACHE", str(tmp_path))
    first = meshes.light_mesh([pyramid])
    (cached,) = (tmp_path / "meshes").iterdir()
    whole = cached.read_bytes()
    cached.write_bytes(whole[:left])
    np.testing.assert_array_equal(meshes.light_mesh([pyramid]).faces, first.faces)
    assert len(cached.read_bytes()) == len(whole)
