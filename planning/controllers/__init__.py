"""Every controller by its name: what `servo-eval --model` can run."""

from __future__ import annotations

from collections.abc import Callable

from planning.controllers.base import Controller, Goal
from planning.controllers.baselines import LinearController, ProportionalController, RandomController
from planning.controllers.kit import Kit
from planning.controllers.oracle import OracleController
from planning.controllers.pixel import PixelController
from planning.controllers.t3vip import T3VIPController

__all__ = ["CONTROLLERS", "LEARNED", "PIXEL_MODELS", "Controller", "Goal", "Kit"]

PIXEL_MODELS = ("sv2p", "sna", "cdna")
"""The controllers that know their goal as a pixel."""

LEARNED = ("t3vip", *PIXEL_MODELS)
"""The controllers that need a world model's weights."""


def _pixel(name: str) -> Callable[[Kit], Controller]:
    return lambda kit: PixelController(name, kit.model(name), kit.camera, kit.planner())


# A new controller is one line.
CONTROLLERS: dict[str, Callable[[Kit], Controller]] = {
    "t3vip": lambda kit: T3VIPController(kit.model("t3vip"), kit.camera, kit.planner()),
    **{name: _pixel(name) for name in PIXEL_MODELS},
    "oracle": lambda kit: OracleController(kit.env, kit.simulator, kit.planner(), kit.hold),
    "linear": lambda kit: LinearController(kit.planner(), kit.hold),
    "proportional": lambda kit: ProportionalController(),
    "random": lambda kit: RandomController(kit.hold, kit.rng),
}
