"""Every controller by its name: what `servo-eval --model` can run."""

from __future__ import annotations

from collections.abc import Callable

from planning.controllers.base import Controller, Goal
from planning.controllers.baselines import LinearController, ProportionalController, RandomController
from planning.controllers.kit import Kit
from planning.controllers.oracle import OracleController
from planning.controllers.pixel import PIXEL_MODELS, PixelController
from planning.controllers.t3vip import T3VIPController

__all__ = ["CONTROLLERS", "LEARNED", "PIXEL_MODELS", "Controller", "Goal", "Kit"]

LEARNED = ("t3vip", *PIXEL_MODELS)
"""The controllers that need a world model's weights."""


def _pixel(name: str) -> Callable[[Kit], Controller]:
    return lambda kit: PixelController(kit.model(name), kit.camera, **kit.planning_parts())


# A new controller is one line; its results and films go by its name here.
CONTROLLERS: dict[str, Callable[[Kit], Controller]] = {
    "t3vip": lambda kit: T3VIPController(kit.model("t3vip"), kit.camera, **kit.planning_parts()),
    **{name: _pixel(name) for name in PIXEL_MODELS},
    "oracle": lambda kit: OracleController(kit.simulator, kit.mark, hold=kit.hold, **kit.planning_parts()),
    "linear": lambda kit: LinearController(hold=kit.hold, **kit.planning_parts()),
    "proportional": lambda kit: ProportionalController(**kit.parts()),
    "random": lambda kit: RandomController(kit.hold, kit.rng, kit.body()),
}
