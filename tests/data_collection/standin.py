"""A stand-in environment: a bright square moved over a grey plane, without a simulator or OpenGL.

It can be made to misbehave through environment variables, which worker processes inherit:
STANDIN_FAULT = kill | hang | raise, at the third step of episode STANDIN_EPISODE (by its reset seed), once if
STANDIN_MARK names a file (which is then made), else always. STANDIN_SLEEP = seconds a step takes.
"""

import os
import signal
import time
from pathlib import Path

import gymnasium
import numpy as np

from envs.camera import CameraModel

NEAR, FAR = 1.0, 3.0


class StandIn(gymnasium.Env):
    ACTION_AGGREGATION = ("sum", "sum", "last")
    ACTION_SCALE = (0.1, 0.1, 1.0)
    SIGNS = (2,)
    control_rate = 10
    body_names = ("world", "square")
    hand_body_ids = (1,)
    gl_renderer = "none"
    workspace = (np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 0.1]))

    def __init__(self, image_size: int = 16) -> None:
        self.size = image_size
        self.camera = CameraModel.from_fovy(image_size, image_size, 45.0, np.eye(4), NEAR, FAR)
        self.action_space = gymnasium.spaces.Box(-1, 1, (3,), np.float32)
        self.observation_space = gymnasium.spaces.Dict(
            rgb=gymnasium.spaces.Box(0, 255, (image_size, image_size, 3), np.uint8),
            depth=gymnasium.spaces.Box(NEAR, FAR, (image_size, image_size), np.float32),
            proprio=gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float32),
        )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-0.5, 0.5, 2)
        self.steps, self.episode_seed = 0, seed
        return self._observe(), {"scene_obs": np.r_[self.place, 0.0]}

    def step(self, action):
        self.steps += 1
        time.sleep(float(os.environ.get("STANDIN_SLEEP", 0)))
        if self.steps == 3 and os.environ.get("STANDIN_EPISODE") == str(self.episode_seed):
            misbehave()
        self.place = np.clip(self.place + 0.1 * action[:2], -1, 1)
        return self._observe(), float(self.place[0]), False, False, {"scene_obs": np.r_[self.place, 0.0]}

    def get_state(self):
        return np.r_[self.place, self.steps].astype(np.float64)

    def segmentation(self):
        ids = np.zeros((self.size, self.size), np.int32)
        row, column = ((self.place + 1) / 2 * (self.size - 4)).astype(int)
        ids[row : row + 4, column : column + 4] = 1
        return ids

    def body_poses(self):
        return np.array([[0, 0, 0, 1, 0, 0, 0], [*self.place, 0, 1, 0, 0, 0]], float)

    def _observe(self):
        square = self.segmentation() == 1
        rgb = np.where(square[..., None], 250, 60).astype(np.uint8).repeat(3, axis=2)
        depth = np.where(square, 1.5, 2.5).astype(np.float32)
        return {"rgb": rgb, "depth": depth, "proprio": np.r_[self.place, 0.05].astype(np.float32)}


def misbehave() -> None:
    mark = os.environ.get("STANDIN_MARK")
    if mark is not None:
        if Path(mark).exists():
            return
        Path(mark).touch()
    fault = os.environ["STANDIN_FAULT"]
    if fault == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    elif fault == "hang":
        os.kill(os.getpid(), signal.SIGSTOP)
    raise RuntimeError("the square fell off the plane")


def reset_seed(seed: int, episode: int) -> int:
    """The seed that the collector resets the environment with in an episode."""
    return int(np.random.SeedSequence((seed, episode)).spawn(2)[0].generate_state(1)[0] >> 1)


gymnasium.register("standin/Square-v0", entry_point=StandIn)


class Ending(StandIn):
    """Terminates or truncates every episode at its third step."""

    def __init__(self, image_size: int = 16, terminates: bool = True) -> None:
        super().__init__(image_size)
        self.terminates = terminates

    def step(self, action):
        obs, reward, _, _, info = super().step(action)
        over = self.steps == 3
        return obs, reward, over and self.terminates, over and not self.terminates, info


gymnasium.register("standin/Ending-v0", entry_point=Ending)


class Paced(StandIn):
    """Of one size, with a keyword of its own: how far the square goes, against the stand-in's."""

    def __init__(self, pace: float = 1.0) -> None:
        super().__init__()
        self.pace = pace

    def step(self, action):
        return super().step(self.pace * action)


gymnasium.register("standin/Paced-v0", entry_point=Paced)


class Blind(gymnasium.Env):
    """Neither camera nor images."""

    observation_space = action_space = gymnasium.spaces.Box(-1, 1, (3,), np.float32)

    def __init__(self, image_size: int = 16) -> None:
        pass


gymnasium.register("standin/Blind-v0", entry_point=Blind)
