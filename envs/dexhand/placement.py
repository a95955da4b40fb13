"""How an episode starts: the hand half closed, somehow, and a cube that has come to lie in it, somehow."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs.dexhand import control
from envs.dexhand.goals import HOME, is_dropped, random_turn
from envs.dexhand.scene import SUBSTEPS
from envs.errors import UsageError
from envs.reset_options import option_numbers

POSTURE_SPREAD = 0.12  # standard deviation of each action number about the middle, where the hand is a bowl
FALL, PLACE_SPREAD = 0.03, 0.004  # m, above where the cube comes to lie; standard deviation in x and y
SETTLE_STEPS = 25  # control steps, 1 s
TRIES = 50

Array = NDArray[np.float64]


def start(
    model: mujoco.MjModel, data: mujoco.MjData, cube: slice, options: dict[str, Any], rng: np.random.Generator
) -> None:
    """Put hand and cube in place and let them come to rest.

    Args:
        model: of the environment.
        data: is changed; its targets are those that the hand holds.
        cube: of the cube's pose in qpos.
        options: `hand` (20,), the action that the hand has taken, and `cube`, orientation (4,) that the cube is let go
            with; what is not given is drawn.
        rng: source of what is drawn.

    Raises:
        UsageError: an option does not fit, or the cube does not stay in a hand like this.
    """
    for _ in range(TRIES):
        drawn = rng.normal(0, POSTURE_SPREAD, control.ACTUATORS)
        hand = option_numbers("hand", options["hand"], control.ACTUATORS) if "hand" in options else drawn
        turn = unit_quaternion("cube", options["cube"]) if "cube" in options else random_turn(np.pi, rng)
        mujoco.mj_resetData(model, data)
        data.ctrl[:] = control.joint_targets(model, control.check_action(hand))
        place = HOME + np.append(rng.normal(0, PLACE_SPREAD, 2), FALL)
        data.qpos[cube] = np.concatenate([place, turn])
        _take_posture(model, data)
        mujoco.mj_step(model, data, nstep=SETTLE_STEPS * SUBSTEPS)
        if not is_dropped(data.qpos[cube]):
            return
    raise UsageError(f"the cube fell {TRIES} times out of a hand at {options.get('hand')}; give another `hand`")


def _take_posture(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Every driven joint where its target is, the last joint of a finger as its coupled neighbour."""
    for actuator in range(model.nu):
        joint = model.actuator_trnid[actuator, 0]
        data.qpos[model.jnt_qposadr[joint]] = data.ctrl[actuator]
        name = model.joint(joint).name
        if name.endswith("FJ1"):
            data.qpos[model.joint(name[:-1] + "0").qposadr[0]] = data.ctrl[actuator]


def unit_quaternion(name: str, value: ArrayLike) -> Array:
    """The option of this name as a quaternion (4,) of length 1."""
    quaternion = option_numbers(name, value, 4)
    if not 0.5 < np.linalg.norm(quaternion) < 2:
        raise UsageError(f"the option {name} is {value!r}; give a unit quaternion (w, x, y, z)")
    return quaternion / np.linalg.norm(quaternion)
