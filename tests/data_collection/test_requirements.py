"""What an environment must be like to be collected from; what is not stored as it was given is refused."""

import gymnasium
import numpy as np
import pytest
from commands import assert_one_line_error, call, options
from standin import StandIn

from data_collection import environments, train_policy
from data_collection.environments import KNOWN_ENVS, describe_env, known_env, make_env, versions
from data_collection.policies.random import RandomPolicy
from data_collection.rollout import collect_episode
from envs.errors import UsageError

BOX = gymnasium.spaces.Box
ID = "requirements/Odd-v0"


class Odd(StandIn):
    """The stand-in, with something else as it should not be."""

    def __init__(self, observes=None, acts=None, **attributes) -> None:
        super().__init__()
        self.observation_space = gymnasium.spaces.Dict({**self.observation_space.spaces, **(observes or {})})
        self.action_space = acts or self.action_space
        for name, value in attributes.items():
            setattr(self, name, value)


gymnasium.register(ID, entry_point=Odd)


@pytest.mark.parametrize(
    ("odd", "words"),
    [
        ({"observes": {"rgb": BOX(0, 1, (16, 16, 3), np.float32)}}, r"'rgb' as float32 \(16, 16, 3\).*needs uint8"),
        ({"observes": {"rgb": BOX(0, 255, (3, 16, 16), np.uint8)}}, r"'rgb' as uint8 \(3, 16, 16\).*\(16, 16, 3\)"),
        (
            {"observes": {"rgb": BOX(0, 255, (24, 24, 3), np.uint8)}},
            r"\(24, 24, 3\).*\(16, 16, 3\), as its camera",
        ),
        ({"observes": {"depth": BOX(0, 65535, (16, 16), np.uint16)}}, "'depth' as uint16.*metres"),
        ({"observes": {"depth": BOX(1, 3, (16, 16, 1), np.float32)}}, r"'depth' as float32 \(16, 16, 1\).*\(16, 16\)"),
        ({"observes": {"proprio": BOX(-1, 1, (2, 3), np.float32)}}, r"'proprio' as float32 \(2, 3\).*a vector"),
        ({"acts": gymnasium.spaces.Discrete(4)}, r"takes actions Discrete\(4\)"),
        ({"acts": BOX(-1, np.inf, (3,), np.float32)}, "takes actions Box.*without bounds"),
        ({"acts": BOX(-1, 1, (2,), np.float32)}, "has ACTION_AGGREGATION .*one for each of the 2 numbers"),
        ({"ACTION_SCALE": (1.0,)}, r"has ACTION_SCALE \(1.0,\); it must have one for each of the 3 numbers"),
        ({"camera": "static"}, "has a str as camera"),
        ({"workspace": np.ones(3)}, r"workspace of shape \(3,\); make it \(2, 3\).*or leave it out"),
        ({"body_names": ["part"] * 257}, "257 bodies.*256; leave out --ground-truth"),
    ],
)
def test_what_a_dataset_does_not_store_is_refused_before_an_episode(odd, words):
    with pytest.raises(UsageError, match=words):
        make_env(ID, odd, ground_truth=True)


@pytest.mark.parametrize(
    ("name", "ours"),
    [
        ("planar-push", "planar-push"),
        ("t3vip/TabletopD-v0", "tabletop"),
        ("envs:t3vip/DexHand-v0", "dexhand"),
        ("lab/TabletopSort-v0", None),
        ("t3vip/TabletopSort-v0", None),
        ("lab:other-t3vip/DexHand-v0", None),
        ("t3vip/PlanarPush-v0.1", None),
    ],
)
def test_an_environment_is_ours_only_by_its_whole_id(name, ours):
    assert known_env(name) is (KNOWN_ENVS[ours] if ours else None)


def test_the_versions_of_all_that_makes_scenes_are_told():
    told = versions()
    assert all(told.values()) and {"gymnasium-robotics", "dm_control", "scipy", "fast-simplification"} <= set(told)


def test_what_draws_anothers_pictures_is_what_it_says(monkeypatch):
    def refuse():
        raise UsageError("no OpenGL works")

    monkeypatch.setattr(environments, "gl_renderer", refuse)
    assert describe_env(make_env(ID, {"gl_renderer": "a printer"}, False), ID, {})["gl_renderer"] == "a printer"
    monkeypatch.delattr(StandIn, "gl_renderer")
    assert describe_env(make_env(ID, {}, False), ID, {})["gl_renderer"] == "unknown"


class Goals(gymnasium.Env):
    """Another's environment with goals, which knows no keyword `images`."""

    action_space = BOX(-1, 1, (2,))

    def compute_reward(self, achieved, desired, info):
        return -1.0


gymnasium.register("requirements/Goals-v0", entry_point=Goals, max_episode_steps=10)


def test_policies_are_trained_in_others_environments_too(tmp_path):
    env = train_policy._make_env(train_policy.Config(tmp_path / "new.zip", env="requirements/Goals-v0"))
    assert isinstance(env.unwrapped, Goals)


def test_256_bodies_will_do_and_more_without_ground_truth():
    make_env(ID, {"body_names": ["part"] * 256}, ground_truth=True)
    make_env(ID, {"body_names": ["part"] * 300}, ground_truth=False)


class Liar(StandIn):
    """Gives other pictures than its spaces say."""

    def _observe(self):
        return {**super()._observe(), "rgb": np.full((16, 16, 3), 0.5)}


class Holey(StandIn):
    """Has no depth for one pixel."""

    def _observe(self):
        observation = super()._observe()
        observation["depth"][3, 4] = np.nan
        return observation


gymnasium.register("requirements/Holey-v0", entry_point=Holey)


def test_depth_with_holes_is_refused_in_one_line(tmp_path):
    result = call("collect-rollouts", options(tmp_path, env="test_requirements:requirements/Holey-v0"))
    assert_one_line_error(result, "depth has NaN in 1 of 256 pixels", "fill such holes first")
    assert "lost episode" not in result[2] and not list(tmp_path.glob("*.h5"))


class Crowd(StandIn):
    def segmentation(self):
        return np.full((16, 16), 256, np.int32)


class Nowhere(StandIn):
    def segmentation(self):
        return np.full((16, 16), -1, np.int32)


class Late(StandIn):
    """Forgets something at first."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)[0], {}


class Fitful(StandIn):
    """Measures its joints every other step."""

    def step(self, action):
        *rest, info = super().step(action)
        return *rest, info | ({"joint_delta": np.zeros(2)} if self.steps % 2 else {})


@pytest.mark.parametrize(("env", "name"), [(Late, "scene_obs"), (Fitful, "joint_delta")])
def test_infos_that_have_something_now_and_then_are_refused(env, name):
    with pytest.raises(UsageError, match=f"info has '{name}' now and then; give it in .*every step"):
        collect_episode(env(), RandomPolicy(), 3, seed=0, episode=0)


@pytest.mark.parametrize(
    ("env", "words"),
    [
        (Liar, "'rgb' as float64 from 0.5 to 0.5; .* whole numbers from 0 to 255"),
        (Crowd, "'segmentation' as int32 from 256 to 256"),
        (Nowhere, "'segmentation' as int32 from -1 to -1"),
    ],
)
def test_colours_and_ids_that_do_not_fit_are_refused(env, words):
    with pytest.raises(UsageError, match=words):
        collect_episode(env(), RandomPolicy(), 2, seed=0, episode=0, ground_truth=True)
