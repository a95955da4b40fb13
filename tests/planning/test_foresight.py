"""What a model foresees, beside what the simulator does."""

import json
from copy import deepcopy

import numpy as np
import pytest

from envs.errors import UsageError
from planning import foresight
from planning.controllers.kit import Kit
from planning.foresight import Comparison, Config, main, random_plans


def test_plans_go_everywhere_within_the_limit():
    plans = random_plans(np.random.default_rng(0), 500, 6, 2, 0.5)
    sizes = np.linalg.norm(plans, axis=2)
    assert plans.shape == (500, 6, 2) and sizes.max() <= 0.5 and sizes.min() > 0.05
    assert np.ptp(sizes, axis=1).max() < 1e-12  # one speed each
    angles = np.arctan2(*plans[:, 0].T)
    assert (np.histogram(angles, bins=8, range=(-np.pi, np.pi))[0] > 30).all()


def test_ways_are_compared_by_how_far_they_truly_go():
    found = Comparison()
    true = np.array([[0.0, 0, 0], [0.03, 0, 0], [0.04, 0, 0], [0.09, 0, 0]])
    foreseen = true / 2 + [[0, 0.002, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]]
    found.add(true, foreseen, (np.array([0.4, 0.3, 0.2, 0.1]), np.array([0.3, 0.4, 0.2, 0.1])))
    found.add(true, foreseen, (np.array([0.4, 0.3, 0.2, 0.1]), np.full(4, 0.3)))  # their order says nothing
    table = found.table()
    assert [row["plans"] for row in table["ways"]] == [2, 4, 2]  # none goes 1 to 20 mm
    still, middle, far = table["ways"]
    assert still["foreseen_m"] == pytest.approx(0.002) and still["error_m"] == pytest.approx(0.002)
    assert middle["true_m"] == pytest.approx(0.035) and middle["error_m"] == pytest.approx(0.0175)
    assert far["cosine"] == pytest.approx(1) and far["to_m"] is None
    assert table["decisions"] == 1 and table["rank_correlation"] == pytest.approx(0.8)


def test_the_command_compares_and_writes(tmp_path, capsys, monkeypatch):
    out, first_draws = tmp_path / "new" / "foresight.json", {"planner": set(), "plans": set()}
    parts, plans = Kit.planning_parts, foresight.random_plans

    def watched_parts(kit):
        first_draws["planner"].add(deepcopy(kit.rng).random())
        return parts(kit)

    def watched_plans(rng, *options):
        first_draws["plans"].add(deepcopy(rng).random())
        return plans(rng, *options)

    monkeypatch.setattr(Kit, "planning_parts", watched_parts)
    monkeypatch.setattr(foresight, "random_plans", watched_plans)
    main(Config(episodes=1, decisions=2, plans=8, out=out))
    table = json.loads(out.read_text())
    assert sum(row["plans"] for row in table["ways"]) == 16
    assert len(first_draws["plans"]) == 2 and not first_draws["plans"] & first_draws["planner"]
    assert "truly mm" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"plans": 0}, "--plans is 0"),
        ({"seed": -1}, "--seed is -1"),
        ({"env": "planar-push", "point": "drawer"}, "nothing is known of --env planar-push"),
    ],
)
def test_bad_options_are_named(options, words):
    with pytest.raises(UsageError, match=words):
        Config(**options)
