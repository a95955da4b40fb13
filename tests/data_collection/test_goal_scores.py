"""How well policies bring the cube to a goal: what is recorded, what is counted, and how it goes on."""

from __future__ import annotations

import contextlib
import json
from types import SimpleNamespace

import numpy as np
import pytest

from data_collection import goal_scores
from data_collection.policies.stable_baselines import policy_name
from envs.errors import UsageError


def test_scores_compare_policies_from_the_same_starts(tmp_path, capsys):
    tasks = [
        {"policy": name, "episode": n, "steps": 4, "goal_angle": 90.0, "seed": 0}
        for name in ("random", "hold")
        for n in range(2)
    ]
    rows = [goal_scores.play(task) for task in tasks]
    for n in range(2):
        assert rows[n]["errors"][0] == rows[2 + n]["errors"][0]
    assert abs(rows[2]["errors"][-1] - rows[2]["errors"][0]) < 0.2  # nothing moves, nothing turns
    assert len(rows[0]["errors"]) == 5
    out = tmp_path / "goals.jsonl"
    out.write_text("".join(json.dumps(row) + "\n" for row in rows))
    before = out.read_text()
    goal_scores.main(goal_scores.Config(out, ("random", "hold"), episodes=2, steps=4))  # all is there already
    assert out.read_text() == before
    with out.open("a") as file:
        file.write('{"policy": "random", "epis')  # a killed run
    goal_scores.main(goal_scores.Config(out, ("random", "hold"), episodes=2, steps=4))
    assert out.read_text() == before
    lines = capsys.readouterr().out.splitlines()
    start = round(np.degrees(np.median([row["errors"][0] for row in rows[:2]])))
    assert lines[2].startswith(f"| random | 2 | {start} |")


class Reached:
    """An environment whose goal is reached in its second step, or never; the angle is small all along."""

    def __init__(self, second_step):
        self.success = iter([False, second_step, False, False])

    def reset(self, seed):
        return {}, {"rotation_error": 0.1, "is_success": False}

    def step(self, action):
        return {}, 0.0, False, False, {"rotation_error": 0.1, "is_success": next(self.success), "is_dropped": False}

    def close(self):
        pass


@pytest.mark.parametrize("reached", [True, False])
def test_reached_is_what_the_environment_says(monkeypatch, reached):
    monkeypatch.setattr(goal_scores, "DexHandEnv", lambda **_: Reached(reached))
    still = SimpleNamespace(reset=lambda *_: None, act=lambda _: np.zeros(20))
    monkeypatch.setattr(goal_scores, "make_policy", lambda _: still)
    row = goal_scores.play({"policy": "noise", "episode": 0, "steps": 4, "goal_angle": 90.0, "seed": 0})
    assert row["reached"] is reached and row.keys() == goal_scores.FIELDS
    line = list(goal_scores.table(("noise",), [row]))[2]
    assert line.startswith(f"| noise | 1 | 6 | 6 | 6 | {'100%' if reached else '0%'} | 0% |")


def test_episodes_of_another_file_of_the_same_name_do_not_count(tmp_path, monkeypatch, capsys):
    played = []

    def play(task):
        played.append(task["policy"])
        return {**task, "reached": True, "dropped": False, "seconds_a_step": 0.0, "errors": [0.0] * 5}

    pool = contextlib.nullcontext(SimpleNamespace(imap=map))  # which plays here
    monkeypatch.setattr(goal_scores, "play", play)
    monkeypatch.setattr(goal_scores.multiprocessing, "get_context", lambda _: SimpleNamespace(Pool=lambda _: pool))
    path, out = tmp_path / "hand.zip", tmp_path / "goals.jsonl"
    config = goal_scores.Config(out, (str(path),), episodes=2, steps=4)
    for content, expected in ((b"one", 2), (b"one", 2), (b"other", 4)):
        path.write_bytes(content)
        goal_scores.main(config)
        assert len(played) == expected
        assert capsys.readouterr().out.splitlines()[2].startswith(f"| {policy_name(path)} | 2 |")
    assert len(set(played)) == 2


@pytest.mark.parametrize(("line", "said"), [("{}", "recorded now; give another --out"), ("{", "remove that line")])
def test_lines_that_are_no_episodes_are_named(tmp_path, line, said):
    out = tmp_path / "goals.jsonl"
    out.write_text(line + "\n")
    with pytest.raises(UsageError, match=f"line 1 is no episode.*{said}"):
        goal_scores.main(goal_scores.Config(out, ("hold",), episodes=1))
