"""`--config`: values of a file take the place of the preset's, and those of the command line win."""

import json

import pytest

from envs.errors import UsageError
from worldmodel.options import PRESETS
from worldmodel.train import document_of, parse_options


@pytest.fixture
def options_with(tmp_path):
    """The options that `train-worldmodel` makes of a config file and of further arguments."""

    def parse(content, *arguments):
        path = tmp_path / "best.json"
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return parse_options(["--data", "d", "--out", "o", "--config", str(path), *arguments])

    return parse


def test_the_file_changes_the_preset_and_the_command_line_changes_both(options_with):
    file = {
        "preset": "tiny",
        "learning_rate": 1,
        "losses": {"rgb": 0.7, "power": 2},
        "schedule": {"clip_lengths": [[0.5, 3], [1.0, 5]]},
        "minutes": None,
    }
    options = options_with(file)
    tiny = PRESETS["tiny"]
    assert options.preset == "tiny" and options.steps == tiny.steps and options.architecture == tiny.architecture
    assert options.learning_rate == 1.0 and isinstance(options.learning_rate, float)
    assert (options.losses.rgb, options.losses.power, options.losses.knn) == (0.7, 2, tiny.losses.knn)
    assert options.schedule.clip_lengths == ((0.5, 3), (1.0, 5)) and options.schedule.warmup == tiny.schedule.warmup
    options = options_with(file, "--preset=cpu", "--losses.rgb", "0.3", "--steps", "7")
    assert (options.preset, options.steps, options.losses.rgb, options.losses.power) == ("cpu", 7, 0.3, 2)
    assert options.architecture == PRESETS["cpu"].architecture


def test_steps_take_the_place_of_the_files_minutes(options_with):
    file = {"minutes": 5, "steps": 3}
    assert (options_with(file).minutes, options_with(file, "--minutes", "7").minutes) == (5.0, 7.0)
    options = options_with(file, "--steps", "4")
    assert (options.minutes, options.steps) == (None, 4)
    assert options_with(file, "--steps", "4", "--minutes", "None").steps == 4
    with pytest.raises(UsageError, match="--steps and --minutes are both given"):
        options_with(file, "--steps=4", "--minutes=7")


def test_the_config_of_a_run_makes_the_same_run(options_with):
    ours = parse_options(["--data", "d", "--out", "o", "--model", "sv2p", "--batch", "3", "--validation", "v"])
    again = options_with(document_of(ours))
    assert document_of(again) == document_of(ours) and again.data == ours.data and again.batch == 3


def test_rivals_learn_from_squared_errors_unless_told_otherwise(options_with):
    def power(*arguments, file=None):
        return options_with(file or {}, *arguments).losses.power

    assert [power("--model", name) for name in ("t3vip", "t3vip-d", "sv2p", "sna", "cdna")] == [1, 1, 2, 2, 2]
    assert power("--model=cdna", "--preset=tiny") == 2 and power("--model=cdna", "--losses.power", "1") == 1
    assert power() == 1 and parse_options(["--data", "d", "--out", "o", "--model", "sna"]).losses.power == 2
    assert power(file={"model": "cdna"}) == 2 and power("--model", "t3vip", file={"model": "cdna"}) == 1
    assert power("--model", "cdna", file={"losses": {"power": 1}}) == 1
    assert power("--model", "cdna", file={"losses": {"rgb": 0.7}}) == 2


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "cannot be read"),
        ([1], "no JSON object"),
        ({"lerning_rate": 1}, "'lerning_rate', which is no option"),
        ({"losses": {"sharpness": 1}}, "'sharpness', which is no option"),
        ({"out": "here"}, "'out', which is no option"),
        ({"losses": 3}, "losses = 3; give a JSON object"),
        ({"losses": {"power": 3}}, "power = 3; give one of 1, 2"),
        ({"steps": "many"}, "steps = 'many'; give a whole number"),
        ({"steps": True}, "steps = True; give a whole number"),
        ({"schedule": {"kl_ramp": [0.1]}}, "kl_ramp = [0.1]; give a list"),
        ({"learning_rate": -1}, "learning-rate is -1.0"),
        ({"preset": "huge"}, "no preset 'huge'"),
        ({"preset": ["cpu"]}, "no preset '['cpu']'"),
    ],
)
def test_files_that_do_not_do(options_with, content, words):
    with pytest.raises(UsageError) as caught:
        options_with(content)
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_no_file(tmp_path):
    with pytest.raises(UsageError, match="cannot be read"):
        parse_options(["--data", "d", "--out", "o", "--config", str(tmp_path / "none.json")])
