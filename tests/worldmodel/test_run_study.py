"""`run-study`: an equal budget for each model, nothing done twice, and a table with the right numbers in it."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from data_collection.dataset import RGBDDataset
from envs.command import parse, run
from worldmodel import devices, evaluate, perceptual_weights, run_study, train
from worldmodel.budget import Cost
from worldmodel.checkpoint import load_model
from worldmodel.clips import ClipSource
from worldmodel.evaluate import EvaluationOptions
from worldmodel.held_out import ValidationSet
from worldmodel.perceptual_weights import WeightsUnavailable
from worldmodel.rollout import unroll
from worldmodel.study import paper, plan, report, training
from worldmodel.study.findings import findings
from worldmodel.study.options import StudyOptions
from worldmodel.train import parse_options

TINY = ["--preset", "tiny", "--samples", 0, "--clips", 4, "--no-vgg", "--device", "cpu"]
HORIZONS = ["--horizons", 2, 3]
HORIZON, GAP = 3, 3


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Three datasets as different as training, validation and test scenes."""
    from tests.worldmodel.conftest import write_squares

    folder = tmp_path_factory.mktemp("data")
    for seed, name in enumerate(("train", "validation", "test")):
        write_squares(folder / name, (20, 16, 16, 20), seed=seed, env_id=f"t3vip/Tabletop{'CCD'[seed]}-v0")
    return folder


@pytest.fixture
def study(data, tmp_path, capsys, monkeypatch):
    """Runs the command here, trainers too; gives exit code, stderr and the names of the runs that were trained."""
    trained = []

    def here(options, contestant, inherited):
        os.fstat(inherited)
        trained.append(contestant.run)
        train.main(parse_options(training.arguments_of(options, contestant)))
        return training.progress_of(options, contestant)

    monkeypatch.setattr(run_study, "train", here)

    def call(*arguments, name="table", out=tmp_path / "study", **folders):
        places = {part: folders.get(part, data / part) for part in ("train", "validation", "test")}
        line = [
            name,
            "--out",
            out,
            *TINY,
            *([] if "--horizons" in arguments else HORIZONS),
            *(w for part, path in places.items() for w in (f"--{part}", path)),
            *arguments,
        ]
        trained.clear()
        capsys.readouterr()
        try:
            run(StudyOptions, run_study.main, list(map(str, line)))
            code = 0
        except SystemExit as stop:
            code = stop.code
        return code, capsys.readouterr().err, list(trained)

    call.out = tmp_path / "study"
    return call


def document(out):
    return json.loads((out / "study.json").read_text())


def brute_force(folder, test, gap, clips=4):
    """PSNR per frame, of a model and of copying, from the definition."""
    model = load_model(folder)
    data = ValidationSet(ClipSource(RGBDDataset(test), gap), clips, 2 + HORIZON, 2, clips)
    ((batch, _),) = data.batches()
    with torch.inference_mode():
        predicted = unroll(model, batch, 2).stack("rgb")[:, 1:].clamp(0, 1)
    truth, copied = batch.rgb[:, 2:], batch.rgb[:, 1:2]
    return [(-10 * (x - truth).double().square().mean((0, 2, 3, 4)).log10()).tolist() for x in (predicted, copied)]


def test_two_models_are_trained_scored_and_put_beside_the_papers(study, data):
    command = ["--steps", 2, "--only", "cdna-gap3", "t3vip", "--gap", GAP]
    code, err, trained = study(*command)
    assert code == 0, err
    assert trained == ["cdna-gap3", "t3vip-gap3"]
    found = document(study.out)
    assert list(found["models"]) == trained and found["missing"] == ["sna-gap3", "sv2p-gap3"]
    for name in trained:
        entry = found["models"][name]
        model, copied = brute_force(study.out / "models" / name, data / "test", GAP)
        for horizon in (2, HORIZON):
            expected = np.mean(model[:horizon])
            assert entry["horizons"][str(horizon)]["psnr"] == pytest.approx(expected, abs=1e-3)
            copy = found["copy"][str(GAP)]["horizons"][str(horizon)]
            assert copy["psnr"] == pytest.approx(np.mean(copied[:horizon]), abs=1e-3)
        assert entry["training"]["steps"] == 2 and entry["training"]["minutes"] > 0
        weights = load_model(study.out / "models" / name).state_dict().values()
        assert entry["training"]["parameters"] == sum(value.numel() for value in weights)
    t3vip, cdna = found["models"]["t3vip-gap3"], found["models"]["cdna-gap3"]
    assert cdna["horizons"]["3"]["depth_rmse"] is None and t3vip["horizons"]["3"]["depth_rmse"] > 0
    assert t3vip["motion"]["flow3d_epe_moving_relative"] > 0 and cdna["motion"]["flow3d_epe_moving_relative"] is None
    assert t3vip["paper"] == dict(zip(paper.METRICS, (21.208, 0.779, 0.801, 0.125, 0.007), strict=True))
    text = (study.out / "study.md").read_text()
    row = next(line for line in text.splitlines() if line.startswith("| T3VIP |")).split("|")
    assert f"{t3vip['horizons']['3']['psnr']:.2f}" in row[2] and "21.21" in row[7] and "**" in row[7]
    assert "ours, Tabletop" in text and "paper, CALVIN" in text and "absolute values do not compare" in text
    assert all((study.out / picture).stat().st_size > 1000 for picture in ("curves.png", "bars.png"))

    assert t3vip["training"]["machine"] == devices.describe(torch.device("cpu"))
    for machine, words in (({"cpu": "Abacus", "cores": 10, "gpu": None}, "Abacus (10 cores)"), (None, "an unknown")):
        other = {**cdna, "training": cdna["training"] | {"machine": machine}}
        text = report.markdown(found | {"models": found["models"] | {"cdna-gap3": other}})
        assert f"on {words}" in text and " for cdna-gap3 and " in text

    written = (study.out / "scores" / "cdna-gap3" / "evaluation.json").stat().st_mtime_ns
    assert study("--steps", 2, "--only", "cdna", "--gap", GAP)[2] == []  # done is done
    assert (study.out / "scores" / "cdna-gap3" / "evaluation.json").stat().st_mtime_ns == written
    assert document(study.out)["models"] == found["models"]
    assert study("--steps", 2, "--only", "cdna", "--gap", GAP, "--clips", 3)[2] == []  # other scores of the same model
    assert (study.out / "scores" / "cdna-gap3" / "evaluation.json").stat().st_mtime_ns > written
    assert list(document(study.out)["models"]) == ["cdna-gap3"]  # t3vip's scores are of other clips

    for arguments, words in (
        ([*command[:1], 3, *command[2:-2]], ["steps = 2, not 3", "--out"]),
        (["--only", "cdna"], ["minutes = None, not 20.0", "--out"]),
    ):
        code, err, trained = study(*arguments, "--gap", GAP)
        assert code == 2 and not trained and all(word in err for word in words), err
    code, err, _ = study("--steps", 2, name="ablation")
    assert code == 2 and "holds the study 'table', not 'ablation'" in err


def test_what_lacks_vgg_is_scored_again_once_its_weights_are_there(study, random_vgg, monkeypatch):
    def gone():
        raise WeightsUnavailable("there is no network")

    cached = []
    monkeypatch.setattr(evaluate, "load_weights", gone)
    monkeypatch.setattr(perceptual_weights, "are_cached", lambda: bool(cached))
    command = ["--steps", 1, "--only", "t3vip", "--gap", GAP, "--vgg", "--samples", 2]
    assert study(*command)[::2] == (0, ["t3vip-gap3"])
    assert "; best of 2 by PSNR over all frames for" in (study.out / "study.md").read_text()
    scores = study.out / "scores" / "t3vip-gap3" / "evaluation.json"
    written = scores.stat().st_mtime_ns
    assert study(*command)[::2] == (0, []) and scores.stat().st_mtime_ns == written
    monkeypatch.setattr(evaluate, "load_weights", lambda: random_vgg)
    cached.append(True)
    assert study(*command)[::2] == (0, [])
    assert "; best of 2 by VGG over all frames for" in (study.out / "study.md").read_text()
    found = document(study.out)["models"]
    assert found["t3vip-gap3"]["curves"]["vgg"] and scores.stat().st_mtime_ns > written
    other = {**found["t3vip-gap3"], "prediction": "best of 2 by PSNR"}
    text = report.markdown(document(study.out) | {"models": found | {"sv2p-gap3": other}})
    assert "best of 2 by VGG for t3vip-gap3 and best of 2 by PSNR for sv2p-gap3 over all frames" in text


def test_models_are_trained_by_the_clock(study, monkeypatch):
    monkeypatch.setattr(train, "measure_cost", lambda make, options: Cost(step=1.999, validation=0, checkpoint=0))
    code, err, trained = study("--minutes", 0.1, "--only", "cdna", "--gap", GAP)
    assert code == 0 and trained == ["cdna-gap3"], err
    entry = document(study.out)["models"]["cdna-gap3"]
    assert entry["training"]["steps"] == 3 and "--minutes 0.1" in entry["command"]
    assert json.loads((study.out / "models/cdna-gap3/config.json").read_text())["steps"] == 3


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--only", "dreamer"], ["no model 'dreamer'", "t3vip-gap1"]),
        (["--minutes", "0"], ["minutes is 0.0", "positive"]),
        (["--horizons", "0"], ["horizons is (0,)"]),
        (["--horizons", "18"], ["no test episode is 58 frames long", "longest has 20", "--horizons"]),
    ],
)
def test_what_cannot_be_is_said_before_the_first_training(study, arguments, words):
    code, err, trained = study(*arguments)
    assert code == 2 and not trained and err.count("\n") == 1 and all(word in err for word in words), err


def test_test_data_is_never_trained_on(study, data):
    for part in ("train", "validation"):
        code, err, trained = study("--steps", 1, **{part: data / "test"})
        assert code == 2 and not trained and f"4 of the 4 episodes of {data / 'test'}" in err


@pytest.fixture
def options(data, tmp_path):
    line = ["ablation", "--out", tmp_path / "study", *TINY, "--steps", 9]
    line += [word for part in ("train", "validation", "test") for word in (f"--{part}", data / part)]
    return parse(StudyOptions, list(map(str, line)))


def test_the_terms_of_m1_to_m6_are_the_papers(options):
    terms = {}
    for contestant in options.contestants:
        told = parse_options(training.arguments_of(options, contestant))
        weights = told.losses
        assert weights.rgb > 0 and weights.depth > 0 and told.frame_gap == 3 and told.seed == options.seed
        knn, scene, optical = (w > 0 for w in (weights.knn, weights.scene_smoothness, weights.optical_smoothness))
        terms[contestant.name] = (knn, scene, optical, told.model == "t3vip" and weights.kl > 0)
    no, yes = False, True
    assert terms == {
        "M1": (no, no, no, no),
        "M2": (no, yes, no, no),
        "M3": (yes, no, no, no),
        "M4": (yes, yes, no, no),
        "M5": (yes, yes, yes, no),
        "M6": (yes, yes, yes, yes),
    }


def test_models_of_a_study_differ_in_nothing_but_what_is_studied(options):
    for name in plan.STUDIES:
        chosen = replace(options, study=name, gap=())
        told = [parse_options(training.arguments_of(chosen, c)) for c in chosen.contestants]
        assert len({(c.run) for c in chosen.contestants}) == len(told)
        if name == "action-free":
            assert not any(one.architecture.act_cond for one in told)
            assert [one.model for one in told] == ["sv2p", "t3vip-d", "t3vip"]
        else:
            assert all(one.architecture.act_cond for one in told)
        if name == "table":
            assert {(one.model, one.frame_gap) for one in told} == {
                (model, gap) for model in ("cdna", "sna", "sv2p", "t3vip") for gap in (1, 3)
            }
        first = told[0]
        for one in told:
            same = replace(
                first, model=one.model, frame_gap=one.frame_gap, losses=one.losses, architecture=one.architecture,
                out=one.out,
            )  # fmt: skip
            assert one == same
            assert one.losses.power == (1 if one.model.startswith("t3vip") else 2)  # the rivals' papers'
            assert name == "ablation" or one.losses == replace(first.losses, power=one.losses.power)


def test_findings_name_who_is_ahead_and_who_is_not():
    def scores(psnr, **others):
        return {"10": dict.fromkeys(("psnr", "ssim", "vgg", "depth_rmse", "depth_absrel")) | {"psnr": psnr} | others}

    def entry(name, gap, horizons):
        return {"name": name, "title": name.upper(), "frame_gap": gap, "horizons": horizons, "motion": {}}

    models = {
        "a": entry("cdna", 3, scores(20.0)),
        "b": entry("sv2p", 3, scores(23.5, ssim=0.7)),
        "c": entry("t3vip", 3, scores(22.0, ssim=0.8, depth_rmse=0.2)),
    }
    document = {
        "study": "table", "models": models, "settings": {"horizons": [10]},
        "copy": {"3": {"horizons": scores(20.5, ssim=0.6, depth_rmse=0.1)}},
    }  # fmt: skip
    rivals, copied = findings(document)
    assert "ahead of its rivals in 2 of 3" in rivals
    assert "not ahead of SV2P in PSNR at gap 3, 10 frames (23.500 against 22.000)" in rivals and "CDNA" not in rivals
    assert "CDNA in PSNR" in copied and "T3VIP in depth RMSE" in copied and "SV2P" not in copied
    models["b"]["latents_zero"], models["a"]["latents_zero"], models["c"]["latents_zero"] = scores(21.0), None, None
    _, single, _ = findings(document)
    assert single == "With latents at 0, " + rivals.replace("2 of 3", "2 of 2").split(";")[0] + "."
    flow = {"M1": 0.9, "M2": 1.0, "M3": 0.3, "M4": 0.2, "M5": 0.2, "M6": 0.1}
    document["study"] = "ablation"
    document["models"] = {
        name: entry(name, 3, scores(20 + i)) | {"motion": {"flow3d_epe_moving_relative": flow[name]}}
        for i, name in enumerate(flow)
    }
    order, motion, _ = findings(document)
    assert "M1 < M2 < M3 < M4 < M5 < M6;" in order
    assert "M3, M4, M5, M6; did not: M1, M2" in motion


def test_the_papers_numbers_are_found_for_the_data_that_stands_in_for_theirs():
    t3vip = plan.STUDIES["table"].contestants((1,))[-1]
    assert paper.numbers_of("table", t3vip, "t3vip/TabletopD-v0")["psnr"] == 22.692
    assert paper.numbers_of("table", t3vip, "t3vip/DexHand-v0")["psnr"] == 23.153
    assert paper.numbers_of("table", t3vip, "t3vip/PlanarPush-v0")["psnr"] == 24.261
    assert paper.numbers_of("table", replace(t3vip, gap=2), "t3vip/TabletopD-v0") is None
    m1, *_, m6 = plan.STUDIES["ablation"].contestants()
    assert set(paper.numbers_of("ablation", m1, "t3vip/TabletopD-v0").values()) == {None}
    assert paper.numbers_of("ablation", m6, "t3vip/TabletopD-v0")["psnr"] == 26.05
    assert paper.setting_of("action-free", 3, "t3vip/TabletopD-v0") is None
    assert EvaluationOptions(Path("d")).context == 2


def test_a_study_that_is_killed_leaves_no_trainer_behind_and_goes_on_where_it_was(data, tmp_path):
    out, steps = tmp_path / "study", 40
    line = ["table", "--out", out, *TINY, *HORIZONS, "--steps", steps, "--only", "cdna", "--gap", GAP]
    line += [word for part in ("train", "validation", "test") for word in (f"--{part}", data / part)]
    environment = os.environ | {"TORCHDYNAMO_DISABLE": "1", "OMP_NUM_THREADS": "1"}

    def start():
        return subprocess.Popen(
            [sys.executable, "-m", "worldmodel.run_study", *map(str, line)],
            env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def logged():
        path = out / "models" / "cdna-gap3" / "metrics.jsonl"
        lines = path.read_text().split("\n")[:-1] if path.exists() else []
        return [entry["step"] for entry in map(json.loads, lines) if entry["kind"] == "train"]

    killed = start()
    while not logged():
        assert killed.poll() is None, killed.communicate()
        time.sleep(0.02)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()  # ends when nobody holds its pipes any more: the trainer is gone too
    assert 0 < len(logged()) < steps
    again = start()
    printed, err = again.communicate()
    assert again.returncode == 0, err
    assert logged() == list(range(1, steps + 1))  # the trainer saved when its parent died: no step was done twice
    assert "trained: 40 steps" in printed and list(document(out)["models"]) == ["cdna-gap3"]


def test_a_study_may_have_any_name(study, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    code, err, trained = study("--steps", 2, "--only", "cdna", "--gap", GAP, out="copy-of-a-table")
    assert (code, trained) == (0, ["cdna-gap3"]), err
    assert document(tmp_path / "copy-of-a-table")["models"]["cdna-gap3"]["training"]["steps"] == 2


def test_a_config_file_changes_the_options_of_all_models(study, data, tmp_path):
    config = tmp_path / "weights.json"
    config.write_text('{"losses": {"depth": 0.2}, "learning_rate": 0.002}')
    code, _, trained = study("--steps", 2, "--gap", 1, "--only", "cdna", "t3vip", "--config", config)
    assert (code, trained) == (0, ["cdna-gap1", "t3vip-gap1"])
    for run_name in trained:
        options = json.loads((tmp_path / "study" / "models" / run_name / "config.json").read_text())
        assert (options["losses"]["depth"], options["learning_rate"]) == (0.2, 0.002)
    written = (tmp_path / "study" / "study.md").read_text()
    assert '{"losses": {"depth": 0.2}, "learning_rate": 0.002}' in written
    assert study("--config", tmp_path / "none.json")[0] == 2
