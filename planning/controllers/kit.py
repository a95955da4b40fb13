"""What controllers are made of: world models, planners, the camera's geometry; loaded once, shared by all episodes."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from envs.camera import CameraModel
from envs.errors import UsageError
from envs.tabletop.simulate import BatchSimulator
from planning.icem import ICEM, ICEMConfig
from worldmodel import checkpoint

TRANSLATION_LOW, TRANSLATION_HIGH = -np.ones(3), np.ones(3)


@dataclass
class Kit:
    """The parts that `CONTROLLERS` builds from.

    Attributes:
        env: the tabletop environment.
        planner_config: how iCEM searches, the same for every model.
        hold: control steps that a planned translation is held for, where no world model's frame gap says so.
        checkpoints: world model -> file or name of its weights; a model that is missing uses the shipped ones.
        device: where world models run.
        deadline: seconds after which a plan must be there, if any.
        rng: randomness of the next controller that is made.
    """

    env: gym.Env
    planner_config: ICEMConfig = field(default_factory=ICEMConfig)
    hold: int = 3
    checkpoints: dict[str, str] = field(default_factory=dict)
    device: str = "cpu"
    deadline: float | None = None
    rng: np.random.Generator = field(default_factory=np.random.default_rng)
    _models: dict[str, Any] = field(default_factory=dict, init=False, repr=False)

    @property
    def camera(self) -> CameraModel:
        """Geometry of the camera; nothing that moves."""
        return self.env.unwrapped.camera  # type: ignore[attr-defined]

    @functools.cached_property
    def simulator(self) -> BatchSimulator:
        """What-if in the real simulator; for the oracle only."""
        return BatchSimulator(self.env.unwrapped)  # type: ignore[arg-type]

    def close(self) -> None:
        """End the simulator's threads."""
        if "simulator" in self.__dict__:
            self.simulator.close()

    def planner(self) -> ICEM:
        """A planner of translations, with the randomness of this episode."""
        return ICEM(self.planner_config, TRANSLATION_LOW, TRANSLATION_HIGH, self.rng, self.deadline)

    def model(self, name: str) -> Any:
        """The world model of that name, in evaluation mode.

        Raises:
            UsageError: there is no such checkpoint, or it was trained for another environment.
        """
        if name not in self._models:
            model = checkpoint.load_model(self.checkpoints.get(name, name), self.device)
            _check_fits(name, model, self.env)
            self._models[name] = model
        return self._models[name]


def _check_fits(name: str, model: Any, env: gym.Env) -> None:
    """A model can plan for an environment that sees and acts like the one it was trained in."""
    if model.kind != name:
        raise UsageError(f"the checkpoint given for {name} is a {model.kind}; give the weights of a {name}")
    trained, env_id = model.context.env_id, env.spec.id if env.spec else type(env.unwrapped).__name__
    family = "t3vip/Tabletop"
    if family not in trained:
        raise UsageError(f"the {name} checkpoint was trained in {trained}, not in {env_id}; give one of a {family}")
    camera: CameraModel = env.unwrapped.camera  # type: ignore[attr-defined]
    size, wanted = (camera.width, camera.height), (model.camera.width, model.camera.height)
    if size != wanted:
        raise UsageError(f"the {name} checkpoint wants {wanted} images, {env_id} gives {size}; set image-size")
    if model.action_dim != env.action_space.shape[0]:  # type: ignore[index]
        raise UsageError(
            f"the {name} checkpoint takes actions of {model.action_dim} numbers, {env_id} of"
            f" {env.action_space.shape[0]}; give one that was trained on its actions"  # type: ignore[index]
        )
