"""`evaluate-worldmodel`: a table and its numbers; mistakes are one line."""

import json
from dataclasses import replace

import pytest

from envs.command import run
from worldmodel.checkpoint import save_model
from worldmodel.evaluate import EvaluationOptions, main
from worldmodel.t3vip import T3VIP


@pytest.fixture
def evaluate(tiny_dataset, tmp_path):
    def call(*models, data=tiny_dataset, arguments=()):
        fixed = ["--out", tmp_path / "out", "--predicted", 2, "--clips", 3]
        line = ["--data", data, "--models", *models, *fixed, *arguments]
        run(EvaluationOptions, main, list(map(str, line)))

    return call


def test_every_model_is_scored_with_and_without_its_motion(evaluate, make_model, tmp_path, capsys):
    for seed in (0, 1):
        save_model(make_model(seed=seed), tmp_path / f"model{seed}", {})
    names = [str(tmp_path / f"model{seed}") for seed in (0, 1)]
    evaluate(*names)
    document = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert set(document["models"]) == {name + kind for name in names for kind in ("", " without motion")}
    for name in names:
        moving, still = document["models"][name], document["models"][f"{name} without motion"]
        assert len(moving["psnr"]) == 2 and moving["copy_psnr"] == still["copy_psnr"]
        assert still["psnr"] == pytest.approx(still["copy_psnr"], abs=0.05) and moving["psnr"] != still["psnr"]
    assert document["models"][names[0]] != document["models"][names[1]]
    table = capsys.readouterr().out
    assert table.count("RGB PSNR") == 4 and f"{document['models'][names[0]]['psnr'][1]:7.3f}" in table


def test_mistakes_are_one_line(evaluate, make_model, write_dataset, camera_of, tmp_path, capsys):
    model = make_model()
    save_model(model, tmp_path / "model", {})
    fewer = {"action_dim": 5, "action_mean": (0.0,) * 5, "action_std": (1.0,) * 5}
    save_model(T3VIP(model.config, replace(model.context, **fewer)), tmp_path / "other", {})
    wide = write_dataset(tmp_path / "wide", [16], camera_of(32, 16))
    for call, words in (
        (lambda: evaluate("/nowhere"), "no model at '/nowhere'"),
        (lambda: evaluate(tmp_path / "other"), "takes actions of 5 numbers"),
        (lambda: evaluate(tmp_path / "model", data=wide), "wants pictures of 16x24"),
        (lambda: evaluate(tmp_path / "model", data=tmp_path / "nothing"), "no dataset folder"),
        (lambda: evaluate(tmp_path / "model", arguments=["--device", "abacus"]), "device 'abacus'"),
        (lambda: evaluate(tmp_path / "model", arguments=["--predicted", "0"]), "predicted is 0"),
        (lambda: evaluate(tmp_path / "model", arguments=["--predicted", "50"]), "no episode is"),
    ):
        with pytest.raises(SystemExit) as end:
            call()
        error = capsys.readouterr().err
        assert end.value.code == 2 and words in error and error.count("\n") == 1, error
