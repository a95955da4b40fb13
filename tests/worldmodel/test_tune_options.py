"""What a search tries and when it stops a trial; and that mistakes are one line, before anything is begun."""

import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from envs.command import run
from worldmodel import tune
from worldmodel.options import PRESETS
from worldmodel.trainer import Trainer
from worldmodel.tuning import journal, searchers
from worldmodel.tuning.halving import Halving
from worldmodel.tuning.options import TuneOptions
from worldmodel.tuning.searchers import budget_of, make_searcher, ray_space
from worldmodel.tuning.space import LEARNING_RATE, POWER, WEIGHTS, at_point, axes_of, draw, point_of

CONTINUE, STOP = "CONTINUE", "STOP"
TINY = PRESETS["tiny"]


@pytest.fixture
def tune_with(capsys, monkeypatch, tiny_dataset, tmp_path):
    """Runs the command without its search; gives the exit code and what it wrote to stderr."""
    monkeypatch.setattr(tune, "search", lambda options, data: None)

    def call(*arguments, data=tiny_dataset, out=tmp_path / "tuned"):
        capsys.readouterr()
        try:
            run(
                TuneOptions, tune.main, [str(w) for w in ("--preset", "tiny", "--data", data, "--out", out, *arguments)]
            )
            return 0, capsys.readouterr().err
        except SystemExit as stop:
            return stop.code, capsys.readouterr().err

    call.out = tmp_path / "tuned"
    return call


def assert_one_line(result, *words):
    code, err = result
    assert code == 2 and len(err.splitlines()) == 1 and err.startswith("error: "), err
    for word in words:
        assert word in err


def test_budgets_are_powers_of_the_reduction_and_the_whole_run():
    def budgets(steps, **options):
        return TuneOptions("d", "o", **options).budgets_of(steps)

    assert budgets(1600) == (178, 534, 1600)
    assert budgets(27, rungs=3) == (1, 3, 9, 27)
    assert budgets(1600, reduction=4, rungs=1) == (400, 1600) and budgets(5, rungs=0) == (5,)


def test_all_trials_share_the_schedule_of_the_full_budget(tune_with, tiny_dataset, tmp_path):
    """A trial's options differ from a plain run's in values, folder and when it is validated; never in its steps."""
    options = TuneOptions(tiny_dataset, tmp_path, preset="tiny", steps=18, gpus_per_trial=0)
    shared = options.training
    assert (shared.steps, shared.schedule, shared.validate_every) == (18, TINY.schedule, 2)
    point = draw(axes_of(shared), np.random.default_rng(0))
    trial = at_point(shared, point)
    assert trial.steps == 18 and trial.learning_rate == point["learning_rate"] and trial.losses.knn == point["knn"]
    assert replace(trial, learning_rate=shared.learning_rate, losses=shared.losses) == shared
    at_the_first_rung = SimpleNamespace(options=trial, step=2)
    assert Trainer.progress.fget(at_the_first_rung) == pytest.approx(1 / 9)


def test_the_space_is_the_papers_and_only_what_matters_to_a_model_is_searched():
    everything = axes_of(TINY)
    assert [axis.name for axis in everything] == [LEARNING_RATE.name, *(axis.name for axis in WEIGHTS)]
    draws = [draw(everything, np.random.default_rng(i)) for i in range(400)]
    for axis in everything:
        logs = np.log([point[axis.name] for point in draws])
        low, high = np.log(axis.low), np.log(axis.high)
        assert low <= logs.min() < low + 0.1 * (high - low) and high - 0.1 * (high - low) < logs.max() <= high
        assert abs(logs.mean() - (low + high) / 2) < 0.1 * (high - low)
    assert {point[POWER] for point in draws} == {1, 2}
    assert {axis.name for axis in axes_of(replace(TINY, model="sv2p"))} == {"learning_rate", "rgb", "kl"}
    assert {axis.name for axis in axes_of(replace(TINY, model="cdna"))} == {"learning_rate", "rgb"}
    assert "kl" not in {axis.name for axis in axes_of(replace(TINY, model="t3vip-d"))}
    own = point_of(TINY, everything)
    assert at_point(TINY, own) == TINY


@pytest.mark.parametrize("around", [None, 3.0])
def test_a_term_that_is_off_stays_off(around):
    training = replace(TINY, losses=replace(TINY.losses, knn=0.0))
    axes = axes_of(training, around)
    assert {axis.name for axis in axes} == {axis.name for axis in axes_of(TINY)} - {"knn"}
    trial = at_point(training, draw(axes, np.random.default_rng(0)))
    assert trial.losses.knn == 0 and trial.losses.rgb != training.losses.rgb


def test_a_search_around_the_preset_draws_near_its_values():
    axes = axes_of(TINY, 3.0)
    searcher = random_searcher(axes)
    own, *drawn = [searcher.suggest(f"a{i}") for i in range(60)]
    for axis in axes:
        factors = np.log([point[axis.name] / own[axis.name] for point in drawn]) / np.log(3)
        assert -1 <= factors.min() < -0.8 and 0.8 < factors.max() <= 1, axis.name


def test_the_folder_says_what_is_searched(tune_with):
    assert tune_with("--around", 3)[0] == 130
    axes = json.loads((tune_with.out / "tune.json").read_text())["axes"]
    assert axes["learning_rate"] == pytest.approx([TINY.learning_rate / 3, TINY.learning_rate * 3])
    assert axes["kl"] == pytest.approx([TINY.losses.kl / 3, TINY.losses.kl * 3])
    assert_one_line(tune_with("--around", 2), "around = 3.0, not 2.0", "another --out")
    assert_one_line(tune_with(), "around = 3.0, not None")


def test_a_search_may_be_given_more_trials_where_they_hang_on_their_number_alone(tune_with, monkeypatch):
    def settings():
        return json.loads((tune_with.out / "tune.json").read_text())

    assert tune_with("--trials", 2)[0] == 130
    (tune_with.out / "ray").mkdir()
    assert tune_with("--trials", 2)[0] == 130 and (tune_with.out / "ray").exists()
    assert_one_line(tune_with("--trials", 3, "--steps", 18), "steps = None, not 18")
    assert settings()["options"]["trials"] == 2 and (tune_with.out / "ray").exists()
    assert tune_with("--trials", 3)[0] == 130
    assert settings()["options"]["trials"] == 3 and not (tune_with.out / "ray").exists()  # Ray knows of two
    other = settings()
    (tune_with.out / "tune.json").write_text(json.dumps(other | {"axes": {"rgb": [0.1, 1.0]}}))
    assert_one_line(tune_with("--trials", 4), "trials = 3, not 4")
    assert_one_line(tune_with("--trials", 3), "ranges {'rgb': [0.1, 1.0]}, not {", "another --out")
    monkeypatch.setattr(searchers, "check_searcher", lambda name: None)
    (tune_with.out / "tune.json").write_text(json.dumps(other | {"options": other["options"] | {"searcher": "bohb"}}))
    assert_one_line(tune_with("--trials", 4, "--searcher", "bohb"), "trials = 3, not 4", "another --out")


def test_a_search_that_was_moved_goes_on_where_it_is(tune_with, monkeypatch, tmp_path):
    """Ray's state holds the old place."""
    assert tune_with()[0] == 130
    (tune_with.out / "ray").mkdir()
    (tmp_path / "link").symlink_to(tune_with.out)
    assert tune_with(out=tmp_path / "link")[0] == 130 and (tune_with.out / "ray").exists()
    moved = tune_with.out.rename(tmp_path / "moved")
    assert tune_with(out=moved)[0] == 130 and not (moved / "ray").exists()
    settings = json.loads((moved / "tune.json").read_text())
    assert settings["out"] == str(moved)
    monkeypatch.setattr(searchers, "check_searcher", lambda name: None)
    settings["options"]["searcher"] = "bohb"
    (moved / "tune.json").write_text(json.dumps(settings | {"out": "/before"}))
    (moved / "ray").mkdir()
    assert_one_line(tune_with("--searcher", "bohb", out=moved), "was begun in /before, where bohb", "another --out")
    assert (moved / "ray").exists()


def test_a_dataset_may_go_by_several_names(tune_with, write_dataset, monkeypatch, tmp_path):
    data, held_out = (write_dataset(tmp_path / name, [16, 16, 16], seed=seed) for seed, name in enumerate("dv"))
    assert tune_with("--validation", held_out, data=data)[0] == 130
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to(data)
    assert tune_with("--validation", "v", data="d")[0] == 130
    assert tune_with("--validation", "./v", data="link")[0] == 130
    other = write_dataset(tmp_path / "w", [16], seed=2)
    assert_one_line(tune_with("--validation", "w", data="d"), f"validation = {held_out}, not {other}")
    assert_one_line(tune_with(data="d"), f"validation = {held_out}, not None")


def test_a_search_from_before_there_was_around_goes_on_without(tune_with):
    assert tune_with()[0] == 130
    path = tune_with.out / "tune.json"
    settings = json.loads(path.read_text())
    assert settings["axes"]["kl"] == [1e-3, 1.0]
    del settings["options"]["around"]
    path.write_text(json.dumps(settings))
    assert tune_with()[0] == 130
    assert_one_line(tune_with("--around", 3), "around = None, not 3.0", "another --out")


def random_searcher(axes=None):
    axes = axes or axes_of(TINY)
    searcher = make_searcher("random", axes, point_of(TINY, axes), (1, 3, 9), seed=3)
    assert searcher.set_search_properties("score", "max", ray_space(axes))
    return searcher


def test_the_first_trial_has_the_presets_values_and_the_others_hang_on_their_number_alone(tmp_path):
    one, other = random_searcher(), random_searcher()
    ours = [one.suggest(f"a{i}") for i in range(4)]
    assert [point["number"] for point in ours] == [0, 1, 2, 3]
    assert {name: value for name, value in ours[0].items() if name != "number"} == point_of(TINY, axes_of(TINY))
    assert len({point["rgb"] for point in ours}) == 4
    theirs = [other.suggest(f"b{i}") for i in range(2)]
    for trial in ("b0", "b1"):
        other.on_trial_result(trial, {"step": 1, "score": 1.0})
        other.on_trial_complete(trial, {"step": 1, "score": 1.0})
    other.searcher.save(str(tmp_path / "state"))
    again = random_searcher()
    again.searcher.restore(str(tmp_path / "state"))
    again.set_state(other.get_state())
    assert theirs + [again.suggest(f"c{i}") for i in range(2)] == ours
    json.dumps(ours)


def ray_trial(number):
    return SimpleNamespace(trial_id=f"ray{number}", config={"number": number, "learning_rate": 1e-4 * (1 + number)})


def halving(results, spared=1):
    scheduler = Halving(results, (1, 3, 9), 3, spared)
    scheduler.set_search_properties("score", "max")
    return scheduler


def tell(scheduler, number, step, score, diverged=False):
    trial = ray_trial(number)
    result = {"number": number, "step": step, "score": score, "diverged": diverged}
    return scheduler.on_trial_result(None, trial, result)


def test_at_a_rung_the_best_third_goes_on_and_the_spared_ones_do(tmp_path):
    scheduler = halving(tmp_path / "none.jsonl", spared=2)
    for number in range(8):
        scheduler.on_trial_add(None, ray_trial(number))
    assert tell(scheduler, 2, 1, 30.0) == CONTINUE  # nobody to be compared with
    assert tell(scheduler, 3, 1, 20.0) == STOP
    assert tell(scheduler, 4, 1, 40.0) == CONTINUE
    assert tell(scheduler, 0, 1, 1.0) == CONTINUE and tell(scheduler, 1, 1, 2.0) == CONTINUE
    assert tell(scheduler, 5, 1, 10.0) == STOP
    assert tell(scheduler, 4, 2, 5.0) == CONTINUE  # between rungs
    assert tell(scheduler, 4, 3, 41.0) == CONTINUE and tell(scheduler, 2, 3, 31.0) == STOP
    assert tell(scheduler, 0, 9, 50.0) == STOP  # the end
    assert tell(scheduler, 6, 2, 0.0, diverged=True) == STOP


def test_a_search_that_goes_on_remembers_its_rungs(tmp_path):
    results = tmp_path / journal.JOURNAL
    for number, score in enumerate((10.0, 20.0, 30.0)):
        point = {"learning_rate": 1e-4 * (1 + number)}
        journal.append(results, {"kind": "begin", "trial": number, "point": point})
        journal.append(results, {"kind": "score", "trial": number, "step": 1, "score": score})
    journal.append(results, {"kind": "end", "trial": 1, "status": "stopped"})
    scheduler = halving(results)
    for number in (1, 2, 3, 4):
        scheduler.on_trial_add(None, ray_trial(number))
    assert tell(scheduler, 3, 1, 15.0) == STOP  # an empty rung would have let it go on
    assert tell(scheduler, 4, 1, 25.0) == CONTINUE
    assert tell(scheduler, 1, 1, 20.0) == STOP  # it had ended, and tells its scores again
    assert tell(scheduler, 2, 1, 30.0) == CONTINUE  # it had not
    journal.append(results, {"kind": "begin", "trial": 1, "point": {"learning_rate": 2e-4}})  # and was killed then
    scheduler = halving(results)
    scheduler.on_trial_add(None, ray_trial(1))
    assert tell(scheduler, 1, 1, 20.0) == STOP


def test_a_score_between_rungs_counts_nowhere_and_that_of_a_trial_that_diverged_at_the_next_rung_or_the_last():
    told = ((2, False), (3, False), (0, True), (3, True), (9, True))
    assert [budget_of(step, diverged, (1, 3, 9)) for step, diverged in told] == [None, 3, 1, 9, 9]


def test_trials_that_died_too_often_are_tried_again(tune_with, monkeypatch):
    searched = []
    monkeypatch.setattr(tune, "search", lambda options, data: searched.append(options.retries))
    assert tune_with("--trials", 2)[0] == 130
    results = tune_with.out / journal.JOURNAL
    for number, status in enumerate(("finished", "failed")):
        point = point_of(TINY, axes_of(TINY)) | {"rgb": 0.1 * (1 + number)}
        journal.append(results, {"kind": "begin", "trial": number, "point": point})
        journal.append(results, {"kind": "score", "trial": number, "step": TINY.steps, "score": 30.0})
        journal.append(results, {"kind": "end", "trial": number, "status": status})
    (tune_with.out / "ray").mkdir()
    assert tune_with("--trials", 2)[0] == 0 and len(searched) == 2 and (tune_with.out / "ray").exists()
    assert tune_with("--trials", 2, "--retries", 5)[0] == 0 and searched[-1] == 5
    assert not (tune_with.out / "ray").exists()  # which keeps to 3
    journal.append(results, {"kind": "end", "trial": 1, "status": "finished"})
    assert tune_with("--trials", 2, "--retries", 5)[0] == 0 and len(searched) == 3


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--trials", "0"], ["trials is 0", "at least 1"]),
        (["--trials", "3", "--unpruned", "4"], ["unpruned is 4 of 3"]),
        (["--reduction", "1"], ["reduction is 1", "at least 2"]),
        (["--steps", "8"], ["steps is 8", "too few for 2 rungs", "at least 9"]),
        (["--workers", "0"], ["workers is 0"]),
        (["--retries", "-1"], ["retries is -1"]),
        (["--around", "1"], ["around is 1", "above 1"]),
        (["--gpus-per-trial", "nan"], ["gpus-per-trial is nan"]),
        (["--searcher", "guess"], ["guess"]),
        (["--config", "/nowhere/best.json"], ["/nowhere/best.json", "cannot be read"]),
    ],
)
def test_options_that_cannot_be(tune_with, arguments, words):
    assert_one_line(tune_with(*arguments), *words)
    assert not (tune_with.out / "tune.json").exists()


def test_searchers_that_are_not_here(tune_with, monkeypatch):
    monkeypatch.setitem(sys.modules, "hpbandster", None)
    monkeypatch.setitem(sys.modules, "hebo", None)
    assert_one_line(tune_with("--searcher", "bohb"), "needs hpbandster", "pip install", "--searcher random")
    assert_one_line(tune_with("--searcher", "hebo"), "needs hebo", "pip install", "--searcher random")


def test_data_that_does_not_do(tune_with, write_dataset, tmp_path):
    assert_one_line(tune_with(data=tmp_path / "nowhere"), "nowhere")
    test_scene = write_dataset(tmp_path / "d", [12, 12], env_id="t3vip/TabletopD-v0")
    assert_one_line(tune_with(data=test_scene), "TabletopD-v0", "test scene")
    config = tmp_path / "gap.json"
    config.write_text('{"frame_gap": 7}')
    assert_one_line(tune_with("--config", config), "no episode is 22 frames long")
    config.write_text('{"minutes": 5}')
    assert_one_line(tune_with("--config", config), "has minutes", "--steps")


def test_a_folder_holds_one_search(tune_with, tmp_path):
    assert tune_with("--trials", 2)[0] == 130  # begun, and not finished
    assert tune_with("--trials", 2, "--workers", 3, "--retries", 1)[0] == 130
    assert_one_line(tune_with("--trials", 1), str(tune_with.out), "trials = 2, not 1", "another --out")
    assert_one_line(tune_with("--trials", 2, "--steps", 18), "steps = None, not 18")
    config = tmp_path / "gap.json"
    config.write_text('{"frame_gap": 2}')
    assert_one_line(tune_with("--trials", 2, "--config", config), "frame_gap = 3, not 2")
    config.write_text('{"losses": {"kl": 0.5}}')
    assert_one_line(tune_with("--trials", 2, "--config", config), "holds a search with losses.kl = 0.1, not 0.5;")
    config.write_text('{"losses": {"kl": 0.5, "knn": 0.1}, "frame_gap": 2}')
    every = ("losses.knn = 0.018, not 0.1; losses.kl = 0.1, not 0.5", "frame_gap = 3, not 2")
    assert_one_line(tune_with("--trials", 2, "--config", config), *every)
    config.write_text('{"save_every": 3}')
    assert tune_with("--trials", 2, "--config", config)[0] == 130  # how, not what
    settings = json.loads((tune_with.out / "tune.json").read_text())
    del settings["training"]["cuda_graphs"]  # as a search that was begun before there was such an option
    (tune_with.out / "tune.json").write_text(json.dumps(settings))
    assert tune_with("--trials", 2)[0] == 130
    (tune_with.out / "tune.json").write_text("{")
    assert_one_line(tune_with("--trials", 2), "tune.json", "is damaged")
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").touch()
    assert_one_line(tune_with(out=other), "something else", "another --out")
