"""The evaluation as a whole: who arrives, what it writes, how it resumes, what it says about mistakes."""

import dataclasses
import functools
import json
import sys
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

from envs.errors import UsageError
from planning import servo_eval
from planning.controllers import CONTROLLERS, Goal, Kit
from planning.controllers.base import held_gripper
from planning.controllers.baselines import ProportionalController
from planning.costs import env_action
from planning.episode import THRESHOLDS, run_episode
from planning.film import Film, Studio
from planning.servo_eval import ServoConfig, command, main
from planning.setups import make_setup
from worldmodel import checkpoint


@pytest.fixture(scope="module")
def env():
    env = gym.make("envs:t3vip/TabletopD-v0", max_episode_steps=-1, disable_env_checker=True)
    yield env
    env.close()


@pytest.fixture
def run(capsys, monkeypatch):
    """Run the command as the shell does: (exit code, stdout, stderr)."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["servo-eval", *map(str, arguments)])
        code = 0
        try:
            command()
        except SystemExit as exit_:
            code = exit_.code
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


@functools.cache
def setup_of(env, index):
    return make_setup(env, index)


def episode(env, name, index, steps):
    kit = Kit(env, rng=np.random.default_rng(index))
    try:
        return run_episode(env, setup_of(env, index), name, CONTROLLERS[name](kit), steps)
    finally:
        kit.close()


def test_oracle_arrives_and_random_does_not(env):
    for index in range(2):
        record = episode(env, "oracle", index, steps=45)
        assert record.success(0.1, "3d") and record.success(0.1, "2d")
        assert not episode(env, "random", index, steps=45).success(0.1, "3d")


def test_proportional_arrives_and_stops_when_nothing_is_left_to_find_out(env):
    record = episode(env, "proportional", 0, steps=100)
    assert all(record.success(t, space) for t in THRESHOLDS for space in ("2d", "3d"))
    assert record.steps < 100 and len(record.distances) == record.steps
    assert record.final_distance == pytest.approx(record.distances[-1], abs=1e-5)


def test_whole_episodes_say_where_the_point_stays(tmp_path, run):
    options = ["--model", "proportional", "--episodes", 2, "--steps", 30]
    assert run(*options, "--out", tmp_path / "short")[0] == 0
    code, out, _ = run(*options, "--whole-episodes", "--out", tmp_path / "whole")
    assert code == 0 and "stay-m" in out
    short, whole = (
        [json.loads(line) for line in (tmp_path / name / "episodes.jsonl").read_text().splitlines()]
        for name in ("short", "whole")
    )
    for early, late in zip(short, whole, strict=True):
        assert early["steps"] < late["steps"] == 30
        assert early["distances"] == late["distances"][: early["steps"]]
    other, entry = (
        json.loads((tmp_path / name / "servo.json").read_text())["models"]["proportional"]
        for name in ("short", "whole")
    )
    stays = [np.mean(record["distances"][-20:]) for record in whole]
    assert entry["stay_distance_m_median"] == pytest.approx(np.median(stays)) and np.median(stays) > 0
    assert "stay_distance_m_median" not in other
    code, _, err = run(*options, "--out", tmp_path / "whole")
    assert code == 2 and "whole_episodes" in err


def test_t3vip_arrives_in_the_simulator_with_an_exact_model(env, make_exact_model, monkeypatch):
    monkeypatch.setattr(checkpoint, "load_model", lambda name, device: make_exact_model(env.unwrapped.camera))
    assert episode(env, "t3vip", 1, steps=45).success(0.1, "3d")


def test_sv2p_reaches_the_pixel_in_the_simulator_with_an_exact_model(env, make_pixel_model, monkeypatch):
    monkeypatch.setattr(checkpoint, "load_model", lambda name, device: make_pixel_model(env.unwrapped.camera))
    assert episode(env, "sv2p", 0, steps=30).success(0.1, "2d")


def test_pictures_do_not_know_the_goal(env):
    """Bitwise: other goals, and a film that draws the goal, leave what the controller sees as it is."""
    setup = setup_of(env, 0)
    elsewhere = dataclasses.replace(setup, goal=Goal(setup.goal.point_world + 0.05, setup.goal.pixel + 3))
    studio = Studio(env)
    seen = []
    for variant, film in ((setup, None), (elsewhere, None), (setup, Film(studio, setup, "film"))):
        observations = []
        inner = CONTROLLERS["random"](Kit(env, rng=np.random.default_rng(0)))

        def act(observation, inner=inner, observations=observations):
            observations.append({key: np.array(value) for key, value in observation.items()})
            return inner.act(observation)

        spy = SimpleNamespace(plan_seconds=[0.0], reset=inner.reset, act=act)
        run_episode(env, variant, "spy", spy, 6, watch=film.watch if film else None)
        seen.append(observations)
    studio.close()
    for others in seen[1:]:
        for one, other in zip(seen[0], others, strict=True):
            for key in one:
                np.testing.assert_array_equal(one[key], other[key])


def test_command_writes_everything_and_resumes_episode_by_episode(tmp_path, run, monkeypatch):
    options = ["--model", "proportional", "random", "--steps", 12, "--out", tmp_path]
    code, out, _ = run(*options, "--episodes", 2, "--video", 1)
    assert code == 0 and "proportional" in out
    servo = json.loads((tmp_path / "servo.json").read_text())
    entry = servo["models"]["random"]
    assert entry["episodes"] == 2 and len(entry["success_3d_interval"]) == 2
    for key in ("success_2d", "success_3d", "success_2d_interval", "final_distance_m_median", "plan_seconds_median"):
        assert key in entry
    assert servo["t3vip_less"] == {} and len(entry["by_axis_bin"]) == 4
    assert (tmp_path / "success.png").stat().st_size > 1000
    for suffix in ("mp4", "png"):
        assert (tmp_path / "videos" / f"random-setup00-0.{suffix}").stat().st_size > 1000

    # Cut off the last episode in the middle, as a kill would; the same command does that one again, and no other.
    path = tmp_path / "episodes.jsonl"
    whole = path.read_text()
    path.write_text(whole[:-30])
    ran = []
    once = servo_eval.run_episode
    monkeypatch.setattr(servo_eval, "run_episode", lambda *a, **k: ran.append(1) or once(*a, **k))
    assert run(*options, "--episodes", 2)[0] == 0
    assert len(ran) == 1

    def timeless(text):
        return [{**json.loads(line), "plan_seconds": 0} for line in text.splitlines()]

    assert timeless(path.read_text()) == timeless(whole)
    assert run(*options, "--episodes", 2)[0] == 0 and len(ran) == 1

    code, _, err = run(*options, "--episodes", 2, "--seed", 1)
    assert code == 2 and "seed" in err and err.count("\n") == 1


class Lazy(ProportionalController):
    """One of the controllers there are, with a change."""

    def decide(self, observation):
        return 0 * super().decide(observation)


def test_results_go_by_the_name_that_a_controller_is_asked_for_by(tmp_path, monkeypatch):
    monkeypatch.setitem(CONTROLLERS, "lazy", lambda kit: Lazy(**kit.parts()))
    for models in (("proportional",), ("proportional", "lazy"), ("proportional",)):
        main(ServoConfig(out=tmp_path, model=models, episodes=1, steps=4, video=1))
    lines = [json.loads(line) for line in (tmp_path / "episodes.jsonl").read_text().splitlines()]
    assert [line["model"] for line in lines] == ["proportional", "lazy"]
    assert lines[0]["final_distance"] < 0.9 * lines[1]["final_distance"]
    assert {path.stem for path in (tmp_path / "videos").iterdir()} == {"proportional-setup00-0", "lazy-setup00-0"}


class Still:
    """All that a controller needs."""

    def __init__(self):
        self.plan_seconds = []

    def reset(self, observation, goal):
        self.gripper = held_gripper(observation)

    def act(self, observation):
        return env_action(np.zeros(3), self.gripper)


def test_a_controller_need_not_take_down_how_long_it_decides(tmp_path, monkeypatch):
    monkeypatch.setitem(CONTROLLERS, "still", lambda kit: Still())
    main(ServoConfig(out=tmp_path, model=("still",), episodes=1, steps=2))
    entry = json.loads((tmp_path / "servo.json").read_text())["models"]["still"]
    assert entry["plan_seconds_median"] == 0 and entry["episodes"] == 1


def test_repeats_share_a_setup_but_not_their_randomness():
    config = ServoConfig(out="x", model=("random",), setups=2, repeats=3)
    assert config.attempts() == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)]
    assert len(ServoConfig(out="x", model=("random",)).attempts()) == 50
    assert len(ServoConfig(out="x", model=("random",), episodes=5, repeats=2).attempts()) == 5


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--model", "t4vip"], "t3vip"),
        (["--model", "random", "random"], "once"),
        (["--episodes", 0], "episodes"),
        (["--episodes", 2, "--setups", 1], "--episodes is 2 and --setups is 1"),
        (["--planner.horizon", 0], "horizon"),
        (["--model", "random", "--checkpoint", "/nowhere"], "checkpoint"),
        (["--checkpoint", "sv2p=/nowhere"], "sv2p"),
        (["--checkpoint", "t3vip=/a", "t3vip=/b"], "--checkpoint t3vip=/b is a second one for 't3vip'"),
        (["--deadline", "-1"], "deadline"),
        (["--env", "planar-push", "--model", "sna"], "no sna ships for t3vip/PlanarPush-v0; train one and give it"),
    ],
)
def test_mistakes_are_one_line(tmp_path, run, options, word):
    code, _, err = run("--out", tmp_path, *options)
    assert code == 2 and word in err and err.count("\n") == 1 and "Traceback" not in err


def test_models_of_different_frame_gaps_are_refused(env, tmp_path, make_exact_model, make_pixel_model, monkeypatch):
    make = {"t3vip": make_exact_model, "sv2p": make_pixel_model}  # gaps of 3 and 1
    monkeypatch.setattr(checkpoint, "load_model", lambda path, device: make[path.name](env.unwrapped.camera))
    with pytest.raises(UsageError, match=r"t3vip 3, sv2p 1.*one frame gap"):
        main(ServoConfig(out=tmp_path, model=("t3vip", "sv2p"), episodes=1))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("wrong", ["env", "size", "lens", "action", "units", "kind"])
def test_a_checkpoint_that_does_not_fit_is_refused(env, tmp_path, make_exact_model, monkeypatch, wrong):
    camera = env.unwrapped.camera
    if wrong == "size":
        camera = type(camera).from_fovy(48, 48, 10, np.eye(4), 3, 5)
    if wrong == "lens":
        camera = type(camera).from_fovy(64, 64, 40, np.eye(4), camera.near, camera.far)
    model = make_exact_model(camera, action_dim=3 if wrong == "action" else 7)
    if wrong == "units":
        model.context.action_scale = (0.01, *model.context.action_scale[1:])
    if wrong == "kind":
        model.kind = "sv2p"
    if wrong == "env":
        model.context.env_id = "t3vip/DexHand-v0"
    monkeypatch.setattr(checkpoint, "load_model", lambda name, device: model)
    words = {
        "env": "DexHand",
        "size": r"image size \(64, 64\), not \(48, 48\)",
        "lens": "intrinsics",
        "action": "3 numbers",
        "units": "action scale",
        "kind": "is a sv2p",
    }
    with pytest.raises(UsageError, match=words[wrong]):
        main(ServoConfig(out=tmp_path, model=("t3vip",), episodes=1))
