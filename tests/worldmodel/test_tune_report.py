"""`tune-report`: known rank correlations, the winner, and pictures, from hand-made results."""

import json
import warnings

import numpy as np
import pytest
from PIL import Image

from envs.command import run
from worldmodel.train import parse_options
from worldmodel.tune_report import ReportOptions, main
from worldmodel.tuning import journal
from worldmodel.tuning.correlation import rank_correlations
from worldmodel.tuning.figures import _Scale, correlation_figure
from worldmodel.tuning.journal import Trial
from worldmodel.tuning.report import FILES
from worldmodel.tuning.space import WEIGHTS

BUDGETS = (3, 9, 27)
NAMES = ("learning_rate", *(axis.name for axis in WEIGHTS))
SCORES = {  # trial -> its scores at the budgets that it reached
    0: (30.0, 33.0, 37.0),
    1: (31.0, 34.0, 36.0),
    2: (32.0, 35.0, 40.0),
    3: (33.0, 37.0, 39.0),
    4: (34.0, 36.0, 38.5),
    5: (29.0,),
    6: (35.0, 32.0),
}
# Ranks of trials 0 to 4: 1 2 3 4 5; 1 2 3 5 4; 2 1 5 4 3. r = 1 - 6 sum d^2 / (n (n^2 - 1)), n = 5.
EXPECTED = {(3, 9): 0.9, (3, 27): 0.5, (9, 27): 0.6}


def point(number):
    rng = np.random.default_rng(number)
    values = {name: float(10 ** rng.uniform(-3, 0)) for name in NAMES}
    return values | {"learning_rate": 1e-4 * (number + 1), "power": 1 + number % 2}


@pytest.fixture
def out(tmp_path):
    """A search of seven trials, five of them unpruned; one was stopped, one diverged, an eighth failed."""
    settings = {
        "options": {"trials": 9, "unpruned": 5, "searcher": "random"},
        "shared": {"preset": "tiny", "model": "t3vip", "frame_gap": 2, "losses": {"knn_radius": 3}},
        "budgets": BUDGETS,
        "axes": {name: [3e-5, 1e-3] if name == "learning_rate" else [1e-3, 1.0] for name in NAMES},
    }
    (tmp_path / "tune.json").write_text(json.dumps(settings))
    results = tmp_path / journal.JOURNAL
    for number, scores in SCORES.items():
        journal.append(results, {"kind": "begin", "trial": number, "point": point(number)})
        for step, score in zip(BUDGETS, scores, strict=False):
            journal.append(results, {"kind": "score", "trial": number, "step": step, "score": score})
            journal.append(results, {"kind": "score", "trial": number, "step": step, "score": score})  # told twice
        status = {1: "stopped", 2: "diverged", 3: "finished"}[len(scores)]
        journal.append(results, {"kind": "end", "trial": number, "status": status, "reason": ""})
    journal.append(results, {"kind": "death", "trial": 3, "reason": "killed"})
    journal.append(results, {"kind": "begin", "trial": 7, "point": point(7)})
    journal.append(results, {"kind": "end", "trial": 7, "status": "failed", "reason": "killed"})
    return tmp_path


def report(out):
    run(ReportOptions, main, [str(out)])
    return json.loads((out / "report.json").read_text())


def markdown_of(out):
    report(out)
    return (out / "report.md").read_text()


def test_it_says_what_else_a_run_with_the_best_configuration_would_share(out):
    line = "`best.json` also has what --config gave all trials, for a run of their kind: frame_gap 2, losses"
    assert f'{line} {{"knn_radius": 3}}.' in markdown_of(out)
    settings = json.loads((out / "tune.json").read_text())
    (out / "tune.json").write_text(json.dumps(settings | {"shared": {"preset": "tiny", "model": "t3vip"}}))
    assert "--config" not in markdown_of(out)


def test_rank_correlations_are_spearmans_with_counts(out):
    document = report(out)
    unpruned = {tuple(pair["budgets"]): pair for pair in document["rank_correlation"]["unpruned"]}
    assert {pair: found["r"] for pair, found in unpruned.items()} == pytest.approx(EXPECTED)
    assert {found["n"] for found in unpruned.values()} == {5}
    assert unpruned[3, 9]["p"] == pytest.approx(10 / 120)  # as tables have it for n = 5
    every = {tuple(pair["budgets"]): pair for pair in document["rank_correlation"]["all"]}
    assert {pair: found["n"] for pair, found in every.items()} == {(3, 9): 6, (3, 27): 5, (9, 27): 5}
    assert every[3, 9]["r"] < 0.5  # the one that diverged fell from the first place to the last
    assert document["shown_of"] == "unpruned"


@pytest.mark.parametrize(
    ("second", "r", "p"),
    [
        ([1, 2, 3], 1.0, 1 / 3),  # of six orders the right one and its reverse
        ([4, 3, 2, 1], -1.0, 1 / 12),
        ([1, 2, 4, 3], 0.8, 1 / 3),
        ([1, 2, 3, 4, 5], 1.0, 1 / 60),
        ([1, 1, 2], 3**0.5 / 2, 2 / 3),  # tied: four of six orders are as extreme
        (list(range(12)), 1.0, 0.0),  # as the t-distribution has it
        ([7, 7, 7, 7], None, None),
    ],
)
def test_p_values_of_few_trials_are_exact(second, r, p):
    scored = [Trial(number, scores={1: float(number), 2: float(then)}) for number, then in enumerate(second)]
    (pair,) = rank_correlations(scored, (1, 2))
    assert pair == {"budgets": [1, 2], "r": r and pytest.approx(r), "p": p and pytest.approx(p), "n": len(second)}


def test_the_best_of_those_that_ran_to_the_end_is_what_train_worldmodel_takes(out):
    document = report(out)
    assert document["best"] == 2 and document["gain"] == pytest.approx(3.0)
    assert document["trials"][3]["deaths"] == 1 and document["trials"][7]["status"] == "failed"
    options = parse_options(["--data", "d", "--out", "o", "--config", str(out / "best.json")])
    assert (options.preset, options.frame_gap, options.losses.knn_radius) == ("tiny", 2, 3)
    assert options.learning_rate == pytest.approx(3e-4) and options.losses.power == 1
    for axis in WEIGHTS:
        assert getattr(options.losses, axis.name) == point(2)[axis.name]
    text = (out / "report.md").read_text()
    assert "Searched: learning rate 3e-05 to 0.001, rgb 0.001 to 1, depth" in text and ", power 1 or 2.\n" in text
    assert "trial 2, 40.00 dB, +3.00 dB against trial 0" in text and "| 3 and 9 | 0.900 | 0.083 | 5 |" in text


def test_a_search_around_the_preset_says_so(out):
    path = out / "tune.json"
    settings = json.loads(path.read_text())
    settings["options"]["around"], settings["axes"]["kl"] = 3.0, [0.1 / 3, 0.3]
    path.write_text(json.dumps(settings))
    report(out)
    text = (out / "report.md").read_text()
    assert "Searched within a factor of 3 of the preset's values: learning rate" in text
    assert ", kl 0.033 to 0.3, power 1 or 2." in text


def test_the_motion_that_no_score_sees_is_told(out):
    assert "flow" not in markdown_of(out)  # nobody has measured it
    results = out / journal.JOURNAL
    for number, flow, tcp in ((0, 0.2, 0.1), (2, 0.3, 0.1)):
        line = {"kind": "score", "trial": number, "step": 27, "score": SCORES[number][2], "psnr": 20.0 + number}
        journal.append(results, line | {"flow_error_moving": flow, "tracking_error": tcp})
    text = markdown_of(out)
    told = "Which no score counts: scene-flow error on what moves 0.30 (trial 0: 0.20); TCP off, as a share of its way"
    assert f"{told} 0.10 (trial 0: 0.10): plan with it before you believe it.\n" in text
    assert "| trial | status | at 3 | at 9 | at 27 | RGB, dB | flow error | TCP off | learning rate |" in text
    (row,) = (line for line in text.splitlines() if line.startswith("| 2* |"))
    assert "| 40.00 | 22.00 | 0.30 | 0.10 |" in row
    line = {"kind": "score", "trial": 2, "step": 27, "score": 40.0, "flow_error_moving": 0.21}
    journal.append(results, line)  # of data without an arm
    assert "scene-flow error on what moves 0.21 (trial 0: 0.20).\n" in markdown_of(out)
    journal.append(results, line | {"tracking_error": 0.13})
    assert "its way 0.13 (trial 0: 0.10): plan with it" in markdown_of(out)


@pytest.mark.parametrize(
    ("value", "label"), [(1.5e-3, "1.5e-3"), (1e-3, "1e-3"), (1.67e-4, "1.7e-4"), (0.0333, "0.0333"), (1.0, "1")]
)
def test_the_ends_of_an_axis_are_not_rounded_away(value, label):
    assert _Scale(np.array([value, 2.0]), True).label(value) == label


def test_pictures(out):
    document = report(out)
    for name in ("trials.png", "rank-correlation.png"):
        with Image.open(out / name) as picture:
            assert np.asarray(picture.convert("L")).std() > 10, name
    assert all((out / name).exists() for name in FILES) and len(document["trials"]) == 8


def test_each_cell_of_the_rank_correlation_figure_says_r_p_and_n(out):
    axes = correlation_figure(report(out)).axes[0]
    columns, rows = (
        [int(label.get_text()) for label in labels] for labels in (axes.get_xticklabels(), axes.get_yticklabels())
    )
    cells = {(rows[y], columns[x]): text.get_text() for text in axes.texts for x, y in [text.get_position()]}
    assert cells == {
        (3, 9): "r = 0.900\np = 0.083\nn = 5",
        (3, 27): "r = 0.500\np = 0.450\nn = 5",
        (9, 27): "r = 0.600\np = 0.350\nn = 5",
    }
    assert axes.get_title() == "rank correlation (unpruned trials)"


def test_a_cell_without_a_correlation_says_n_alone_and_no_p_is_0():
    pairs = [
        {"budgets": [3, 9], "r": 1.0, "p": 0.0002, "n": 12},
        {"budgets": [3, 27], "r": None, "p": None, "n": 2},
        {"budgets": [9, 27], "r": -0.6, "p": 0.2, "n": 6},
    ]
    texts = correlation_figure({"budgets": BUDGETS, "shown": pairs, "shown_of": "all"}).axes[0].texts
    assert [text.get_text() for text in texts] == [
        "r = 1.000\np < 0.001\nn = 12",
        "n = 2",
        "r = -0.600\np = 0.200\nn = 6",
    ]


def test_a_trial_may_lack_an_axis_or_have_a_0_there(out):
    odd = {name: value for name, value in point(1).items() if name != "depth"} | {"knn": 0.0}
    results = out / journal.JOURNAL
    results.write_text(results.read_text().replace(json.dumps(point(1)), json.dumps(odd)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # as of a logarithm of 0
        assert report(out)["trials"][1]["point"] == odd
    scale = _Scale(np.array([0.0, np.nan, 0.01, 1.0]), True)
    assert [scale(value) for value in (0.01, 0.1, 1.0)] == pytest.approx([0, 0.5, 1])
    assert np.isnan([scale(0.0), scale(np.nan)]).all()


def test_an_unfinished_search_has_a_report_of_what_there_is(out):
    results = out / journal.JOURNAL
    lines = results.read_text().splitlines()
    results.write_text("\n".join(lines[:4]) + '\n{"kind": "sco')  # trial 0 under way, and a torn line
    document = report(out)
    assert document["best"] is None and [trial["status"] for trial in document["trials"]] == ["running"]
    assert not (out / "best.json").exists() and not (out / "rank-correlation.png").exists()
    journal.append(results, {"kind": "score", "trial": 0, "step": 27, "score": 36.0})
    assert report(out)["best"] == 0  # what comes after a torn line counts


def test_a_trial_that_was_drawn_anew_forgets_its_scores(out):
    results = out / journal.JOURNAL
    journal.append(results, {"kind": "begin", "trial": 2, "point": point(12)})
    (trial,) = (trial for trial in journal.trials(results) if trial.number == 2)
    assert not trial.scores and trial.status == "running" and trial.point == point(12)


@pytest.mark.parametrize(
    ("content", "word"), [(None, "no search in"), ("{}", "is damaged"), ("{", "is damaged"), ("[]", "is damaged")]
)
def test_what_is_no_search(tmp_path, capsys, content, word):
    if content is not None:
        (tmp_path / "tune.json").write_text(content)
    with pytest.raises(SystemExit) as stop:
        run(ReportOptions, main, [str(tmp_path)])
    lines = capsys.readouterr().err.splitlines()
    assert stop.value.code == 2 and len(lines) == 1 and word in lines[0]
