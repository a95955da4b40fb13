"""The command: the same dataset whatever the number of workers, resumed and extended, nothing half-written."""

import json
import signal
import time

import numpy as np
import pytest
from commands import assert_one_line_error, call, finish, start
from layouts import write_calvin, write_dexhand

from data_collection.dataset import RGBDDataset
from data_collection.importers import crew


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """Four episodes of eleven frames, the second of them damaged."""
    folder = write_calvin(tmp_path_factory.mktemp("calvin") / "task_D_D", [(11 * i, 11 * i + 10) for i in range(4)])
    (folder / "episode_0000015.npz").unlink()
    return folder


def arguments(source, folder, **changed):
    chosen = {"format": "calvin", "image-size": 8, "steps": 5, "workers": 1, **changed}
    flags = [flag for name, value in chosen.items() if value is not True for flag in (f"--{name}", str(value))]
    return [source, folder, *flags, *(f"--{name}" for name, value in chosen.items() if value is True)]


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.glob("shard-*.h5")}


@pytest.fixture(scope="module")
def imported(source, tmp_path_factory):
    folder = tmp_path_factory.mktemp("imported") / "data"
    code, out, err = call("import-dataset", arguments(source, folder))
    assert code == 0, err
    assert "7 episodes, 42 frames" in out and "1 damaged" in out
    assert "episode 2 (episode 1, frames 11 to 16): skipped: episode_0000015.npz is missing" in out
    assert "8/8" in err
    return folder


def test_two_workers_write_the_same_bytes(source, imported, tmp_path):
    folder = tmp_path / "data"
    code, out, err = call("import-dataset", arguments(source, folder, workers=2))
    assert code == 0 and "1 damaged" in out, err
    assert contents(folder) == contents(imported) and len(contents(folder)) == 7
    reports = [json.loads((place / "import.json").read_text()) for place in (folder, imported)]
    assert reports[0] == reports[1]
    assert sorted(p.name for p in folder.iterdir() if p.suffix != ".h5") == [".lock", "import.json"]


def test_resuming_makes_what_is_missing_and_keeps_what_is_there(source, imported, tmp_path):
    folder = tmp_path / "data"
    code, out, _ = call("import-dataset", arguments(source, folder, limit=2))
    assert code == 0 and "2 episodes" in out
    (folder / "shard-00000.h5").unlink()
    (folder / "shard-00004.h5.77.tmp").write_bytes(b"half")
    kept = (folder / "shard-00001.h5").stat()
    code, out, err = call("import-dataset", arguments(source, folder))
    assert code == 0 and "7 episodes" in out and "1 damaged" in out, err
    assert contents(folder) == contents(imported)
    after = (folder / "shard-00001.h5").stat()
    assert (after.st_ino, after.st_mtime_ns) == (kept.st_ino, kept.st_mtime_ns)
    assert not list(folder.glob("*.tmp"))
    assert json.loads((folder / "import.json").read_text()) == json.loads((imported / "import.json").read_text())


def test_other_options_or_another_source_are_refused(source, imported, tmp_path):
    for changed, words in (
        ({"steps": 6}, ("steps = 5, not 6",)),
        ({"image-size": 16}, ("camera",)),
        ({"near": 3.5}, ("camera",)),
        ({"scene": "A"}, ("'calvin/D'", "'calvin/A'")),
    ):
        assert_one_line_error(call("import-dataset", arguments(source, imported, **changed)), *words)
    np.save(tmp_path / "ids.npy", np.array([[22, 32], [0, 10]]))
    result = call("import-dataset", arguments(source, imported, ids=tmp_path / "ids.npy"))
    assert_one_line_error(result, "shard-00000.h5", "frames 22 to 27")
    np.save(tmp_path / "ids.npy", np.array([[0, 10], [11, 21], [22, 32]]))  # the last episode is gone
    result = call("import-dataset", arguments(source, imported, ids=tmp_path / "ids.npy"))
    assert_one_line_error(result, "shard-00006.h5 holds episode 3", "past its 6 episodes", "the same source")
    assert_one_line_error(call("import-dataset", arguments(source, tmp_path / "ids.npy")), "is a file")
    for option, value in (("image-size", 4), ("steps", 0), ("limit", 0), ("near", -1), ("depth-scale", "nan")):
        result = call("import-dataset", arguments(source, tmp_path / "new", **{option: value}))
        assert_one_line_error(result, f"--{option} is {value}")
    assert_one_line_error(call("import-dataset", arguments(source, tmp_path / "new", near=7)), "near=7")
    assert_one_line_error(
        call("import-dataset", arguments(source, tmp_path / "new", format="dexhand", scene="A")), "--scene"
    )
    assert not (tmp_path / "new").exists()


def test_strict_and_nothing_at_all_end_with_2(source, imported, tmp_path):
    assert_one_line_error(
        call("import-dataset", arguments(source, imported, strict=True)), "1 of 8 episodes are damaged"
    )
    root = write_dexhand(tmp_path / "dexhand", 2, 3)
    for path in root.rglob("joints0.txt"):
        path.unlink()
    result = call("import-dataset", arguments(root, tmp_path / "data", format="dexhand"))
    assert_one_line_error(result, "no episode of")
    assert json.loads((tmp_path / "data" / "import.json").read_text())["damaged"] == 2


def test_an_interrupted_import_leaves_whole_files_and_a_report(source, imported, tmp_path, monkeypatch):
    folder, write, calls = tmp_path / "data", crew.write_shard, []

    def interrupted(path, *rest):
        calls.append(path)
        if len(calls) == 3:
            path.with_name(f"{path.name}.1.tmp").write_bytes(b"half")
            raise KeyboardInterrupt
        write(path, *rest)

    monkeypatch.setattr(crew, "write_shard", interrupted)
    code, _, err = call("import-dataset", arguments(source, folder))
    assert code == 130 and "interrupted" in err
    report = json.loads((folder / "import.json").read_text())
    assert report["imported"] == 2 and not report["complete"]
    assert sorted(path.name for path in folder.glob("shard*")) == ["shard-00000.h5", "shard-00001.h5"]
    monkeypatch.undo()
    assert call("import-dataset", arguments(source, folder))[0] == 0
    assert contents(folder) == contents(imported)


def test_a_full_disk_is_said_in_one_line(source, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(crew, "write_shard", full)
    assert_one_line_error(call("import-dataset", arguments(source, tmp_path / "data")), "No space left", "again")


def test_a_killed_import_is_resumed(source, imported, tmp_path):
    folder = tmp_path / "data"
    process = start("import-dataset", arguments(source, folder, workers=2))
    until = time.monotonic() + 120
    while not list(folder.glob("shard-*.h5")) and process.poll() is None and time.monotonic() < until:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    finish(process)
    until = time.monotonic() + 60
    while time.monotonic() < until:  # its workers finish what they are at
        RGBDDataset(folder)
        code, _, err = call("import-dataset", arguments(source, folder))
        if code == 0:
            break
    assert code == 0, err
    assert contents(folder) == contents(imported)


def test_a_worker_that_dies_costs_its_part(source, tmp_path):
    """An npz that no memory can hold kills the process; stand-in: the worker is killed by whoever reads the part."""
    from data_collection.import_dataset import describe
    from data_collection.importers import SourceOptions, open_source

    calvin = open_source("calvin", SourceOptions(source, image_size=8))
    parts = [part for part in calvin.parts() if part.index != 1]
    deadly = Deadly(calvin)
    outcomes = {outcome.index: outcome for outcome in crew.import_parts(deadly, describe(calvin), tmp_path, parts, 2)}
    assert sorted(outcomes) == [0, 2, 3]
    assert "killed by SIGKILL" in outcomes[2].damage
    assert outcomes[0].damage is None and outcomes[3].damage is None
    assert not list(tmp_path.glob("shard-00002*"))


class Deadly:
    """A source whose part 2 is the death of the process that reads it."""

    def __init__(self, source):
        self._source = source

    def read(self, part):
        if part.index == 2:
            signal.raise_signal(signal.SIGKILL)
        return self._source.read(part)
