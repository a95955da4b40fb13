"""What controllers are made of: world models, planners, the camera's geometry; loaded once, shared by all episodes."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from envs.camera import CameraModel
from envs.errors import UsageError
from planning.costs import Reach
from planning.effectors import Arm, Effector
from planning.followers import EffectorFollower, Follower, Surface, SurfaceFollower
from planning.icem import ICEM, ICEMConfig
from planning.marks import Mark
from planning.what_if import WhatIf, what_if
from worldmodel import checkpoint
from worldmodel.interface import Interface, mismatch

FAMILIES = {"t3vip/Tabletop": "", "t3vip/PlanarPush": "planar-push/"}
"""Environments of one kind, by how their ids begin, and before the names of the models that are shipped for them."""


@dataclass
class Kit:
    """The parts that `CONTROLLERS` builds from.

    Attributes:
        env: the environment.
        planner_config: how iCEM searches, the same for every model.
        hold: control steps that a planned move is held for, where no world model's frame gap says so.
        checkpoints: world model -> file or name of its weights; a model that is missing uses the shipped ones.
        device: where world models run.
        deadline: seconds after which a plan must be there, if any.
        body: what is moved.
        surface: what the designated point lies on; None if it is the end-effector's own.
        reach: draws the end-effector to the thing that the point is on, if given.
        rng: randomness of the controllers of this episode.
        mark: where the designated point of this episode truly is, for the oracle; None if it is the end-effector's.
    """

    env: gym.Env
    planner_config: ICEMConfig = field(default_factory=ICEMConfig)
    hold: int = 3
    checkpoints: dict[str, str] = field(default_factory=dict)
    device: str = "cpu"
    deadline: float | None = None
    body: type[Effector] = Arm
    surface: Surface | None = None
    reach: Reach | None = None
    rng: np.random.Generator = field(default_factory=np.random.default_rng)
    mark: Mark | None = None
    _models: dict[str, Any] = field(default_factory=dict, init=False, repr=False)

    def begin(self, mark: Mark | None, rng: np.random.Generator) -> None:
        """The controllers made from here on are those of another episode."""
        self.mark, self.rng = mark, rng

    @property
    def camera(self) -> CameraModel:
        """Geometry of the camera; nothing that moves."""
        return self.env.unwrapped.camera  # type: ignore[attr-defined]

    @functools.cached_property
    def simulator(self) -> WhatIf:
        """What-if in the real simulator; for the oracle only."""
        return what_if(self.env)

    def close(self) -> None:
        """End the simulator's threads."""
        if "simulator" in self.__dict__:
            self.simulator.close()

    def parts(self) -> dict[str, Any]:
        """A new end-effector, and who follows the designated point by observations."""
        effector = self.body()
        follower: Follower
        follower = EffectorFollower(effector) if self.surface is None else SurfaceFollower(self.camera, self.surface)
        return {"effector": effector, "follower": follower}

    def planning_parts(self) -> dict[str, Any]:
        """What every controller that plans is given: a planner with the randomness of this episode, and the parts."""
        limit = np.full(self.body.axes, self.body.limit)
        planner = ICEM(self.planner_config, -limit, limit, self.rng, self.deadline)
        return {"planner": planner, "reach": self.reach, **self.parts()}

    def model(self, name: str) -> Any:
        """The world model of that name, in evaluation mode.

        Raises:
            UsageError: there is no such checkpoint, none was given and none ships for the environment, or it was
                trained for another one.
        """
        if name not in self._models:
            env_id = _env_id(self.env)
            shipped = FAMILIES[_family(env_id)] + name
            if name not in self.checkpoints and shipped not in checkpoint.shipped_models():
                raise UsageError(f"no {name} ships for {env_id}; train one and give it: --checkpoint {name}=FOLDER")
            model = checkpoint.load_model(self.checkpoints.get(name, checkpoint.PRETRAINED / shipped), self.device)
            _check_fits(name, model, self.env)
            self._models[name] = model
        return self._models[name]


def _env_id(env: gym.Env) -> str:
    return env.spec.id if env.spec else type(env.unwrapped).__name__


def _family(env_id: str) -> str:
    return next((family for family in FAMILIES if family in env_id), next(iter(FAMILIES)))


def _check_fits(name: str, model: Any, env: gym.Env) -> None:
    """A model can plan for an environment that sees and acts like the one it was trained in."""
    if model.kind != name:
        raise UsageError(f"the checkpoint given for {name} is a {model.kind}; give the weights of a {name}")
    trained, env_id = model.context.env_id, _env_id(env)
    family = _family(env_id)
    if family not in trained:
        raise UsageError(f"the {name} checkpoint was trained in {trained}, not in {env_id}; give one of a {family}")
    inner: Any = env.unwrapped
    here = Interface(env_id, inner.camera, inner.ACTION_AGGREGATION, tuple(inner.ACTION_SCALE), inner.control_rate)
    difference = mismatch(here, Interface.of_model(model))
    if difference is not None:
        raise UsageError(
            f"{env_id} has {difference}, which the {name} checkpoint was trained on; give another checkpoint"
            " or, for the image size, --image-size"
        )
    if model.action_dim != env.action_space.shape[0]:  # type: ignore[index]
        raise UsageError(
            f"the {name} checkpoint takes actions of {model.action_dim} numbers, {env_id} of"
            f" {env.action_space.shape[0]}; give one that was trained on its actions"  # type: ignore[index]
        )
