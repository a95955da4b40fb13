"""Planar pushing as a Gymnasium environment: a tip pushes one of 70 objects about, seen by an RGB-D camera above."""

from __future__ import annotations

from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs.base import RENDER_MODES, Picture, RGBDEnv
from envs.errors import UsageError
from envs.planar_push import control, objects, placement
from envs.planar_push.hidden import NUMBERS, Hidden
from envs.planar_push.scene import CONTROL_RATE, DEPTH_RANGES, SUBSTEPS, TIP_HEIGHT, build_model
from envs.planar_push.wardrobe import Wardrobe

DEPTH_NOISE, ACTION_NOISE = 0, 1  # streams of the noise


class PlanarPushEnv(RGBDEnv):
    """A round tip at a table pushes an object; there is no task: the reward is 0 and nothing terminates.

    Observation: `rgb` (H, W, 3) uint8, `depth` (H, W) float32 metres, `proprio` (3,) float32: x, y of the tip (m) and
    the last heading (rad). Action: (3,) in [-1, 1]: 0.025 m along the world's x and y, relative to where the tip was
    sent before, and the heading of the push in units of pi. `info["hidden"]` (7,): the hidden variables, see
    `envs.planar_push.hidden`. `info["scene_obs"]` (11,): x, y (m), yaw (rad) and number of the object, then those.

    Args:
        split: which objects episodes have: "train", "validation", "test" or "all".
        object: name of the one object that every episode has, four digits; None draws one from the split.
        image_size: height and width of the pictures, pixels.
        supersample: an odd number; pictures are drawn that many times wider and higher, then averaged.
        render_mode: what `render()` returns: "rgb_array", "depth_array" (metres) or "rgbd_tuple".
        images: whether observations hold `rgb` and `depth`; without them no OpenGL is needed.
        depth_noise: standard deviation of the depth of a pixel at 1 m, metres; it grows with the square of the depth.
        action_noise: standard deviation along x and along y of where an action takes the tip, metres.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": CONTROL_RATE}  # noqa: RUF012
    DEPTH_RANGES = DEPTH_RANGES
    RESET_OPTIONS = ("object", "pose", "tip", "hidden")
    HAND_BODIES = ("tip",)
    OWN_STATE = NUMBERS + 4  # hidden variables; number of the object, heading, seed of the noise, steps
    ACTION_AGGREGATION = control.ACTION_AGGREGATION
    ACTION_SCALE = control.ACTION_SCALE
    control_rate = CONTROL_RATE

    def __init__(
        self,
        split: str = "train",
        object: str | None = None,
        image_size: int = 64,
        supersample: int = 3,
        render_mode: str | None = "rgb_array",
        images: bool = True,
        depth_noise: float = 0.0,
        action_noise: float = 0.0,
    ) -> None:
        for name, value in (("depth_noise", depth_noise), ("action_noise", action_noise)):
            if not 0 <= value < 1:
                raise UsageError(f"{name} is {value!r}; give metres from 0, well below 1")
        self.split, self.depth_noise, self.action_noise = split, float(depth_noise), float(action_noise)
        self.objects = objects.objects_of(split) if object is None else (objects.canonical(object),)
        self.object_name, self.hidden = self.objects[0], Hidden(0.5, (0.0, 0.0, 0.0, 0.0), 0.4, 0.3)
        model = build_model()
        self._wardrobe = Wardrobe(model)
        self._wardrobe.wear(self.object_name, self.hidden)
        bound = np.array([0.3, 0.3, 3.15], np.float32)  # m, m, rad
        proprio = gymnasium.spaces.Box(-bound, bound, dtype=np.float32)
        super().__init__(model, 3, {"proprio": proprio}, image_size, supersample, render_mode, images)
        self._index_model()
        self._heading, self._noise_seed, self._steps = 0.0, 0, 0

    # --- Gymnasium -------------------------------------------------------------------------------------------------

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Start an episode: a random object with random hidden variables near the middle, the tip beside it.

        Args:
            seed: makes everything that follows repeatable.
            options: any of `object` (its name), `pose` ([x, y, yaw] of the object, m and rad), `tip` ([x, y], m) and
                `hidden` (a `Hidden`, or its vector); what is given is not drawn. With `pose` but no `tip` the tip is as
                far from the object as it was drawn, and on the same side if it fits there.

        Raises:
            UsageError: an unknown option, a value that does not fit, a tip inside of the object, or a pose that leaves
                it no place.
        """
        super().reset(seed=seed)
        start = placement.draw(self.objects, self.np_random).with_options(self._check_options(options))
        mujoco.mj_resetData(self.mj_model, self.mj_data)
        self._put_on(start.object_name, start.hidden)
        self._heading, self._noise_seed, self._steps = 0.0, start.noise_seed, 0
        x, y, yaw = start.pose
        self.mj_data.qpos[self.object_qpos] = [x, y, 0, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
        self.mj_data.qpos[self.tip_qpos] = self.mj_data.act[:] = start.tip
        mujoco.mj_step(self.mj_model, self.mj_data, nstep=SUBSTEPS)  # until the object stands
        self._after_physics()
        return self.observation(), self._info()

    def step(self, action: ArrayLike):
        """Move the tip, simulate one control step of 1/12 s.

        Raises:
            UsageError: the action does not have 3 finite numbers.
        """
        checked = control.check_action(action)
        noise = self._noise(ACTION_NOISE, self.action_noise, (2,)) if self.action_noise else 0.0
        start = self.tip_target
        self.mj_data.ctrl[:] = control.motor_commands(start, control.advance(start, checked, noise))
        self._heading = float(checked[2] * control.ACTION_SCALE[2])
        self._steps += 1
        mujoco.mj_step(self.mj_model, self.mj_data, nstep=SUBSTEPS)
        self._after_physics()
        return self.observation(), 0.0, False, False, self._info()

    # --- What others build on --------------------------------------------------------------------------------------

    @property
    def object_pose(self) -> NDArray[np.float64]:
        """Position x, y of the middle of the object, metres, and its yaw, radians in (-pi, pi]: (3,)."""
        return object_poses(self.mj_data.qpos[self.object_qpos])

    @property
    def tip_position(self) -> NDArray[np.float64]:
        """Measured position (2,) of the tip, metres."""
        return self.mj_data.qpos[self.tip_qpos].copy()

    @property
    def tip_target(self) -> NDArray[np.float64]:
        """Where the tip has been sent, (2,) metres."""
        return self.mj_data.act.copy()

    @property
    def tcp_position(self) -> NDArray[np.float64]:
        """Measured position (3,) of the middle of the ball at the end of the tip, metres."""
        return np.append(self.tip_position, TIP_HEIGHT)

    @property
    def tip_workspace(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest corner (2,) of the square that the tip stays in, metres."""
        return control.WORKSPACE_LOW.copy(), control.WORKSPACE_HIGH.copy()

    def scene_obs(self) -> NDArray[np.float64]:
        """x, y (m), yaw (rad) and number of the object, then the hidden variables: (11,)."""
        return np.concatenate([self.object_pose, [objects.OBJECTS.index(self.object_name)], self.hidden.vector()])

    # --- Inside ----------------------------------------------------------------------------------------------------

    def _index_model(self) -> None:
        start = self.mj_model.joint("object").qposadr[0]
        self.object_qpos = slice(start, start + 7)
        start = self.mj_model.joint("tip_x").qposadr[0]
        self.tip_qpos = slice(start, start + 2)

    def _put_on(self, name: str, hidden: Hidden) -> None:
        if (name, hidden) != (self.object_name, self.hidden):
            self._wardrobe.wear(name, hidden)
            self.object_name, self.hidden = name, hidden

    def _measurements(self) -> dict[str, NDArray]:
        return {"proprio": np.append(self.tip_position, self._heading).astype(np.float32)}

    def _own_state(self) -> ArrayLike:
        number = objects.OBJECTS.index(self.object_name)
        return [*self.hidden.vector(), number, self._heading, self._noise_seed, self._steps]

    def _set_own_state(self, own: NDArray[np.float64]) -> None:
        """Also another object."""
        number, heading, noise_seed, steps = own[NUMBERS:]
        if number not in range(len(objects.OBJECTS)):
            raise UsageError(f"the state is of object number {number}; give a state from get_state()")
        self._put_on(objects.OBJECTS[int(number)], Hidden.from_vector(own[:NUMBERS]))
        self._heading, self._noise_seed, self._steps = float(heading), int(noise_seed), int(steps)

    def _take_picture(self) -> Picture:
        rgb, depth = super()._take_picture()
        if self.depth_noise:
            depth = depth + depth**2 * self._noise(DEPTH_NOISE, self.depth_noise, depth.shape)
            depth = np.clip(depth, self.camera.near, self.camera.far).astype(np.float32)
        return rgb, depth

    def _noise(self, stream: int, deviation: float, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """The same for the same step of the same episode, so that a restored state goes on with the same noise."""
        return np.random.default_rng((self._noise_seed, self._steps, stream)).normal(0.0, deviation, shape)

    def _info(self) -> dict[str, Any]:
        return {"object": self.object_name, "hidden": self.hidden.vector(), "scene_obs": self.scene_obs()}


def object_poses(qpos: NDArray[np.float64]) -> NDArray[np.float64]:
    """Position and quaternion wxyz (..., 7) of an object that stands on the table -> x, y, yaw (..., 3)."""
    w, x, y, z = np.moveaxis(qpos[..., 3:], -1, 0)
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.concatenate([qpos[..., :2], yaw[..., None]], axis=-1)
