"""Without a compiler, or with one that fails, everything runs as it is."""

import json
import logging
import os
import subprocess
import sys

import pytest
import torch
from torch._dynamo.exc import BackendCompilerFailed
from tqdm import tqdm

from worldmodel import compilation
from worldmodel.compilation import can_compile, compiled


@pytest.fixture(autouse=True)
def fresh():
    can_compile.cache_clear()
    yield
    can_compile.cache_clear()


class Failed(BackendCompilerFailed):
    """What PyTorch raises, whose arguments differ from version to version."""

    def __init__(self, reason):
        RuntimeError.__init__(self, reason)


def double(x):
    """Doubles."""
    if x.isnan().any():
        raise RuntimeError("not a number")
    return 2 * x


def test_without_a_compiler_it_is_the_plain_function(monkeypatch, caplog):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(torch, "compile", lambda *args, **kwargs: pytest.fail("there is nothing to compile with"))
    assert not can_compile("cpu") and not can_compile("cuda") and not can_compile("mps")
    function = compiled(double)
    assert function.__doc__ == "Doubles." and function(torch.ones(2)).tolist() == [2, 2]
    missing = [record.getMessage().split(":")[0] for record in caplog.records if record.levelno == logging.WARNING]
    assert len(missing) == 3 and missing[::2] == ["no C++ compiler found", "no backend for mps found"]  # each once


def test_without_a_compiler_a_run_says_so_once_and_learns_the_same(tiny_dataset, tmp_path):
    plain = {name: value for name, value in os.environ.items() if name not in ("CC", "CXX")} | {"OMP_NUM_THREADS": "1"}
    (tmp_path / "nothing").mkdir()
    said, learned = {}, {}
    for name, variable in {"missing": {"PATH": str(tmp_path / "nothing")}, "off": {"TORCHDYNAMO_DISABLE": "1"}}.items():
        line = ["--preset", "tiny", "--device", "cpu", "--steps", "2", "--data", tiny_dataset, "--out", tmp_path / name]
        command = [sys.executable, "-m", "worldmodel.train", *line]
        done = subprocess.run(command, env=plain | variable, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        said[name] = [line for line in done.stderr.splitlines() if "torch.compile" in line]
        lines = map(json.loads, (tmp_path / name / "metrics.jsonl").read_text().splitlines())
        learned[name] = [line["loss"] for line in lines if line["kind"] == "train"]
    assert len(said["missing"]) == 1 and said["missing"][0].startswith("no C++ compiler found: ") and not said["off"]
    assert len(learned["off"]) == 2 and learned["missing"] == learned["off"]


def test_what_is_missing_has_a_line_beside_a_progress_bar(monkeypatch, capsys):
    handler = logging.StreamHandler(sys.stderr)
    monkeypatch.setattr(compilation.logger, "handlers", [handler])
    with tqdm(total=2, file=sys.stderr) as bar:
        bar.update()
        can_compile("mps")
    said = capsys.readouterr().err.replace("\r", "\n").splitlines()
    assert any(line.startswith("no backend for mps found") and line.endswith("the same") for line in said), said


def test_a_compiler_that_fails_is_named_once_and_not_asked_again(monkeypatch, caplog):
    asked = []

    def broken(function, dynamic, options):
        def call(x):
            asked.append(x)
            raise Failed("no space left on device")

        return call

    monkeypatch.setattr(torch, "compile", broken)
    monkeypatch.setattr(compilation, "can_compile", lambda device: True)
    function = compiled(double)
    with caplog.at_level(logging.WARNING):
        assert function(torch.ones(2)).tolist() == [2, 2] and function(torch.ones(3)).tolist() == [2, 2, 2]
    assert len(asked) == 1 and len(caplog.records) == 1
    assert "double runs without torch.compile" in caplog.text and "no space left" in caplog.text


def test_errors_of_the_function_itself_are_its_own(monkeypatch):
    monkeypatch.setattr(torch, "compile", lambda function, dynamic, options: function)
    monkeypatch.setattr(compilation, "can_compile", lambda device: True)
    with pytest.raises(RuntimeError, match="not a number"):
        compiled(double)(torch.tensor([torch.nan]))


def test_the_device_decides(monkeypatch):
    asked = []
    monkeypatch.setattr(compilation, "can_compile", lambda device: bool(asked.append(device)))
    function = compiled(lambda count, x: x * count)
    assert function(2, torch.ones(1)).tolist() == [2]
    assert function(2, torch.ones(1, device="meta")).device.type == "meta"
    assert asked == ["cpu", "meta"]
