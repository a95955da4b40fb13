"""What `servo-eval` knows how to ask: which environment, whose point, and with what the controllers look for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym

from planning.costs import Reach
from planning.drawer_setups import make_drawer_setup
from planning.effectors import Arm, Effector, Tip
from planning.followers import Surface
from planning.icem import ICEMConfig
from planning.push_setups import make_push_setup
from planning.setups import Setup, make_setup


@dataclass(frozen=True)
class Task:
    """A point to be servoed.

    Attributes:
        env_id: Gymnasium id of the environment; `{scene}` stands for the scene.
        scenes: of the environment; the first is the usual one, which no shipped model was trained on.
        scene_keyword: keyword argument that the scene goes to; "" if it is part of the id.
        make_setup: environment, index and seed -> the setup.
        where: what stands in titles; `{scene}` for the scene.
        body: what is moved.
        surface: what the point lies on; None for the end-effector's own point.
        reach: draws the end-effector to the thing that the point is on.
        steps: usual budget of control steps.
        planner: usual search.
        zoom: of films.
    """

    env_id: str
    scenes: tuple[str, ...]
    make_setup: Callable[[gym.Env, int, int], Setup]
    where: str
    scene_keyword: str = ""
    body: type[Effector] = Arm
    surface: Surface | None = None
    reach: Reach | None = None
    steps: int = 100
    planner: ICEMConfig = field(default_factory=ICEMConfig)
    zoom: float = 1.0

    def make_env(self, scene: str, image_size: int) -> gym.Env:
        """The environment, without a time limit."""
        chosen: dict[str, Any] = {self.scene_keyword: scene} if self.scene_keyword else {}
        return gym.make(
            "envs:" + self.env_id.replace("{scene}", scene),
            image_size=image_size,
            max_episode_steps=-1,
            disable_env_checker=True,
            **chosen,
        )


TASKS: dict[tuple[str, str], Task] = {
    ("tabletop", "hand"): Task(
        "t3vip/Tabletop{scene}-v0", ("D", "A", "B", "C"), make_setup, "servo on scene {scene}",
        planner=ICEMConfig(init_std=0.1),
    ),
    ("tabletop", "drawer"): Task(
        "t3vip/Tabletop{scene}-v0", ("D", "A", "B", "C"), make_drawer_setup, "drawer of scene {scene}",
        surface=Surface(extent=0.1, step=0.03, colour=0.08, radius=0.05), planner=ICEMConfig(horizon=5),
    ),
    ("planar-push", "object"): Task(
        "t3vip/PlanarPush-v0", ("test", "validation", "train", "all"), make_push_setup, "push {scene} objects",
        scene_keyword="split", body=Tip, surface=Surface(extent=0.08, step=0.01, colour=1.0, radius=0.025),
        reach=Reach(0.5, 0.1), planner=ICEMConfig(horizon=6), zoom=1.5,
    ),
}  # fmt: skip
"""Environment and point -> the task; the first point of an environment is the usual one."""
