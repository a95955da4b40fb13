"""Policies for the dexterous hand: the predictive search, policies of Stable-Baselines3, and what becomes of them."""

from __future__ import annotations

import dataclasses
import json
import shlex
import zipfile
from types import SimpleNamespace

import gymnasium
import imageio.v2 as imageio
import numpy as np
import pytest
import tyro
from commands import call

from data_collection import hand_pictures, train_policy
from data_collection.collect import Config
from data_collection.dataset import RGBDDataset
from data_collection.environments import resolve_env, usual_policy, usual_steps
from data_collection.policies import make_policy
from data_collection.policies.predictive import PredictivePolicy, Settings
from data_collection.policies.predictive_cost import Weights, step_costs
from data_collection.policies.stable_baselines import load_model, policy_name
from data_collection.rollout import collect_episode
from envs import rotations
from envs.dexhand import DexHandEnv, goals
from envs.dexhand.simulate import BatchSimulator
from envs.errors import UsageError
from envs.planar_push import PlanarPushEnv

SMALL = Settings(stage=4, ahead=2, samples=48, beam=8)


@pytest.fixture(scope="module")
def env():
    env = DexHandEnv(goal_angle=90, images=False)
    yield env
    env.close()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A policy of Stable-Baselines3, hardly trained."""
    path = tmp_path_factory.mktemp("policy") / "hand.zip"
    config = train_policy.Config(path, steps=110, batch=8, buffer=500, save_every=105, trials=0)
    train_policy.main(config)
    return path


def act(env: DexHandEnv, policy: PredictivePolicy, seed: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Actions (steps, 20) and rotation errors (steps + 1,), degrees."""
    observation, info = env.reset(seed=seed)
    policy.reset(env, np.random.default_rng(seed))
    actions, errors = [], [info["rotation_error"]]
    for _ in range(steps):
        actions.append(policy.act(observation))
        observation, _, terminated, _, info = env.step(actions[-1])
        errors.append(info["rotation_error"])
        assert not terminated
    return np.array(actions), np.degrees(errors)


# --- The predictive policy ------------------------------------------------------------------------------------------


def test_the_cube_is_turned_towards_goals(env):
    errors = np.array([act(env, PredictivePolicy(SMALL), seed, 28)[1] for seed in (1, 2, 4)])
    assert (errors[:, 0] > 20).all()
    assert np.median(errors[:, -1] / errors[:, 0]) < 0.5


def test_the_same_seed_gives_the_same_episode_and_looking_ahead_changes_nothing(env):
    policy = PredictivePolicy(SMALL)
    first = act(env, policy, 3, 6)
    observation, _ = env.reset(seed=8)
    state = env.get_state()
    policy.reset(env, np.random.default_rng(0))
    policy.act(observation)
    np.testing.assert_array_equal(env.get_state(), state)
    again = act(env, PredictivePolicy(SMALL, threads=2), 3, 6)
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])


def test_targets_go_smoothly_from_where_they_are(env):
    actions, _ = act(env, PredictivePolicy(SMALL), 5, 12)
    within = np.diff(actions.reshape(3, SMALL.stage, 20), axis=1)
    np.testing.assert_allclose(within[:, 0], within[:, -1], atol=1e-5)  # straight within a stage
    assert np.abs(actions).max() <= 1


def test_the_search_foresees_what_happens(env):
    observation, _ = env.reset(seed=6)
    policy = PredictivePolicy(SMALL)
    policy.reset(env, np.random.default_rng(0))
    simulator = BatchSimulator(env, 1)
    policy.act(observation)
    kept = policy._beam
    assert kept.moves.shape[1:] == (SMALL.ahead - 1, SMALL.stage, 20)
    plan = np.concatenate([policy._move, *kept.moves[0]])
    real = simulator.rollout(env.get_state(), plan[None])
    np.testing.assert_allclose(real.end[0, :32], kept.physics[0, :32], atol=0.01)  # time, hand and cube
    simulator.close()


def test_a_new_goal_starts_a_new_search(env):
    observation, _ = env.reset(seed=0)
    policy = PredictivePolicy(SMALL)
    policy.reset(env, np.random.default_rng(0))
    for _ in range(SMALL.stage):
        env.step(policy.act(observation))
    before = policy._beam
    env._set_goal(np.concatenate([goals.HOME, [0, 0, 1, 0]]))
    policy.act(observation)
    assert not np.array_equal(policy._beam.physics[: len(before.physics)], before.physics)
    np.testing.assert_array_equal(policy._goal, env.goal)


def test_costs_name_what_is_bad(env):
    env.reset(seed=0)
    simulator = BatchSimulator(env, 1)
    actions = np.zeros((1, 2, 20))
    paths = simulator.rollout(env.get_state(), actions)
    simulator.close()
    pose = paths.cube_pose[0, 0]
    pose[:3] = goals.HOME

    def cost(goal=None, action=actions, **place):
        paths.cube_pose[0, 0, :3] = goals.HOME + np.array([place.get(axis, 0.0) for axis in "xyz"])
        return step_costs(Weights(), paths, action, pose if goal is None else goal)[0, 0]

    turned = pose.copy()
    turned[3:] = rotations.multiply(np.array([np.cos(0.25), 0, 0, np.sin(0.25)]), pose[3:])
    assert cost() == 0
    assert cost(turned) == pytest.approx(0.5)
    assert cost(x=0.03) == pytest.approx(Weights().place * 0.01)
    assert cost(z=-0.1) > Weights().drop
    assert cost(action=actions + 1) == pytest.approx(Weights().posture)
    assert cost(z=np.nan) == np.inf


def test_bad_input_is_named():
    with pytest.raises(UsageError, match="beam is 0"):
        Settings(beam=0)
    with pytest.raises(UsageError, match="drop is -1"):
        Weights(drop=-1)
    other = PlanarPushEnv(images=False)
    with pytest.raises(UsageError, match="PlanarPushEnv"):
        make_policy("predictive").reset(other, np.random.default_rng(0))
    other.close()


# --- Collecting ----------------------------------------------------------------------------------------------------


def test_what_is_usual_in_an_environment(tmp_path):
    env_id, kwargs = resolve_env("dexhand", None)
    assert env_id == "t3vip/DexHand-v0"
    assert kwargs == {"new_goals": True}
    assert usual_policy("dexhand") == usual_policy(env_id) == "predictive"
    assert usual_steps("dexhand") == usual_steps("envs:t3vip/DexHand-v0") == 100
    assert usual_steps("tabletop") == usual_steps("planar-push") == usual_steps("other/Env-v0") == 240
    config = Config(tmp_path, env="dexhand")
    assert config.manifest().steps == 100
    assert dataclasses.replace(config, steps=240).manifest().steps == 240


def test_commands_and_joint_deltas_are_recorded():
    env = DexHandEnv(image_size=16, supersample=1)
    policy = PredictivePolicy(Settings(stage=2, ahead=1, samples=4))
    columns, _ = collect_episode(env, policy, 5, 0, 0, ground_truth=True)
    assert columns["action"].shape == (6, 20)
    assert columns["joint_delta"].shape == (6, 24)
    assert not columns["joint_delta"][-1].any()
    np.testing.assert_allclose(columns["joint_delta"][:-1], np.diff(columns["proprio"], axis=0), atol=1e-6)
    assert np.abs(columns["joint_delta"]).max() > 0.005
    np.testing.assert_allclose(columns["scene_obs"][:, :3], columns["body_pose"][:, env.body_names.index("object"), :3])
    env.close()


def test_noise_gives_targets_between_the_ends(env):
    env.reset(seed=0)
    noise = make_policy("noise")
    noise.reset(env, np.random.default_rng(0))
    actions = np.array([noise.act({}) for _ in range(50)])
    assert (np.abs(actions) < 0.9).mean() > 0.5
    assert np.abs(np.diff(actions, axis=0)).mean() < 0.3


# --- Stable-Baselines3 ---------------------------------------------------------------------------------------------


def test_a_trained_policy_acts_in_the_collector(trained, tmp_path):
    out = tmp_path / "data"
    options = ["--out", out, "--env", "dexhand", "--policy", trained, "--episodes", "1", "--steps", "4"]
    code, _, err = call("collect-rollouts", [*map(str, options), "--workers", "1", "--image-size", "16"])
    assert code == 0, err
    dataset = RGBDDataset(out)
    assert dataset.attrs["policy"] == policy_name(trained)
    model, env = load_model(trained), DexHandEnv(images=False)
    actions, states = dataset.load("action"), dataset.load("state")
    for action, state in zip(actions[:-1], states[:-1], strict=True):
        env.set_state(state)
        np.testing.assert_allclose(model.predict(env.observation(), deterministic=True)[0], action, atol=1e-5)
    env.close()
    hand_pictures.main(hand_pictures.Config(out, tmp_path, moments=3, size=20))
    picture = imageio.imread(tmp_path / "dexhand.png")
    assert picture.shape[:2] == (60, 60)
    assert not np.array_equal(picture[:, :20], picture[:, 40:])
    with pytest.raises(UsageError, match="episodes 0 to 0"):
        hand_pictures.main(hand_pictures.Config(out, tmp_path, episode=1))


def copy_of(trained, folder):
    for path in (trained, trained.with_suffix(".json")):
        (folder / path.name).write_bytes(path.read_bytes())
    return folder / trained.name


def test_training_goes_on_where_it_stopped(trained, tmp_path):
    path = copy_of(trained, tmp_path)
    train_policy.main(train_policy.Config(path, steps=112, batch=8, buffer=500, trials=0))
    assert load_model(path).num_timesteps == 112
    with pytest.raises(UsageError, match="is not the policy it was"):
        make_policy(policy_name(trained).replace(str(trained), str(path)))


def test_collecting_goes_on_wherever_the_policy_is_named_from(trained, tmp_path, monkeypatch):
    monkeypatch.chdir(trained.parent)
    before = Config(tmp_path, env="dexhand", policy=trained.name).manifest()
    Config(tmp_path, env="dexhand", policy=str(trained)).manifest().check_continues(before, tmp_path)
    other = copy_of(trained, tmp_path)
    other.write_bytes(other.read_bytes() + b"more")
    with pytest.raises(UsageError, match=r"was collected with policy = 'hand\.zip#"):
        Config(tmp_path, env="dexhand", policy=str(other)).manifest().check_continues(before, tmp_path)


def test_a_policy_of_an_unknown_class_is_named(tmp_path):
    path = tmp_path / "own.zip"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("data", json.dumps({"policy_class": {"__module__": "__main__", "__name__": "MyPolicy"}}))
    with pytest.raises(
        UsageError, match=r"\(its policy is of the class MyPolicy of __main__\); give a zip of SAC, TD3"
    ):
        load_model(path)


def test_a_trained_policy_says_how_to_collect_with_it(tmp_path):
    config = train_policy.Config(tmp_path / "my hand.zip", goal_angle=45)
    words = shlex.split(train_policy.collecting(config))
    asked = tyro.cli(Config, args=words[1:])
    assert (asked.env, asked.policy) == ("dexhand", str(config.out))
    assert json.loads(asked.env_kwargs) == {"goal_angle": 45}


def test_a_part_of_a_run_has_its_own_episodes_and_any_device(trained, tmp_path, monkeypatch):
    devices = []

    def load(path, device, **changes):
        devices.append(device)
        return load_model(path, device, **changes)

    monkeypatch.setattr(train_policy, "load_model", load)
    config = train_policy.Config(copy_of(trained, tmp_path), steps=112, batch=8, buffer=500)
    hand = train_policy._make_env(config)
    new = train_policy._model(dataclasses.replace(config, out=tmp_path / "new.zip"), hand)
    start, action = new.env.reset()["observation"], new.action_space.sample()
    resumed = train_policy._model(config, hand)
    assert not np.array_equal(resumed.env.reset()["observation"], start)
    assert not np.array_equal(resumed.action_space.sample(), action)
    assert devices == ["auto"]
    hand.close()


def test_a_buffer_that_holds_no_whole_episode_is_refused(tmp_path):
    with pytest.raises(UsageError, match="--buffer is 150; give at least 200, two episodes"):
        train_policy.main(train_policy.Config(tmp_path / "new.zip", steps=300, batch=8, buffer=150))
    assert not list(tmp_path.iterdir())


def test_training_with_other_options_is_refused(trained, tmp_path):
    path = copy_of(trained, tmp_path)
    config = train_policy.Config(path, steps=112, batch=8, buffer=500, trials=0)
    for name, value in (("algorithm", "td3"), ("reward", "dense"), ("goal_angle", 90.0), ("learning_rate", 0.1)):
        with pytest.raises(UsageError, match=rf"was trained with {name} = .*, not {value!r}; .* another --out"):
            train_policy.main(dataclasses.replace(config, **{name: value}))
    path.with_suffix(".json").write_text("no options")
    with pytest.raises(UsageError, match=r"hand\.json is there and does not hold the options"):
        train_policy.main(config)
    path.with_suffix(".json").unlink()
    with pytest.raises(UsageError, match=r"hand\.zip has no hand\.json beside it"):
        train_policy.main(config)
    assert path.read_bytes() == trained.read_bytes()


def test_a_file_that_is_no_policys_is_not_overwritten(tmp_path):
    there = tmp_path / "best.json"
    config = train_policy.Config(tmp_path / "best.zip", steps=10, trials=0)
    for content in ('{"learning_rate": 0.01}', "[1, 2]", "no options"):
        there.write_text(content)
        with pytest.raises(UsageError, match=r"best\.json .* choose another --out"):
            train_policy.main(config)
        assert there.read_text() == content
    there.write_text(json.dumps(config.kept_options()))
    train_policy.check_continues(dataclasses.replace(config, goal_angle=90.0))  # killed before it saved a policy


def test_bad_policy_files_are_named(trained, tmp_path, env):
    with pytest.raises(UsageError, match="no policy file"):
        policy_name(tmp_path / "none.zip")
    broken = tmp_path / "broken.zip"
    broken.write_bytes(b"nothing")
    with pytest.raises(UsageError, match=r"broken\.zip is no policy"):
        make_policy(policy_name(broken))
    other = PlanarPushEnv(images=False)
    with pytest.raises(UsageError, match="achieved_goal"):
        make_policy(policy_name(trained)).reset(other, np.random.default_rng(0))
    spaces = dict(env.observation_space.spaces)
    larger = SimpleNamespace(action_space=env.action_space, observation_space=gymnasium.spaces.Dict(spaces))
    larger.observation_space["observation"] = gymnasium.spaces.Box(-1, 1, (62,))
    with pytest.raises(UsageError, match=r"observes observation of shape \(61,\), this environment has \(62,\)"):
        make_policy(policy_name(trained)).reset(larger, np.random.default_rng(0))
    other.close()
    for arguments, named in (
        (["--out", "x.zip", "--env", "planar-push"], "has no goals"),
        (["--out", "x"], r"\.zip"),
        (["--out", "x.zip", "--steps", "0"], "--steps is 0"),
        (["--out", "x.zip", "--learning-rate", "inf"], "--learning-rate is inf"),
    ):
        code, _, err = call("train-policy", arguments)
        assert code == 2
        assert named.replace("\\", "") in err
    code, _, err = call("collect-rollouts", ["--out", str(tmp_path / "d"), "--policy", "dance"])
    assert code == 2
    assert "'dance'" in err
