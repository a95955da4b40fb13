"""Every controller by its name: what `servo-eval --model` can run."""

from __future__ import annotations

from collections.abc import Callable

from planning.controllers.base import Controller, Goal
from planning.controllers.baselines import LinearController, ProportionalController, RandomController
from planning.controllers.kit import Kit
from planning.controllers.oracle import OracleController
from planning.controllers.t3vip import T3VIPController

__all__ = ["CONTROLLERS", "LEARNED", "Controller", "Goal", "Kit"]

# A new controller is one line.
CONTROLLERS: dict[str, Callable[[Kit], Controller]] = {
    "t3vip": lambda kit: T3VIPController(kit.model("t3vip"), kit.camera, kit.planner()),
    "oracle": lambda kit: OracleController(kit.env, kit.simulator, kit.planner(), kit.hold),
    "linear": lambda kit: LinearController(kit.planner(), kit.hold),
    "proportional": lambda kit: ProportionalController(),
    "random": lambda kit: RandomController(kit.hold, kit.rng),
}

LEARNED = ("t3vip",)
"""The controllers that need a world model's weights."""
