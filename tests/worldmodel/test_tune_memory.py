"""Memory of a search: trials share the data in Ray's, and it may run out."""

import json
import os
import time
from pathlib import Path
from unittest import mock

import pytest

from envs.errors import UsageError
from worldmodel.clips import ClipSource
from worldmodel.training_data import open_data
from worldmodel.tuning.options import TuneOptions
from worldmodel.tuning.search import search


@pytest.fixture
def watched(tmp_path):
    """Makes clips that write down, in the process that samples them, where the columns that they hold are."""

    class Watched(ClipSource):  # in here Ray sends the class along
        def sample(self, *arguments, **keywords):
            columns = {name: described(column) for name, column in self._columns.items()}
            (tmp_path / f"{os.getpid()}.json").write_text(json.dumps(columns))
            while len(list(tmp_path.glob("*.json"))) < 2:  # or one process would run both trials
                time.sleep(0.05)
            return super().sample(*arguments, **keywords)

    def described(column):
        address = column.__array_interface__["data"][0]
        for line in Path("/proc/self/maps").read_text().splitlines():
            area, _, offset, _, inode, *path = line.split(maxsplit=5)
            start, end = (int(bound, 16) for bound in area.split("-"))
            if start <= address < end:
                break
        place = [int(inode), int(offset, 16) + address - start]
        return {"free": column.flags.owndata or column.flags.writeable, "file": " ".join(path), "place": place}

    return lambda clips: Watched(clips.dataset, clips.frame_gap, share=clips)


@pytest.mark.timeout(900)
def test_trials_read_the_same_memory_and_cannot_write_to_it(watched, tiny_dataset, tmp_path):
    trials = {"trials": 2, "unpruned": 2, "steps": 2, "reduction": 2, "rungs": 1, "workers": 2}
    options = TuneOptions(tiny_dataset, tmp_path / "tuned", "tiny", **trials)
    options.out.mkdir()
    clips, validation = open_data(options.training)
    with mock.patch.dict(os.environ, {"TORCHDYNAMO_DISABLE": "1"}):
        search(options, (watched(clips), validation))
    one, other = (json.loads(path.read_text()) for path in tmp_path.glob("*.json"))
    assert one.keys() >= {"rgb", "depth", "action", "segmentation"} and one == other
    for name, column in one.items():
        assert not column["free"] and "plasma" in column["file"], name


@pytest.mark.timeout(900)
def test_a_search_that_a_cluster_has_ended_for_want_of_memory_says_how_to_go_on(tiny_dataset, tmp_path):
    options = TuneOptions(tiny_dataset, tmp_path / "tuned", "tiny", trials=1)
    options.out.mkdir()
    raised = RuntimeError("Caught unexpected exception: 1 worker(s) were killed due to the node running low on memory.")
    with mock.patch("ray.tune.Tuner.fit", side_effect=raised), pytest.raises(UsageError, match="the same command goes"):
        search(options, open_data(options.training))
