"""What the play policy sees of the tabletop: privileged, straight from the simulator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import gymnasium
import mujoco
import numpy as np

from data_collection.policies.play_motion import Array
from envs.tabletop import TabletopEnv
from envs.tabletop.robot import BASE_POSITION
from envs.tabletop.table import CABINET_TOP, HALF_DEPTH, SLOPE_FOOT, SLOPE_OUT
from envs.tabletop.table import TOP as TABLE_TOP

HANDLES = {"drawer": "drawer_handle", "door": "door_handle", "button": "button_top", "switch": "switch_tip"}

# Where the hand can be while it points down: the wrist, this far from the TCP towards the base and upwards, has to
# stay in a sphere about the shoulder. Fitted to inverse kinematics on a grid over the workspace.
WRIST_BACK, WRIST_UP = 0.088, 0.203  # m
SHOULDER_HEIGHT, ARM_LENGTH = 0.333, 0.68  # m
NEAREST = 0.28  # m, horizontally from the base
GAP = 0.02  # m, between TCP and furniture


@dataclass(frozen=True, eq=False)
class Block:
    """A block where it is now: centre (3,) metres, rotation (3,3), half sizes (3,) metres along its own axes."""

    position: Array
    rotation: Array
    half_size: Array


class Scene:
    """Reads a tabletop environment."""

    def __init__(self, env: gymnasium.Env) -> None:
        self.env = cast(TabletopEnv, env.unwrapped)
        self.model: mujoco.MjModel = self.env.mj_model
        self.data: mujoco.MjData = self.env.mj_data
        self.low, self.high = self.env.workspace
        self._tcp_site = self.model.site("tcp").id
        self.optical_axis: Array = self.env.camera.world_T_camera[:3, 2]

    @property
    def tcp(self) -> Array:
        """Measured position of the tool centre point (3,), metres."""
        return self.data.site_xpos[self._tcp_site].copy()

    def free(self, point: Array) -> bool:
        """Whether the hand, pointing down, can be at a point (3,): in the workspace and in reach, in no furniture."""
        inside = (point > self.low).all() and (point < self.high).all()
        radius = float(np.hypot(*(point[:2] - BASE_POSITION[:2])))
        wrist = (radius - WRIST_BACK) ** 2 + (point[2] + WRIST_UP - BASE_POSITION[2] - SHOULDER_HEIGHT) ** 2
        over_table = point[2] > TABLE_TOP + GAP or point[1] < -HALF_DEPTH - 2 * GAP
        over_cabinet = point[2] > CABINET_TOP + 2 * GAP or (point - SLOPE_FOOT) @ SLOPE_OUT > 2 * GAP
        return bool(inside and radius > NEAREST and wrist < ARM_LENGTH**2 and over_table and over_cabinet)

    def handle(self, fixture: str) -> Array:
        """Where to take hold of a fixture (3,), metres."""
        return self.data.site(HANDLES[fixture]).xpos.copy()

    def opening(self, fixture: str) -> float:
        """How far a fixture is moved, as a share of its range."""
        low, high = self.model.joint(fixture).range
        return float((self.data.joint(fixture).qpos[0] - low) / (high - low))

    def travel(self, fixture: str) -> Array:
        """World displacement (3,), metres, of a fixture from closed to fully open."""
        low, high = self.model.joint(fixture).range
        return self.data.joint(fixture).xaxis * (high - low)

    def block(self, name: str) -> Block:
        """A block where it is now."""
        body = self.data.body(name)
        half_size = self.model.geom_size[self.model.body(name).geomadr[0]]
        return Block(body.xpos.copy(), body.xmat.reshape(3, 3).copy(), half_size.copy())
