"""Two processes under torchrun against one: same losses, same gradients, and runs that go on with any number."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from envs.errors import UsageError
from worldmodel.ranks import ALONE, Ranks, join_ranks
from worldmodel.train import main, parse_options

HERE = Path(__file__).parent
STEPS, HALF = 8, 4
OPTIONS = ["--preset", "tiny", "--steps", STEPS, "--save-every", HALF, "--validate-every", STEPS, "--batch", 4]
# Adam makes whole steps even of gradients that are rounding, and those of runs with other sums part. With small steps
# the weights stay where all gradients can be compared to the end.
OPTIONS = [str(option) for option in [*OPTIONS, "--learning-rate", 1e-6]]


@contextmanager
def torchrun(*arguments):
    variables = {"TORCHDYNAMO_DISABLE": "1", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(HERE.parent.parent)}
    process = subprocess.Popen(
        [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", *map(str, arguments)],
        env={**os.environ, **variables},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.terminate()  # it ends its workers
            process.communicate(timeout=60)


def without_end(run, copy):
    """A copy of a run as it stood half way."""
    shutil.copytree(run, copy)
    shutil.rmtree(copy / "checkpoints" / f"step-{STEPS:08d}")
    return copy


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("ranks")


@pytest.fixture(scope="module")
def alone(tiny_dataset, folder):
    """A run of one process."""
    main(parse_options(["--data", str(tiny_dataset), "--out", str(folder / "alone"), *OPTIONS]))
    return folder / "alone"


@pytest.fixture(scope="module")
def together(tiny_dataset, folder, alone):
    """What `ddp_program` leaves: the same run by two, and the end of the run of one by two."""
    without_end(alone, folder / "continued")
    with torchrun(HERE / "ddp_program.py", tiny_dataset, folder, *OPTIONS) as process:
        said, _ = process.communicate(timeout=230)
    assert process.returncode == 0, said
    return folder / "together"


def lines(run, kind):
    return [line for line in map(json.loads, (run / "metrics.jsonl").read_text().splitlines()) if line["kind"] == kind]


def state(run):
    return load_file(run / "checkpoints" / f"step-{STEPS:08d}" / "training.safetensors")


def assert_same_losses(run, other):
    for ours, theirs in zip(lines(run, "train"), lines(other, "train"), strict=True):
        terms = ours.keys() - {"kind", "seconds", "data_wait"}
        assert ours.keys() == theirs.keys() and {"loss", "rgb", "depth", "knn"} <= terms
        for name in terms:
            assert ours[name] == pytest.approx(theirs[name], rel=1e-4, abs=1e-7), (ours["step"], name)
    (ours,), (theirs,) = lines(run, "validation")[-1:], lines(other, "validation")[-1:]
    assert ours["score"] == pytest.approx(theirs["score"], abs=1e-3)


def assert_same_gradients(run, other):
    """Their means over the steps, and of their squares, as Adam holds them: up to rounding."""
    ours, theirs = state(run), state(other)
    moments = [name for name in ours if name.startswith(("adam.exp_avg.", "adam.exp_avg_sq."))]
    assert ours.keys() == theirs.keys() and any(name.startswith("adam.exp_avg.inference.") for name in moments)
    for name in moments:
        off, size = (ours[name] - theirs[name]).norm(), theirs[name].norm()
        assert off <= 0.03 * size, (name, float(off / size))


def test_two_processes_have_the_losses_and_gradients_of_one(alone, together):
    assert [line["step"] for line in lines(alone, "train")] == list(range(1, STEPS + 1))
    assert "kl" in lines(alone, "train")[-1]  # latents, scheduled sampling and jitter took part
    assert_same_losses(together, alone)
    assert_same_gradients(together, alone)


def test_only_the_first_process_writes(alone, together):
    for run in (alone, together):
        assert len(list((run / "tensorboard").glob("events*"))) == len(list((run / "pictures").glob("*.png"))) == 1
    assert sorted(path.name for path in together.iterdir()) == sorted(path.name for path in alone.iterdir())
    assert len(lines(together, "train")) == STEPS and len(lines(together, "validation")) == 1


def test_a_run_goes_on_with_another_number_of_processes(alone, together, tiny_dataset, folder):
    assert_same_gradients(folder / "continued", alone)  # begun by one, ended by two
    back = without_end(together, folder / "back")
    main(parse_options(["--data", str(tiny_dataset), "--out", str(back), *OPTIONS]))
    assert_same_gradients(back, alone)


def test_what_one_process_meets_all_heed(together, folder):
    for rank in range(2):
        assert json.loads((folder / f"rank-{rank}.json").read_text()) == {
            "any": [True, False],
            "decided": "as 0 says",
            "refused": "the first found nothing",
            "elsewhere": "not all processes find the run's newest checkpoint; give an --out on a filesystem that all "
            "of them see",
            "skipped": True,
            "bad_steps": 1,
            "clips": 2,
        }


def test_sigterm_to_torchrun_saves(tiny_dataset, tmp_path):
    given = ["--preset", "tiny", "--steps", 5000, "--save-every", 5000, "--validate-every", 5000, "--batch", 2]
    with torchrun("-m", "worldmodel.train", "--data", tiny_dataset, "--out", tmp_path, *given) as process:
        while not (tmp_path / "metrics.jsonl").exists():
            assert process.poll() is None, process.communicate()[0]
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        said, _ = process.communicate(timeout=230)
    (saved,) = (int(path.name.removeprefix("step-")) for path in (tmp_path / "checkpoints").glob("step-*"))
    assert said.count(f"stopped at step {saved}") == 1 and saved == lines(tmp_path, "train")[-1]["step"], said


def test_shares_of_a_batch():
    assert [list(range(6))[Ranks(rank, 3).share(6)] for rank in range(3)] == [[0, 1], [2, 3], [4, 5]]
    assert ALONE.share(7) == slice(0, 7)
    with pytest.raises(UsageError, match="batch is 16, which 3 processes cannot share equally; give a multiple of 3"):
        Ranks(0, 3).share(16)


def test_processes_and_gpus(monkeypatch):
    with join_ranks("cpu") as ranks:
        assert ranks == Ranks(0, 1, torch.device("cpu"))
    for name, value in {"RANK": "1", "WORLD_SIZE": "2", "LOCAL_RANK": "1"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("worldmodel.ranks.find_device", lambda name: torch.device("cuda", 0))
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    for device, said in (("cuda", "--nproc-per-node 1"), ("cuda:0", "each takes its own GPU")):
        with pytest.raises(UsageError, match=said), join_ranks(device):
            pass
