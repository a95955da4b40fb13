"""Seconds of a planned action."""

from __future__ import annotations

import statistics
from typing import Any

import gymnasium
import numpy as np

import envs  # noqa: F401  (registers the environments)
from envs.errors import UsageError
from planning.controllers import Goal
from planning.controllers.t3vip import T3VIPController
from planning.icem import ICEM, ICEMConfig
from worldmodel.checkpoint import load_model
from worldmodel.config import ModelContext
from worldmodel.options import PRESETS
from worldmodel.t3vip import T3VIP

WAY_M = np.array([0.1, 0.15, 0.15])  # from the TCP to the goal


def action_seconds(decisions: int, search: dict[str, Any], device: str = "cpu") -> dict[str, Any]:
    """Median seconds of a decision of the T3VIP controller on tabletop D, after the first.

    Args:
        decisions: how many count.
        search: changes to the default `ICEMConfig`.
        device: where the model runs.

    Returns:
        "seconds"; "rollouts" of one decision; "model", `shipped` or, where none is shipped, `untrained`.
    """
    env = gymnasium.make("t3vip/TabletopD-v0", max_episode_steps=-1, disable_env_checker=True)
    observation, _ = env.reset(seed=0)
    tabletop: Any = env.unwrapped
    try:
        model, kind = load_model("t3vip"), "shipped"
    except UsageError:
        model, kind = T3VIP(PRESETS["cpu"].architecture, _context(tabletop)).eval(), "untrained"
    config = ICEMConfig(**search)
    planner = ICEM(config, -np.ones(3), np.ones(3), np.random.default_rng(0))
    controller = T3VIPController(model.to(device), tabletop.camera, planner)
    point = tabletop.tcp_position + WAY_M
    controller.reset(observation, Goal(point, tabletop.camera.project(tabletop.camera.to_camera(point))))
    while len(controller.plan_seconds) <= decisions:
        observation, *_ = env.step(controller.act(observation))
    seconds = statistics.median(controller.plan_seconds[1:])
    return {"seconds": seconds, "rollouts": sum(config.populations()), "model": kind}


def _context(tabletop: Any) -> ModelContext:
    return ModelContext(
        env_id="t3vip/TabletopC-v0",
        camera=tabletop.camera.to_json(),
        action_dim=7,
        frame_gap=PRESETS["cpu"].frame_gap,
        control_rate=float(tabletop.control_rate),
        action_aggregation=tuple(tabletop.ACTION_AGGREGATION),
        action_scale=tuple(tabletop.ACTION_SCALE),
        action_mean=(0.0,) * 7,
        action_std=(1.0,) * 7,
    )
