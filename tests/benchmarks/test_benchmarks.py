"""The benchmarks run and are fair: what they compare with gives the same results as what they time."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.benchmarks import plain, series
from tests.benchmarks.subjects import scaling
from tests.benchmarks.subjects.losses import clouds
from tests.benchmarks.subjects.training import make_trainer
from worldmodel import geometry, losses, splatting

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def eager():
    with torch.compiler.set_stance("force_eager"):
        yield


def bench(*arguments):
    command = [sys.executable, "-m", "tests.benchmarks", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=240)


def test_list_names_what_others_build_on():
    listed = bench("--list")
    names = {line.split()[0] for line in listed.stdout.splitlines()}
    assert listed.returncode == 0
    assert names >= {"scaling", "tabletop_rgbd_steps", "rgbd_frames", "train_step", "knn_loss", "plan_action"}


def test_quick_run_writes_results_and_machine(tmp_path):
    ran = bench("--quick", "--only", "splat", "--out", tmp_path / "new" / "bench.json")
    assert ran.returncode == 0, ran.stderr
    (result,) = json.loads((tmp_path / "new" / "bench.json").read_text())
    assert set(result) == {"name", "value", "unit", "against", "ratio"}
    assert result["name"] == "splat" and result["unit"] == "ms" and isinstance(result["against"], str)
    assert result["value"] > 0 and result["ratio"] > 0 and "splat" in ran.stdout
    machine = json.loads((tmp_path / "new" / "bench-machine.json").read_text())
    assert machine["cores"] >= 1 and machine["quick"] and machine["versions"]["torch"]


def test_every_point_of_the_series_has_a_precision_whose_speed_is_measured():
    for preset in ("tiny", "cpu", "paper"):
        points = series._points(preset, quick=False).values()
        assert {point["precision"] for point in points} == set(series.SIZES["precision"])
        assert set(series.SIZES["precision"]) < scaling.peaks(size=16, megabytes=1, repeats=1).keys()


def test_what_a_step_must_take_at_least():
    options = {"preset": "tiny", "width": 0.25, "precision": "float32", "repeats": 1}
    one, two = (scaling.step(batch=batch, frames=4, **options) for batch in (1, 2))
    assert two["gflop"] == pytest.approx(2 * one["gflop"], rel=0.01)  # FLOPs are of the clips
    assert 1.5 * one["gb_least"] < two["gb_least"] < 2 * one["gb_least"]  # weights are read once
    assert one["gb_least"] < one["gb_all"] and one["seconds"] > 0
    shares = scaling.shares(batch=1, frames=4, **options)
    assert sum(shares.values()) == pytest.approx(1) and shares["convolutions, backward"] > 0
    assert shares["splatting"] > 0 and shares["other"] < 0.8


def test_unknown_benchmark_is_one_line():
    refused = bench("--only", "nonsense")
    assert refused.returncode == 2 and "nonsense" in refused.stderr and refused.stderr.count("\n") == 1


def test_unfolding_finds_the_same_neighbours():
    moved, target = (cloud.requires_grad_() for cloud in clouds(2, 12))
    answers = []
    for knn in (losses.knn_alignment, plain.knn_alignment):
        loss = knn(moved, target, 2)
        answers.append((loss, *torch.autograd.grad(loss, (moved, target))))
    for ours, theirs in zip(*answers, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-7)


def test_a_matrix_of_distances_is_the_same_chamfer_distance():
    moved, target = (cloud.requires_grad_() for cloud in clouds(2, 12))
    answers = []
    for chamfer in (losses.chamfer_alignment, plain.chamfer_alignment):
        loss = chamfer(moved, target)
        answers.append((loss, *torch.autograd.grad(loss, (moved, target))))
    for ours, theirs in zip(*answers, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-7)


def test_corner_by_corner_lands_in_the_same_place():
    rng = torch.Generator().manual_seed(0)
    values, depth = torch.rand((2, 4, 8, 10), generator=rng), torch.rand((2, 1, 8, 10), generator=rng) - 0.1
    pixels = geometry.pixel_grid(8, 10) + 2 * torch.randn((2, 2, 8, 10), generator=rng)
    ours = splatting.splat(values, pixels, depth, "average")
    theirs = plain.splat_average(values, pixels, depth)
    for mine, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-4, atol=1e-5)


def test_plain_training_step_has_the_same_losses():
    terms = {}
    for kind in ("ours", "plain"):
        trainer = make_trainer(kind, "tiny", batch=2, precision="float32")
        torch.nn.init.normal_(
            trainer.model.transforms.last.weight, std=0.01, generator=torch.Generator().manual_seed(0)
        )
        clips = trainer.next_clips()
        if kind == "plain":
            with plain.plain_operators():
                terms[kind] = trainer.differentiate(trainer.inputs(clips))
        else:
            terms[kind] = trainer.differentiate(trainer.inputs(clips))
    assert set(terms["ours"]) > {"rgb", "depth", "knn", "scene_smoothness", "optical_smoothness", "kl"}
    for name, value in terms["ours"].items():
        np.testing.assert_allclose(terms["plain"][name], value, rtol=2e-3, err_msg=name)


def test_plain_cdna_has_the_same_losses():
    terms = {}
    for kind in ("ours", "plain"):
        trainer = make_trainer(kind, "tiny", model="cdna", batch=2, precision="float32")
        terms[kind] = trainer.differentiate(trainer.inputs(trainer.next_clips()))
    assert terms["ours"].keys() == terms["plain"].keys() == {"loss", "rgb"}
    np.testing.assert_allclose(terms["plain"]["rgb"], terms["ours"]["rgb"], rtol=2e-3)
