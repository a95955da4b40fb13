"""Training a policy in an environment with goals that is not the dexterous hand."""

import gymnasium
import numpy as np
import pytest
from commands import assert_one_line_error, call

BOX = gymnasium.spaces.Box


class Point(gymnasium.Env):
    """A point that is to go to another."""

    observation_space = gymnasium.spaces.Dict(
        {name: BOX(-9, 9, (2,)) for name in ("observation", "achieved_goal", "desired_goal")}
    )
    action_space = BOX(-1, 1, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.goal = self.np_random.uniform(-1, 1, (2, 2)).astype(np.float32)
        return self._observe(), {}

    def step(self, action):
        self.place = np.clip(self.place + action, -9, 9)
        return self._observe(), self.compute_reward(self.place, self.goal, {}), False, False, {}

    def compute_reward(self, achieved, desired, info):
        return -np.linalg.norm(achieved - desired, axis=-1)

    def _observe(self):
        return {"observation": self.place, "achieved_goal": self.place, "desired_goal": self.goal}


gymnasium.register("train_policy/Point-v0", entry_point=Point, max_episode_steps=5)
ARGUMENTS = ["--env", "train_policy/Point-v0", "--steps", "8", "--buffer", "20", "--batch", "2", "--trials", "2"]


def test_only_what_the_environment_tells_is_reported(tmp_path):
    path = tmp_path / "point.zip"
    code, out, err = call("train-policy", ["--out", path, *ARGUMENTS])
    assert code == 0, err
    assert out.splitlines() == [
        f"{path}: 8 steps; use it with: collect-rollouts --env train_policy/Point-v0 --policy {path} --out DIR",
        "in 2 episodes: goal reached at the end of 0",
    ]


@pytest.mark.parametrize(("option", "value"), [("--goal-angle", "30.0"), ("--reward", "dense")])
def test_options_of_the_hand_are_refused_elsewhere(tmp_path, option, value):
    result = call("train-policy", ["--out", tmp_path / "point.zip", *ARGUMENTS, option, value])
    assert_one_line_error(result, f"{option} is {value}", "dexhand", "leave it out")
    assert not list(tmp_path.iterdir())
