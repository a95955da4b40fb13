"""`check-rendering`: what it prints, writes and returns."""

import json

import pytest

from envs import check_rendering, rendering
from envs.command import run


def check(*arguments):
    run(check_rendering.Config, check_rendering.main, ["--seconds", "0.05", *arguments])


def test_says_ok_and_writes_its_findings(capsys, tmp_path):
    check("--json", str(tmp_path / "findings.json"))
    printed = capsys.readouterr().out
    findings = json.loads((tmp_path / "findings.json").read_text())
    assert printed.endswith("OK\n") and findings["renderer"] in printed and "RGB-D frames/s" in printed
    assert findings["ok"] and 0 < findings["narrow_error_mm"] < 1 and 0 < findings["wide_error_mm"] < 1
    assert findings["frames_per_second"] > 0


def test_says_failed_when_depth_is_wrong(capsys, monkeypatch, tmp_path):
    right = rendering.metric_depth
    monkeypatch.setattr(rendering, "metric_depth", lambda *arguments: 1.001 * right(*arguments))
    with pytest.raises(SystemExit) as end:
        check("--json", str(tmp_path / "findings.json"))
    assert end.value.code == 1 and "FAILED" in capsys.readouterr().out
    assert not json.loads((tmp_path / "findings.json").read_text())["ok"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--size", "8"), "--size is 8"),
        (("--seconds", "-1"), "--seconds is -1"),
        (("--supersample", "2"), "supersample is 2"),
        (("--json", "/nowhere/at/all.json"), "/nowhere/at/all.json"),
    ],
)
def test_bad_options_are_one_line(capsys, arguments, message):
    with pytest.raises(SystemExit) as end:
        check(*arguments)
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
