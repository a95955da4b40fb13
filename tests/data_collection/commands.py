"""Running the commands of the project on the stand-in environment."""

import contextlib
import importlib
import io
import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

from envs.command import run

HERE = Path(__file__).parent

MODULES = {
    "collect-rollouts": "data_collection.collect",
    "export-dataset": "data_collection.export_dataset",
    "import-dataset": "data_collection.import_dataset",
    "inspect-dataset": "data_collection.inspect_dataset",
    "train-policy": "data_collection.train_policy",
}
ENV_ID = "standin:standin/Square-v0"


def options(out, **changed):
    """Command line of `collect-rollouts` on the stand-in environment."""
    chosen = {"env": ENV_ID, "episodes": 4, "steps": 8, "image-size": 16, "policy": "noise", "workers": 1, **changed}
    chosen = {name: value for name, value in chosen.items() if value is not None}
    flags = [flag for name, value in chosen.items() if value is not True for flag in (f"--{name}", str(value))]
    return ["--out", str(out), *flags, *(f"--{name}" for name, value in chosen.items() if value is True)]


def start(command, arguments, **variables):
    """Start a command of the project in a process of its own."""
    # Whoever runs the tests in the background has them ignore Ctrl-C, which the command would inherit.
    mind = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    code = f"{mind}; from {MODULES[command]} import command; command()"
    environment = {**os.environ, "PYTHONPATH": str(HERE), **{k: str(v) for k, v in variables.items()}}
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process):
    """Exit code, stdout and stderr of a started command."""
    out, err = process.communicate(timeout=280)
    return process.returncode, out, err


def call(command, arguments, **variables):
    """Run a command to its end, in this process; its workers inherit the variables."""
    module = importlib.import_module(MODULES[command])
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        mock.patch.dict(os.environ, {name: str(value) for name, value in variables.items()}),
    ):
        try:
            run(module.Config, module.main, list(map(str, arguments)))
        except SystemExit as stop:
            code = stop.code
    return code, out.getvalue(), err.getvalue()


def assert_one_line_error(result, *words):
    """Exit code 2 and one line that names these words; no traceback."""
    code, _, err = result
    lines = [line for line in err.splitlines() if line.startswith("error: ")]
    assert code == 2 and len(lines) == 1 and "Traceback" not in err, err
    for word in words:
        assert word in lines[0], f"{word!r} is not in {lines[0]!r}"
