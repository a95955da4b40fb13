"""A world model learns from imported data as from collected."""

import json

import numpy as np
import pytest
import torch
from commands import call
from layouts import write_calvin, write_dexhand, write_omnipush

from envs.command import run
from worldmodel import evaluate, train
from worldmodel.evaluate import EvaluationOptions
from worldmodel.train import TrainOptions

WRITERS = {
    "calvin": lambda root: write_calvin(root / "task_D_D", [(0, 13), (20, 33), (40, 53)]),
    "dexhand": lambda root: write_dexhand(root, 3, 14),
    "omnipush": lambda root: write_omnipush(root, pushes=2),
}
TINY = ("--preset", "tiny", "--steps", "2", "--batch", "2", "--validation-clips", "2", "--device", "cpu")


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Compiling and drawing take longer than two steps."""
    monkeypatch.setattr("worldmodel.trainer.picture_prediction", lambda *_: None)
    with torch.compiler.set_stance("force_eager"):
        yield


@pytest.mark.parametrize("form", WRITERS)
def test_training_and_evaluation_take_imported_data(tmp_path, form):
    source, data, out = WRITERS[form](tmp_path / "source"), tmp_path / "data", tmp_path / "run"
    assert call("import-dataset", ["--format", form, source, data, "--image-size", "16", "--workers", "1"])[0] == 0
    run(TrainOptions, train.main, ["--data", str(data), "--out", str(out), *TINY], train._preset)
    context = json.loads((out / "model" / "config.json").read_text())["context"]
    assert context["env_id"].startswith(form) and len(context["action_mean"]) == {"calvin": 7, "dexhand": 24}.get(
        form, 3
    )
    if form == "calvin":
        scores = ("--data", data, "--models", out, "--out", out, "--clips", "2", "--predicted", "2", "--no-vgg")
        run(EvaluationOptions, evaluate.main, list(map(str, scores)))
        (row, *_) = json.loads((out / "evaluation.json").read_text())["models"].values()
        assert np.isfinite(row["psnr"]) and 0 < row["depth_rmse"] < 3
