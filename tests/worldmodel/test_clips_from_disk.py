"""A dataset that does not fit: the same clips, of which only what they need is read."""

import io
import math

import h5py
import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from data_collection import dataset as dataset_module
from data_collection import writer
from data_collection.dataset import NEARBY_ROWS, RGBDDataset
from envs.errors import UsageError
from worldmodel import evaluate, view_prediction
from worldmodel.checkpoint import save_model
from worldmodel.clips import PICTURES, ClipSource
from worldmodel.memory import available_memory
from worldmodel.train import main, parse_options

FRAMES, GAP, ROWS_A_CHUNK = 3, 2, 5
ROWS = 2 * NEARBY_ROWS + 40


@pytest.fixture(scope="module")
def folder(tmp_path_factory, write_dataset):
    """Four episodes in two shards, in chunks of a few rows."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "CHUNK_BYTES", ROWS_A_CHUNK * 16 * 24 * 3)
        return write_dataset(tmp_path_factory.mktemp("long") / "data", [ROWS] * 4)


@pytest.fixture(scope="module")
def sources(folder):
    """From memory and from the disk."""
    dataset = RGBDDataset(folder)
    size = dataset.size_of(("rgb", "depth"))
    assert size == 4 * ROWS * 16 * 24 * 5
    held, read = ClipSource(dataset, GAP, memory_limit=size), ClipSource(dataset, GAP, memory_limit=size - 1)
    assert held.in_memory and not read.in_memory
    return held, read


class Counted(io.FileIO):
    """A file that knows what was read of it."""

    bytes_read = 0

    def readinto(self, buffer):
        count = super().readinto(buffer)
        Counted.bytes_read += count
        return count


@pytest.fixture
def opened(monkeypatch):
    """The files that are opened, whose reads `Counted` counts from now on."""
    names = []

    class Files(h5py.File):
        def __init__(self, path, mode):
            names.append(path.name)
            super().__init__(Counted(path), mode)

    monkeypatch.setattr(dataset_module.h5py, "File", Files)
    Counted.bytes_read = 0
    return names


def test_clips_and_truth_are_the_same(sources):
    held, read = sources
    for frames in (FRAMES, 20):
        starts = held.starts(frames)
        assert np.array_equal(starts, read.starts(frames))
        some = np.concatenate([starts[[0, -1, 7, 7]], starts[::61]])  # in no order, one of them twice
        ours, theirs = read.at(some, frames), held.at(some, frames)
        for name in ("rgb", "depth", "actions"):
            assert torch.equal(getattr(ours, name), getattr(theirs, name)), name
    ours, theirs = (source.truth_at(some, FRAMES) for source in sources)
    for name in ("scene_flow", "hand", "bodies", "tcp"):
        assert torch.equal(getattr(ours, name), getattr(theirs, name)), name
    assert not {"rgb", "depth", "segmentation"} & read._columns.keys()
    clips = [source.sample(np.random.default_rng(3), 5, FRAMES) for source in sources]
    assert torch.equal(clips[0].rgb, clips[1].rgb)
    assert not read.with_actions("action").in_memory


def test_only_what_a_clip_needs_is_read(sources, folder, opened):
    _, read = sources
    read.at(np.array([3 * ROWS + 50]), FRAMES)
    assert opened == ["shard-00001.h5"]  # and the other not
    with h5py.File(folder / "shard-00001.h5", "r") as file:
        chunks = {name: file[name].id.get_storage_size() * ROWS_A_CHUNK / (2 * ROWS) for name in ("rgb", "depth")}
        described = sum(1 for _ in file) * 4096  # superblock, headers, trees of chunks
    spanned = (FRAMES - 1) * GAP + 1
    touched = -(-spanned // ROWS_A_CHUNK) + 1
    assert 0 < Counted.bytes_read < 2 * touched * sum(chunks.values()) + described
    assert Counted.bytes_read < 0.25 * (folder / "shard-00001.h5").stat().st_size


def test_a_batch_opens_each_shard_once_and_skips_what_lies_between(sources, folder, opened):
    _, read = sources
    read.at(np.array([0, ROWS - 9, 2 * ROWS, 5]), FRAMES)
    assert sorted(opened) == ["shard-00000.h5", "shard-00001.h5"]
    assert Counted.bytes_read < 0.4 * sum(path.stat().st_size for path in folder.glob("*.h5"))


def test_rows_that_are_not_there(sources):
    dataset = sources[0].dataset
    assert dataset.rows(("rgb",), np.empty((0, 2), np.int64))["rgb"].shape == (0, 2, 16, 24, 3)
    for row in (-1, 4 * ROWS):
        with pytest.raises(IndexError, match=f"of a dataset of {4 * ROWS}"):
            dataset.rows(("rgb",), np.array([row]))


def test_training_has_the_same_bits_from_the_disk_and_when_it_must(folder, tmp_path):
    given = ["--preset", "tiny", "--data", str(folder), "--steps", "3", "--batch", "2"]
    try:
        main(parse_options([*given, "--out", str(tmp_path / "memory"), "--deterministic"]))
        assert torch.are_deterministic_algorithms_enabled() and not torch.backends.cudnn.benchmark
    finally:
        torch.use_deterministic_algorithms(False)
        torch.backends.cudnn.deterministic = False
    main(parse_options([*given, "--out", str(tmp_path / "disk"), "--memory-limit", "0"]))
    held, read = (
        load_file(tmp_path / run / "checkpoints/step-00000003/training.safetensors") for run in ("memory", "disk")
    )
    assert held.keys() == read.keys()
    for name, value in held.items():
        assert torch.equal(value, read[name]), name
    main(parse_options([*given, "--out", str(tmp_path / "disk")]))  # it would go on without the limit


def test_scoring_and_viewing_hold_no_pictures(folder, make_model, tmp_path, monkeypatch):
    loaded, load = [], RGBDDataset.load
    monkeypatch.setattr(RGBDDataset, "load", lambda self, column: loaded.append(column) or load(self, column))
    save_model(make_model(), tmp_path / "model", {})
    given = {"data": folder, "models": (str(tmp_path / "model"),), "predicted": 2}
    evaluate.main(evaluate.EvaluationOptions(out=tmp_path / "scores", clips=3, vgg=False, **given))
    view_prediction.main(view_prediction.ViewOptions(out=(tmp_path / "clip.png",), **given))
    assert "action" in loaded and not set(PICTURES) & set(loaded)


def test_a_limit_that_is_none():
    with pytest.raises(UsageError, match="memory-limit is -1"):
        parse_options(["--data", "data", "--out", "out", "--memory-limit", "-1"])
    assert 0 < available_memory() < math.inf


def test_files_that_lie_idle_take_no_memory_from_a_container(tmp_path):
    for name, text in (("max", "3000"), ("current", "2500"), ("stat", "anon 500\ninactive_file 1800\nactive_file 200")):
        (tmp_path / f"memory.{name}").write_text(f"{text}\n")
    assert available_memory(tmp_path) == 3000 - (2500 - 1800)
