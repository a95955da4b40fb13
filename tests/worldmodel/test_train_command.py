"""`train-worldmodel`: what a run leaves, that killing it costs little, and that mistakes are one line."""

import json
import multiprocessing
import os
import signal
import time
from os.path import relpath

import h5py
import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from envs.command import run
from envs.files import locked
from envs.planar_push.objects import SPLITS
from worldmodel import devices
from worldmodel.checkpoint import load_model
from worldmodel.options import PRESETS, TrainOptions
from worldmodel.train import _preset, main

STEPS, SAVE_EVERY = 20, 5
LONG_RUN = ["--steps", STEPS, "--save-every", SAVE_EVERY, "--validate-every", 10, "--batch", 2]


@pytest.fixture
def train(capsys, tiny_dataset, tmp_path):
    """Runs the command in this process; returns the exit code and what it wrote to stderr."""

    def call(*arguments, preset="tiny", data=tiny_dataset, out=tmp_path / "run"):
        line = ["--preset", preset, "--data", data, "--out", out, *arguments]
        capsys.readouterr()
        try:
            run(TrainOptions, main, list(map(str, line)), _preset)
            return 0, capsys.readouterr().err
        except SystemExit as stop:
            return stop.code, capsys.readouterr().err

    return call


def assert_one_line(result, *words):
    code, err = result
    lines = [line for line in err.splitlines() if line.startswith("error: ")]
    assert code == 2 and len(lines) == 1 and "Traceback" not in err, err
    for word in words:
        assert word in lines[0], f"{word!r} is not in {lines[0]!r}"


def metrics(out):
    """The lines that are whole: a process may have been killed in the middle of one."""
    path = out / "metrics.jsonl"
    return [json.loads(line) for line in path.read_text().split("\n")[:-1]] if path.exists() else []


def logged_step(out):
    return max((line["step"] for line in metrics(out)), default=0)


def saved_step(out):
    return max((int(p.name[5:]) for p in (out / "checkpoints").glob("step-????????")), default=0)


def final_weights(out):
    return load_file(out / "checkpoints" / f"step-{STEPS:08d}" / "training.safetensors")


def test_a_run_leaves_metrics_pictures_and_a_model_and_is_then_done(train, tiny_dataset, tmp_path):
    out, command = tmp_path / "run", ["--steps", 4, "--validate-every", 2, "--save-every", 3, "--batch", 2]
    assert train(*command)[0] == 0
    lines = metrics(out)
    assert [line["step"] for line in lines if line["kind"] == "train"] == [1, 2, 3, 4]
    assert [line["step"] for line in lines if line["kind"] == "validation"] == [2, 4]
    assert {"loss", "rgb", "depth", "knn", "kl", "data_wait"} <= lines[-2].keys()
    assert len(list((out / "pictures").glob("*.png"))) == 2 and list((out / "tensorboard").glob("events*"))
    model = load_model(out)
    assert model.context.env_id == "some/Squares-v0"
    origin = json.loads((out / "model" / "config.json").read_text())["origin"]
    assert origin["options"]["steps"] == 4 and len(origin["data"]["train"]) == 64
    assert not list(out.rglob("*.tmp"))
    assert train(*command)[0] == 0 and metrics(out) == lines  # the same command again has nothing to do
    assert train(*command, "--data", relpath(tiny_dataset), "--save-every", 1)[0] == 0 and metrics(out) == lines
    assert_one_line(train(*command, "--learning-rate", 0.01), str(out), "learning_rate = 0.001, not 0.01", "--out")
    with locked(out):
        assert_one_line(train(*command), "another process is writing", str(out))
    (out / "config.json").write_text('{"steps": ')
    assert_one_line(train(*command), str(out / "config.json"), "damaged")


@pytest.mark.parametrize("best", [torch.float32, torch.bfloat16])
def test_a_run_keeps_the_precision_that_it_found_best(train, tmp_path, monkeypatch, best):
    monkeypatch.setattr(devices, "best_precision", lambda device: best)
    command = ["--precision", "auto", "--steps", 1, "--batch", 1]
    assert train(*command)[0] == 0
    monkeypatch.setattr(devices, "best_precision", None)  # nobody asks again
    assert train(*command)[0] == 0
    assert json.loads((tmp_path / "run/config.json").read_text())["precision"] == str(best).removeprefix("torch.")


def test_t3vip_d_has_no_latents(train, tmp_path):
    assert train("--model", "t3vip-d", "--steps", 1, "--batch", 1)[0] == 0
    assert load_model(tmp_path / "run").latent_channels == 0
    assert "kl" not in metrics(tmp_path / "run")[0]


def test_a_validation_set_of_its_own(train, write_dataset, tmp_path):
    other = write_dataset(tmp_path / "other", [12], seed=1)
    assert train("--validation", other, "--steps", 1, "--batch", 1)[0] == 0
    assert len({*json.loads((tmp_path / "run/model/config.json").read_text())["origin"]["data"].values()}) == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--colour", "red"], ["--colour"]),
        (["--steps", "0"], ["steps is 0", "at least 1"]),
        (["--steps", "many"], ["many"]),
        (["--learning-rate", "-1"], ["learning-rate is -1.0", "positive"]),
        (["--clip-gradient", "0"], ["clip-gradient is 0.0", "inf for no limit"]),
        (["--colour-jitter", "-1"], ["colour-jitter is -1.0", "0 or more"]),
        (["--colour-jitter", "inf"], ["colour-jitter is inf", "finite"]),
        (["--minutes", "inf"], ["minutes is inf", "--steps"]),
        (["--seed", "-1"], ["seed is -1", "0 or more"]),
        (["--context", "4"], ["context is 4", "1 to 3"]),
        (["--losses.knn", "-1"], ["knn is -1.0", "give 0"]),
        (["--losses.rgb", "nan"], ["rgb is nan", "give 0"]),
        (["--model", "cdna", "--losses.rgb", "0"], ["weights of 0 for rgb leave cdna nothing to learn from"]),
        (["--losses.rgb", "0", "--losses.depth", "0", "--losses.knn", "0"], ["rgb, depth, knn", "t3vip"]),
        (["--steps", "3", "--minutes", "1"], ["--steps and --minutes", "give one"]),
        (["--schedule.final-rate", "-2"], ["final-rate is -2.0", "from 0 to 1"]),
        (["--schedule.truth-until", "-1"], ["truth-until is -1.0", "0 or more"]),
        (["--schedule.kl-ramp", "0.6", "0.5"], ["kl-ramp is (0.6, 0.5)", "the earlier one first"]),
        (["--architecture.masks", "1"], ["masks is 1", "at least 2"]),
        (["--architecture.lstm-kernel", "4"], ["lstm-kernel is 4", "odd"]),
        (["--architecture.width", "inf"], ["width is inf", "positive"]),
        (["--architecture.translation-unit", "inf"], ["translation-unit is inf", "positive"]),
        (["--architecture.first-shift", "nan"], ["first-shift is nan", "0 or more"]),
        (["--architecture.splat-sharpness", "inf"], ["splat-sharpness is inf", "0 or more"]),
        (["--architecture.mask-head-std", "-1"], ["mask-head-std is -1.0", "0 or more"]),
        (["--device", "abacus"], ["abacus", "cpu or cuda"]),
        (["--frame-gap", "7"], ["no episode is 22 frames long", "longest has 20"]),
    ],
)
def test_options_that_cannot_be(train, tmp_path, arguments, words):
    assert_one_line(train(*arguments), *words)
    assert not (tmp_path / "run" / "metrics.jsonl").exists()


def test_an_unknown_preset(train):
    assert_one_line(train(preset="huge"), "no preset 'huge'", ", ".join(PRESETS))


def without_depth(folder):
    for shard in folder.glob("*.h5"):
        with h5py.File(shard, "r+") as file:
            del file["depth"]


def cut_short(folder):
    shard = folder / "shard-00001.h5"
    shard.write_bytes(shard.read_bytes()[:5000])


@pytest.mark.parametrize(("damage", "word"), [(without_depth, "no column 'depth'"), (cut_short, "is damaged")])
def test_datasets_that_are_not_whole(train, write_dataset, tmp_path, damage, word):
    folder = write_dataset(tmp_path / "data", [12, 12])
    damage(folder)
    assert_one_line(train(data=folder), str(folder), word)


def test_data_that_does_not_do(train, tiny_dataset, write_dataset, camera_of, tmp_path):
    assert_one_line(train(data=tmp_path / "nowhere"), "nowhere", "collect-rollouts")
    test_scene = write_dataset(tmp_path / "d", [12, 12], env_id="t3vip/TabletopD-v0")
    assert_one_line(train(data=test_scene), "TabletopD-v0", "test scene")
    assert_one_line(train("--validation", test_scene), "TabletopD-v0", "test scene")
    for env, split in (("some/Imported-v0", "test"), ("t3vip/PlanarPush-v0", "test"), ("t3vip/PlanarPush-v0", "all")):
        test_objects = write_dataset(tmp_path / f"{env}-{split}", [12, 12], env_id=env, env_kwargs={"split": split})
        assert_one_line(train(data=test_objects), str(test_objects), "for testing only")
    folder = write_dataset(tmp_path / "all", [30], env_id="some/Imported-v0", env_kwargs={"split": "all"})
    assert_one_line(train(data=folder), "1 episode")  # of a split in a folder that happens to have this name
    one = {"split": "train", "object": SPLITS["test"][0]}
    test_object = write_dataset(tmp_path / "object", [12, 12], env_id="t3vip/PlanarPush-v0", env_kwargs=one)
    assert_one_line(train(data=test_object), str(test_object), "for testing only")
    assert_one_line(train(data=write_dataset(tmp_path / "one", [30])), "1 episode", "--validation")
    odd = write_dataset(tmp_path / "odd", [12, 12], camera_of(20, 12))
    assert_one_line(train(data=odd), "12x20 is no multiple of 8")
    for other, word in ((camera_of(32, 16), "image size (16, 32)"), (camera_of(far=4.0), "depth range (1.0, 4.0)")):
        folder = write_dataset(tmp_path / f"other{other.width}", [12], other)
        assert_one_line(train("--validation", folder), str(folder), word)
    finer = write_dataset(tmp_path / "finer", [12], action_scale=[0.01] * 7)
    assert_one_line(train("--validation", finer), str(finer), "action scale (0.01,")
    assert_one_line(train("--validation", tiny_dataset), "6 of the 6 episodes", "another --seed")
    part = write_dataset(tmp_path / "part", [16, 20, 12])  # the same seed
    assert_one_line(train("--validation", part), f"2 of the 3 episodes of {part} (the first is number 0)", "--seed")
    short = write_dataset(tmp_path / "short", [6])
    assert_one_line(train("--validation", short), "no episode is 10 frames long", "longest has 6")
    assert not (tmp_path / "run" / "metrics.jsonl").exists()


def in_the_foreground(line):
    """Ctrl-C reaches it, also where whoever runs the tests does not want to hear of Ctrl-C."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    run(TrainOptions, main, line, _preset)


@pytest.fixture(scope="module")
def start(tiny_dataset):
    """Starts the long run in a process of its own, forked from one that has imported everything."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["worldmodel.train"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCHDYNAMO_DISABLE", "1")

        def begin(out):
            line = ["--preset", "tiny", "--data", tiny_dataset, "--out", out, *LONG_RUN]
            process = context.Process(target=in_the_foreground, args=(list(map(str, line)),))
            process.start()
            return process

        yield begin


def wait_for_step(process, out, step):
    while logged_step(out) < step and process.is_alive():
        time.sleep(0.02)


def finish(process):
    process.join()
    assert process.exitcode == 0


@pytest.fixture(scope="module")
def undisturbed(start, tmp_path_factory):
    """Weights and moments at the end of a run that nobody disturbed."""
    out = tmp_path_factory.mktemp("undisturbed") / "run"
    finish(start(out))
    return final_weights(out)


def assert_same(ours, theirs):
    assert ours.keys() == theirs.keys()
    for name, value in ours.items():
        assert torch.equal(value, theirs[name]), name


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_who_is_asked_to_stop_saves_and_the_same_command_goes_on(start, undisturbed, tmp_path, number, code):
    out = tmp_path / "run"
    process = start(out)
    wait_for_step(process, out, SAVE_EVERY + 2)
    os.kill(process.pid, number)
    process.join()
    assert process.exitcode == code
    stopped = saved_step(out)
    assert SAVE_EVERY + 2 <= stopped == logged_step(out) < STEPS  # not one step is lost
    finish(start(out))
    steps = [line["step"] for line in metrics(out) if line["kind"] == "train"]
    assert steps == list(range(1, STEPS + 1))
    assert_same(final_weights(out), undisturbed)


def test_sigkill_costs_at_most_the_steps_since_the_last_checkpoint(start, undisturbed, tmp_path):
    out, rng = tmp_path / "run", np.random.default_rng()
    for kill in range(4):
        before = logged_step(out)
        process = start(out)
        if kill > 0:  # the first one dies while it starts
            wait_for_step(process, out, before + 1)
        time.sleep(rng.uniform(0, 0.4))
        process.kill()
        process.join()
        assert saved_step(out) >= logged_step(out) - SAVE_EVERY
        if (out / "model").exists():
            load_model(out)
    finish(start(out))
    assert [line["step"] for line in metrics(out) if line["kind"] == "train"] == list(range(1, STEPS + 1))  # each once
    assert_same(final_weights(out), undisturbed)
    load_model(out)
