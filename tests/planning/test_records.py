"""The folder of an evaluation: what it holds binds what may be added to it, and what it lacks is made."""

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest

from envs.errors import UsageError
from planning import servo_eval
from planning.controllers import CONTROLLERS, Kit
from planning.records import EpisodeLog
from planning.tasks import TASKS
from tests.planning.servo_records import record


def settings(steps=10, **checkpoints):
    return {"steps": steps, "checkpoints": checkpoints}


def config_of(folder):
    return json.loads((folder / "config.json").read_text())


def test_a_folder_without_episodes_takes_any_settings(tmp_path):
    EpisodeLog(tmp_path, settings(10, t3vip="old"))
    EpisodeLog(tmp_path, settings(100, t3vip="new"))
    assert config_of(tmp_path) == settings(100, t3vip="new")
    (tmp_path / "episodes.jsonl").write_text('{"model": "t3v')  # killed in its first line
    EpisodeLog(tmp_path, settings(50))
    assert config_of(tmp_path) == settings(50)


def test_a_folder_with_episodes_takes_only_its_own(tmp_path):
    EpisodeLog(tmp_path, settings(10, t3vip="a", sv2p="b")).append(record("t3vip"))
    with pytest.raises(UsageError, match="episodes with steps 10, not 100"):
        EpisodeLog(tmp_path, settings(100, t3vip="a"))
    with pytest.raises(UsageError, match="another t3vip checkpoint"):
        EpisodeLog(tmp_path, settings(10, t3vip="c"))
    EpisodeLog(tmp_path, settings(10, sv2p="c"))  # of which it holds no episode
    assert config_of(tmp_path) == settings(10, t3vip="a", sv2p="c")


def test_a_line_that_was_not_finished_is_cut_off_and_the_next_episode_comes_after_the_last_whole_one(tmp_path):
    EpisodeLog(tmp_path, settings()).append(record("random", 0))
    with (tmp_path / "episodes.jsonl").open("a") as lines:
        lines.write('{"model": "rand')
    EpisodeLog(tmp_path, settings()).append(record("random", 1))
    assert list(EpisodeLog(tmp_path, settings()).records) == [("random", 0, 0), ("random", 1, 0)]


class Reel:
    """A film without pictures."""

    def __init__(self, studio, setup, caption):
        self.watch = None

    def save(self, path):
        path.parent.mkdir(exist_ok=True)
        for suffix in (".mp4", ".png"):
            path.with_suffix(suffix).touch()


def test_finished_episodes_are_filmed_when_a_film_is_asked_for(tmp_path, monkeypatch):
    """Without a simulator: an episode is a number that is drawn."""
    ran = []

    def run_episode(env, setup, name, drawn, steps, repeat, watch, whole):
        ran.append(drawn)
        return record(name, setup.index, repeat=repeat)

    monkeypatch.setattr(servo_eval, "run_episode", run_episode)
    monkeypatch.setattr(servo_eval, "Film", Reel)
    monkeypatch.setitem(CONTROLLERS, "random", lambda kit: kit.rng.random())
    setups = {"make_setup": lambda env, index, seed: SimpleNamespace(index=index)}
    monkeypatch.setitem(TASKS, ("tabletop", "hand"), replace(TASKS["tabletop", "hand"], **setups))

    def go_on(video):
        """Episodes that are added."""
        config = servo_eval.ServoConfig(out=tmp_path, model=("random",), setups=2, repeats=2, video=video)
        log = EpisodeLog(tmp_path, servo_eval.settings(config, 3, {}))
        records = list(servo_eval.run_missing(config, None, None, Kit(None), log))
        for new in records:
            log.append(new)
        return len(records)

    assert go_on(video=0) == 4 == len(ran) and not (tmp_path / "videos").exists()
    assert go_on(video=3) == 0 and ran[4:] == ran[:3]  # the same again
    films = {path.stem for path in (tmp_path / "videos").iterdir()}
    assert films == {"random-setup00-0", "random-setup00-1", "random-setup01-0"}
    (tmp_path / "videos" / "random-setup00-1.png").unlink()
    assert go_on(video=3) == 0 and ran[7:] == ran[1:2]
    assert go_on(video=3) == 0 and len(ran) == 8
