"""`evaluate-worldmodel`: tables and numbers that are known; mistakes are one line."""

import json
from dataclasses import replace

import pytest
import torch

from data_collection.dataset import RGBDDataset
from envs.command import parse, run
from worldmodel import evaluate as command
from worldmodel import evaluation_report, measurement
from worldmodel.checkpoint import save_model
from worldmodel.evaluate import EvaluationOptions, main
from worldmodel.inference import inference_network
from worldmodel.kernels import SV2P
from worldmodel.perceptual_weights import WeightsUnavailable
from worldmodel.scores import SCORES
from worldmodel.t3vip import T3VIP

MOTION = ("flow3d_epe_moving_relative", "flow3d_epe_hand_relative", "tracking_error")


@pytest.fixture
def evaluate(tiny_dataset, tmp_path):
    def call(*models, data=tiny_dataset, arguments=("--no-vgg",)):
        fixed = ["--out", tmp_path / "out", "--predicted", 2, "--clips", 3]
        line = ["--data", data, "--models", *models, *fixed, *arguments]
        run(EvaluationOptions, main, list(map(str, line)))
        return json.loads((tmp_path / "out" / "evaluation.json").read_text())

    return call


@pytest.fixture
def model_folder(make_model, tmp_path):
    save_model(make_model(), tmp_path / "model", {})
    return str(tmp_path / "model")


def rival(model, **context) -> SV2P:
    torch.manual_seed(0)
    return SV2P(model.config, replace(model.context, **context)).eval()


def test_a_model_whose_transforms_do_nothing_scores_as_copying(evaluate, model_folder, capsys):
    document = evaluate(model_folder, arguments=["--no-vgg", "--without-motion"])
    assert list(document["models"]) == [model_folder, "copy"]
    moving, copy = document["models"][model_folder], document["models"]["copy"]
    still = moving["without_motion"]
    for name in ("psnr", "ssim", "depth_rmse", "depth_absrel", *MOTION, "flow3d_epe_moving", "flow2d_epe_moving"):
        assert still[name] == pytest.approx(copy[name], rel=5e-3), name
        assert moving[name] != pytest.approx(copy[name], rel=5e-3), name
    assert [copy[name] for name in MOTION] == [1, 1, 1]
    assert copy["false_flow_m"] == copy["disocclusion_f1"] == copy["inpainted"] == copy["motion_ari"] == 0
    assert len(moving["curves"]["psnr"]) == 2 and moving["psnr"] == pytest.approx(sum(moving["curves"]["psnr"]) / 2)
    low, high = moving["intervals"]["psnr"]
    less = moving["less"]["copy"]["psnr"]
    assert less["difference"] == pytest.approx(moving["psnr"] - copy["psnr"]) and len(less["interval"]) == 2
    assert low <= moving["psnr"] <= high and moving["prediction"] == "latents at 0" and moving["latents"] is None
    report = capsys.readouterr().out
    assert f"| {model_folder}, latents at 0 | {moving['psnr']:.2f}" in report and "| copy |" in report
    assert f"| {model_folder}, without motion |" in report and "Motion against the simulator" in report
    assert f"| {model_folder} less copy | {less['difference']:+.2f} [" in report


def test_best_of_samples_beside_latents_at_0_and_the_posterior(evaluate, make_model, tmp_path, capsys):
    model = make_model()
    torch.nn.init.normal_(model.encoder.join.weight, std=0.5)
    network = inference_network(model)
    torch.nn.init.constant_(network.heads.bias, 0.0)
    torch.nn.init.normal_(network.heads.weight, std=0.3)
    save_model(model, tmp_path / "t3vip", {}, network)
    save_model(rival(model, frame_gap=1), tmp_path / "sv2p", {})
    names = [str(tmp_path / name) for name in ("t3vip", "sv2p")]
    document = evaluate(*names, arguments=["--no-vgg", "--samples", 6, "--batch", 2])
    models = document["models"]
    assert list(models) == [*names, "copy at gap 1", "copy at gap 3"]
    assert models["copy at gap 1"]["psnr"] > models["copy at gap 3"]["psnr"]
    ours, theirs = (models[name] for name in names)
    for entry in (ours, theirs):  # latents at 0 may beat six samples in one clip, hardly on average
        assert entry["prediction"] == "best of 6 by PSNR" and entry["psnr"] != entry["latents_zero"]["psnr"]
    assert ours["flow3d_epe_moving"] == ours["latents_zero"]["flow3d_epe_moving"] > 0
    assert ours["latents"]["units"] == 6 and ours["latents"]["active"] == 6 and ours["latents"]["kl_nats"] > 0
    gain = ours["posterior"]["psnr"] - ours["latents_zero"]["psnr"]
    assert ours["latents"]["psnr_gap"] == pytest.approx(gain)
    pictures_only = {"psnr", "ssim"}
    assert {s.name for s in SCORES if theirs[s.name] is not None} == pictures_only and theirs["latents"] is None
    assert (theirs["frame_gap"], ours["frame_gap"]) == (1, 3)
    report = (tmp_path / "out" / "evaluation.md").read_text()
    assert report.strip() in capsys.readouterr().out and "best of 6 by PSNR" in report and "6 of 6" in report
    assert "the best sample is chosen by PSNR" in report and "–" in report
    assert (tmp_path / "out" / "curves.png").stat().st_size > 5000
    again = evaluate(*names, arguments=["--no-vgg", "--samples", 6, "--batch", 3])
    assert again["models"][names[1]]["psnr"] == pytest.approx(theirs["psnr"], abs=1e-3)


@pytest.fixture
def count_batches(monkeypatch):
    """Counts the batches that are measured from here on; the one after `stop_after` is never done."""

    def start(stop_after=None):
        counts = []

        def measure(*arguments):
            if len(counts) == stop_after:
                raise OSError("the machine is gone")
            counts.append(1)
            return predicted(*arguments)

        monkeypatch.setattr(measurement, "_predicted", measure)
        return counts

    predicted = measurement._predicted
    return start


def test_a_killed_evaluation_goes_on_where_it_was(evaluate, make_model, tmp_path, count_batches):
    model = make_model()
    save_model(model, tmp_path / "model", {}, inference_network(model))
    name, kept = str(tmp_path / "model"), tmp_path / "out" / "measured"
    arguments = ["--no-vgg", "--samples", 2, "--batch", 1]

    counts = count_batches()
    whole = evaluate(name, arguments=arguments)
    assert len(counts) == 3 and not kept.exists()

    def die_after(batches):
        count_batches(stop_after=batches)
        with pytest.raises(OSError, match="gone"):
            evaluate(name, arguments=arguments)
        return sorted(kept.glob("*/*.safetensors"))

    die_after(2)
    counts = count_batches()
    assert evaluate(name, arguments=arguments) == whole and len(counts) == 1 and not kept.exists()

    for damaged in die_after(2):
        damaged.write_bytes(damaged.read_bytes()[:100])
    counts = count_batches()
    assert evaluate(name, arguments=arguments) == whole and len(counts) == 3

    die_after(2)
    save_model(make_model(masks=3), tmp_path / "model", {}, inference_network(model))
    counts = count_batches()
    assert evaluate(name, arguments=arguments) != whole and len(counts) == 3, "another model"
    die_after(2)
    counts = count_batches()
    evaluate(name, arguments=[*arguments, "--seed", 1])
    assert len(counts) == 3, "other latents"


def test_vgg_scores_and_the_choice_by_them(evaluate, model_folder, monkeypatch, random_vgg):
    monkeypatch.setattr(command, "load_weights", lambda: random_vgg)
    document = evaluate(model_folder, arguments=["--samples", 2, "--frame-gap", 1, "--predicted", 1])
    entry, copy = document["models"][model_folder], document["models"]["copy"]
    assert document["protocol"]["select"] == "vgg" and entry["prediction"] == "best of 2 by VGG"
    assert entry["frame_gap"] == copy["frame_gap"] == 1 and len(entry["curves"]["vgg"]) == 1
    for scores in (entry, copy, entry["latents_zero"]):
        assert 0 < scores["vgg"] < 1 and 0 < scores["vgg_cosine"] < 1


def test_without_the_weights_everything_else_is_scored(evaluate, model_folder, monkeypatch, capsys):
    def unavailable():
        raise WeightsUnavailable("there is no network")

    monkeypatch.setattr(command, "load_weights", unavailable)
    document = evaluate(model_folder, arguments=[])
    entry = document["models"][model_folder]
    assert entry["vgg"] is None and entry["vgg_cosine"] is None and entry["ssim"] is not None
    assert "VGG scores are left out: there is no network" in capsys.readouterr().out


def test_the_report_says_that_a_model_was_trained_on_the_data(evaluate, make_model, tiny_dataset, tmp_path):
    model, name = make_model(), str(tmp_path / "seen")
    model.context = replace(model.context, control_rate=10.0)
    save_model(model, tmp_path / "seen", {"data": {"train": RGBDDataset(tiny_dataset).content_hash}})
    rate, seen = evaluate(name)["protocol"]["notes"][:-1]  # the last is about VGG
    assert rate.endswith("was trained on 10") and seen.startswith(f"{name} was trained on this data")
    report = (tmp_path / "out" / "evaluation.md").read_text()
    assert rate in report and seen in report
    save_model(model, tmp_path / "seen", {"data": {"validation": RGBDDataset(tiny_dataset).content_hash}})
    assert any(note.startswith(f"{name} was chosen by") for note in evaluate(name)["protocol"]["notes"])


def test_one_model_may_be_called_by_either_name():
    options = [parse(EvaluationOptions, ["--data", "d", name, "sv2p"]) for name in ("--model", "--models")]
    assert options[0] == options[1] and options[0].models == ("sv2p",)


def test_mistakes_are_one_line(evaluate, model_folder, make_model, write_dataset, camera_of, tmp_path, capsys):
    model = make_model()
    fewer = {"action_aggregation": ("sum",) * 5, "action_scale": (1.0,) * 5}
    fewer |= {"action_dim": 5, "action_mean": (0.0,) * 5, "action_std": (1.0,) * 5}
    save_model(T3VIP(model.config, replace(model.context, **fewer)), tmp_path / "other", {})
    wide = write_dataset(tmp_path / "wide", [16], camera_of(32, 16))
    near = write_dataset(tmp_path / "near", [16], camera_of(near=0.1, far=1.0))
    for call, words in (
        (lambda: evaluate("/nowhere"), "no model at '/nowhere'"),
        (lambda: evaluate(model_folder, tmp_path / "other"), "has action size 7, not 5"),
        (lambda: evaluate(model_folder, data=wide), "image size (16, 32), not (16, 24)"),
        (lambda: evaluate(model_folder, data=near), "depth range (0.1, 1.0), not (1.0, 3.0)"),
        (lambda: evaluate(model_folder, data=tmp_path / "nothing"), "no dataset folder"),
        (lambda: evaluate(model_folder, arguments=["--device", "abacus"]), "device 'abacus'"),
        (lambda: evaluate(model_folder, arguments=["--predicted", "0"]), "predicted is 0"),
        (lambda: evaluate(model_folder, arguments=["--predicted", "50"]), "no episode is"),
        (lambda: evaluate(model_folder, arguments=["--samples", "-1"]), "samples is -1"),
        (lambda: evaluate(model_folder, arguments=["--frame-gap", "0"]), "frame-gap is 0"),
    ):
        with pytest.raises(SystemExit) as end:
            call()
        error = capsys.readouterr().err
        assert end.value.code == 2 and words in error and error.count("\n") == 1, error


def test_a_model_may_be_called_like_its_way_of_predicting():
    models = {"deterministic": {"prediction": "deterministic"}, "copy": {"prediction": "copy"}}
    assert [title for title, _ in evaluation_report._rows(models)] == ["deterministic, deterministic", "copy"]
