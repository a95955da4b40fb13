"""Planar pushing as a Gymnasium environment: a tip pushes one of 70 objects about, seen by an RGB-D camera above."""

from __future__ import annotations

from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs.camera import CameraModel
from envs.errors import UsageError
from envs.planar_push import control, objects, placement
from envs.planar_push.hidden import NUMBERS, Hidden
from envs.planar_push.scene import CONTROL_RATE, DEPTH_RANGES, SUBSTEPS, TIP_HEIGHT, build_model
from envs.planar_push.wardrobe import Wardrobe
from envs.rendering import StaticCamera

INTEGRATION_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
RENDER_MODES = ("rgb_array", "depth_array", "rgbd_tuple")
RESET_OPTIONS = ("object", "pose", "tip", "hidden")
OWN_STATE = NUMBERS + 4  # hidden variables; number of the object, heading, seed of the noise, steps
DEPTH_NOISE, ACTION_NOISE = 0, 1  # streams of the noise


class PlanarPushEnv(gymnasium.Env):
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
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise UsageError(f"render_mode is {render_mode!r}; choose one of {', '.join(RENDER_MODES)}")
        for name, value in (("depth_noise", depth_noise), ("action_noise", action_noise)):
            if not 0 <= value < 1:
                raise UsageError(f"{name} is {value!r}; give metres from 0, well below 1")
        self.split, self.render_mode, self.images = split, render_mode, images
        self.depth_noise, self.action_noise = float(depth_noise), float(action_noise)
        self.objects = objects.objects_of(split) if object is None else (objects.canonical(object),)
        self.object_name, self.hidden = self.objects[0], Hidden(0.5, (0.0, 0.0, 0.0, 0.0), 0.4, 0.3)
        self.mj_model = build_model()
        self._wardrobe = Wardrobe(self.mj_model)
        self._wardrobe.wear(self.object_name, self.hidden)
        self.mj_data = mujoco.MjData(self.mj_model)
        self._index_model()
        self._heading, self._noise_seed, self._steps = 0.0, 0, 0
        self._supersample = supersample
        self._cameras: dict[tuple[str, int], StaticCamera] = {}
        self._camera = self._make_camera("static", image_size)
        self._picture: tuple[NDArray[np.uint8], NDArray[np.float32]] | None = None
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.observation_space = self._make_observation_space()

    # --- Gymnasium -------------------------------------------------------------------------------------------------

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Start an episode: a random object with random hidden variables near the middle, the tip beside it.

        Args:
            seed: makes everything that follows repeatable.
            options: any of `object` (its name), `pose` ([x, y, yaw] of the object, m and rad), `tip` ([x, y], m) and
                `hidden` (a `Hidden`, or its vector); what is given is not drawn.

        Raises:
            UsageError: an unknown option, a value that does not fit, or a tip inside of the object.
        """
        super().reset(seed=seed)
        options = options or {}
        unknown = sorted(set(options) - set(RESET_OPTIONS))
        if unknown:
            raise UsageError(f"unknown reset options {unknown}; there are {', '.join(RESET_OPTIONS)}")
        start = placement.draw(self.objects, self.np_random).with_options(options)
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

    def render(self):
        """The picture of the static camera, in the way that `render_mode` says."""
        if self.render_mode is None:
            return None
        rgb, depth = self._look()
        return {"rgb_array": rgb, "depth_array": depth, "rgbd_tuple": (rgb, depth)}[self.render_mode]

    def close(self) -> None:
        """Give the OpenGL contexts back."""
        for camera in self._cameras.values():
            camera.close()

    # --- What others build on --------------------------------------------------------------------------------------

    @property
    def camera(self) -> CameraModel:
        """Intrinsics, pose and depth range of the static camera."""
        return self._camera.geometry

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

    @property
    def body_names(self) -> list[str]:
        """Names of the bodies, in the order of their ids."""
        return [self.mj_model.body(i).name for i in range(self.mj_model.nbody)]

    @property
    def hand_body_ids(self) -> tuple[int, ...]:
        """Bodies of the end-effector: the tip."""
        return (self.mj_model.body("tip").id,)

    def observation(self) -> dict[str, NDArray]:
        """The current observation."""
        proprio = np.append(self.tip_position, self._heading).astype(np.float32)
        observation: dict[str, NDArray] = {"proprio": proprio}
        if self.images:
            rgb, depth = self._look()
            observation = {"rgb": rgb.copy(), "depth": depth.copy(), **observation}
        return observation

    def body_poses(self) -> NDArray[np.float64]:
        """Position and unit quaternion wxyz of every body: (nbody, 7), metres, world frame."""
        return np.concatenate([self.mj_data.xpos, self.mj_data.xquat], axis=1)

    def segmentation(self) -> NDArray[np.int32]:
        """The body id under each pixel of the static camera: (H, W)."""
        return self._camera.segment(self.mj_data)

    def view(self, name: str = "side", size: int = 256) -> NDArray[np.uint8]:
        """A picture (size, size, 3) from the camera `static` or `side`, for people to look at."""
        if name not in DEPTH_RANGES:
            raise UsageError(f"there is no view {name!r}; choose one of {', '.join(DEPTH_RANGES)}")
        return self._make_camera(name, size).render(self.mj_data)[0]

    def get_state(self) -> NDArray[np.float64]:
        """Everything that the future depends on, but the random generator, which only `reset` uses: 1-D float64.

        MuJoCo's integration state, in which the tip's target is an activation, then the hidden variables, the number of
        the object, heading, seed of the noise, and steps since the reset.
        """
        state = np.empty(mujoco.mj_stateSize(self.mj_model, INTEGRATION_STATE))
        mujoco.mj_getState(self.mj_model, self.mj_data, state, INTEGRATION_STATE)
        number = objects.OBJECTS.index(self.object_name)
        return np.concatenate([state, self.hidden.vector(), [number, self._heading, self._noise_seed, self._steps]])

    def set_state(self, state: ArrayLike) -> None:
        """Go back to a state that `get_state` gave, also with another object; what follows is the same to the last bit.

        Raises:
            UsageError: not a state of this environment.
        """
        state = np.array(state, np.float64)
        size = mujoco.mj_stateSize(self.mj_model, INTEGRATION_STATE) + OWN_STATE
        if state.shape != (size,) or not np.isfinite(state).all():
            raise UsageError(f"the state has shape {state.shape}; give {size} finite numbers from get_state()")
        physics, (number, heading, noise_seed, steps) = state[:-OWN_STATE], state[-4:]
        if number not in range(len(objects.OBJECTS)):
            raise UsageError(f"the state is of object number {number}; give a state from get_state()")
        self._put_on(objects.OBJECTS[int(number)], Hidden.from_vector(state[-OWN_STATE:-4]))
        mujoco.mj_setState(self.mj_model, self.mj_data, physics, INTEGRATION_STATE)
        self._heading, self._noise_seed, self._steps = float(heading), int(noise_seed), int(steps)
        self._after_physics()

    def scene_obs(self) -> NDArray[np.float64]:
        """x, y (m), yaw (rad) and number of the object, then the hidden variables: (11,)."""
        return np.concatenate([self.object_pose, [objects.OBJECTS.index(self.object_name)], self.hidden.vector()])

    # --- Inside ----------------------------------------------------------------------------------------------------

    def _index_model(self) -> None:
        start = self.mj_model.joint("object").qposadr[0]
        self.object_qpos = slice(start, start + 7)
        start = self.mj_model.joint("tip_x").qposadr[0]
        self.tip_qpos = slice(start, start + 2)

    def _make_observation_space(self) -> gymnasium.spaces.Dict:
        size, box = self.camera.height, gymnasium.spaces.Box
        bound = np.array([0.3, 0.3, 3.15], np.float32)  # m, m, rad
        spaces: dict[str, gymnasium.Space] = {"proprio": box(-bound, bound, dtype=np.float32)}
        if self.images:
            depth = box(self.camera.near, self.camera.far, (size, size), np.float32)
            spaces = {"rgb": box(0, 255, (size, size, 3), np.uint8), "depth": depth, **spaces}
        return gymnasium.spaces.Dict(spaces)

    def _make_camera(self, name: str, size: int) -> StaticCamera:
        if (name, size) not in self._cameras:
            near, far = DEPTH_RANGES[name]
            camera = StaticCamera(self.mj_model, name, size, size, near, far, supersample=self._supersample)
            self._cameras[name, size] = camera
        return self._cameras[name, size]

    def _put_on(self, name: str, hidden: Hidden) -> None:
        if (name, hidden) != (self.object_name, self.hidden):
            self._wardrobe.wear(name, hidden)
            self.object_name, self.hidden = name, hidden

    def _after_physics(self) -> None:
        """Bring what is seen up to date with the state; leaves the state itself alone."""
        mujoco.mj_kinematics(self.mj_model, self.mj_data)
        mujoco.mj_camlight(self.mj_model, self.mj_data)
        self._picture = None

    def _look(self) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        if self._picture is None:
            rgb, depth = self._camera.render(self.mj_data)
            if self.depth_noise:
                depth = depth + depth**2 * self._noise(DEPTH_NOISE, self.depth_noise, depth.shape)
                depth = np.clip(depth, self.camera.near, self.camera.far).astype(np.float32)
            self._picture = rgb, depth
        return self._picture

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
