"""What the environments have in common: a MuJoCo model that RGB-D cameras look at, and whose state can be restored."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs.camera import CameraModel
from envs.errors import UsageError
from envs.rendering import VISIBLE_GROUPS, StaticCamera

INTEGRATION_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
RENDER_MODES = ("rgb_array", "depth_array", "rgbd_tuple")

Picture = tuple[NDArray[np.uint8], NDArray[np.float32]]


class RGBDEnv(gymnasium.Env, ABC):
    """A MuJoCo model seen by an RGB-D camera that stands still; the base of the environments here.

    A subclass states what is below, implements `reset`, `step`, `_measurements`, `_own_state` and `_set_own_state`, and
    calls `_after_physics` whenever the state has changed.

    Args:
        model: the compiled model, with a camera `static`.
        action_size: how many numbers in [-1, 1] an action has.
        measurements: the spaces of what is observed beside the pictures.
        image_size: height and width of the pictures, pixels.
        supersample: an odd number; pictures are drawn that many times wider and higher, then averaged.
        render_mode: what `render()` returns: "rgb_array", "depth_array" (metres), "rgbd_tuple" or None.
        images: whether observations hold `rgb` and `depth`; without them no OpenGL is needed.
    """

    DEPTH_RANGES: ClassVar[dict[str, tuple[float, float]]]
    """Nearest and farthest depth of each camera, metres; `static` is the one that models see."""
    RESET_OPTIONS: ClassVar[tuple[str, ...]]
    """What `reset` takes."""
    HAND_BODIES: ClassVar[tuple[str, ...]]
    """Names of the bodies of the end-effector."""
    OWN_STATE: ClassVar[int]
    """How many numbers a state has beside MuJoCo's."""
    ACTION_AGGREGATION: ClassVar[tuple[str, ...]]
    """How each number of an action adds up over a frame gap: "sum", "rotate" or "last"."""
    ACTION_SCALE: tuple[float, ...]
    """What 1 stands for in each number of an action, m, rad or a sign."""
    SIGNS: ClassVar[tuple[int, ...]] = ()
    """Which numbers of an action are signs, as a gripper's is: nothing but being below 0 or not counts."""
    control_rate: ClassVar[int]
    """Control steps in a second."""

    def __init__(
        self,
        model: mujoco.MjModel,
        action_size: int,
        measurements: Mapping[str, gymnasium.Space],
        image_size: int,
        supersample: int,
        render_mode: str | None,
        images: bool,
    ) -> None:
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise UsageError(f"render_mode is {render_mode!r}; choose one of {', '.join(RENDER_MODES)}")
        self.render_mode, self.images = render_mode, images
        self.mj_model, self.mj_data = model, mujoco.MjData(model)
        self._supersample = supersample
        self._camera = self._make_camera("static", image_size)
        self._views: dict[str, StaticCamera] = {}
        self._picture: Picture | None = None
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (action_size,), np.float32)
        self.observation_space = gymnasium.spaces.Dict({**self._picture_spaces(), **measurements})

    # --- Gymnasium -------------------------------------------------------------------------------------------------

    def render(self):
        """The picture of the static camera, in the way that `render_mode` says."""
        if self.render_mode is None:
            return None
        rgb, depth = (image.copy() for image in self._look())  # the caller may draw on them
        return {"rgb_array": rgb, "depth_array": depth, "rgbd_tuple": (rgb, depth)}[self.render_mode]

    def close(self) -> None:
        """Give the OpenGL contexts back."""
        for camera in (self._camera, *self._views.values()):
            camera.close()

    # --- What others build on --------------------------------------------------------------------------------------

    @property
    def camera(self) -> CameraModel:
        """Intrinsics, pose and depth range of the static camera."""
        return self._camera.geometry

    @property
    def body_names(self) -> list[str]:
        """Names of the bodies, in the order of their ids."""
        return [self.mj_model.body(i).name for i in range(self.mj_model.nbody)]

    @property
    def hand_body_ids(self) -> tuple[int, ...]:
        """Bodies of the end-effector."""
        return tuple(self.mj_model.body(name).id for name in self.HAND_BODIES)

    @property
    def state_size(self) -> int:
        """How many numbers a state has."""
        return mujoco.mj_stateSize(self.mj_model, INTEGRATION_STATE) + self.OWN_STATE

    def observation(self) -> dict[str, NDArray]:
        """The current observation."""
        if not self.images:
            return self._measurements()
        rgb, depth = self._look()
        return {"rgb": rgb.copy(), "depth": depth.copy(), **self._measurements()}

    def body_poses(self) -> NDArray[np.float64]:
        """Position and unit quaternion wxyz of every body: (nbody, 7), metres, world frame."""
        return np.concatenate([self.mj_data.xpos, self.mj_data.xquat], axis=1)

    def segmentation(self) -> NDArray[np.int32]:
        """The body id under each pixel of the static camera: (H, W) int32."""
        return self._camera.segment(self.mj_data)

    def view(self, name: str = "side", size: int = 256) -> NDArray[np.uint8]:
        """A picture (size, size, 3) uint8 from the camera `static` or `side`, for people to look at.

        It is quickest at the size of the view's last picture, for which there is an OpenGL context.

        Raises:
            UsageError: no such camera, or OpenGL draws no picture so large.
        """
        if name not in self.DEPTH_RANGES:
            raise UsageError(f"there is no view {name!r}; choose one of {', '.join(self.DEPTH_RANGES)}")
        if name in self._views and self._views[name].geometry.height != size:
            self._views.pop(name).close()
        if name not in self._views:
            self._views[name] = self._make_camera(name, size)
        return self._views[name].render(self._shown_in(name))[0]

    def get_state(self) -> NDArray[np.float64]:
        """Everything that the future depends on, but the random generator, which only `reset` uses: 1-D float64.

        MuJoCo's integration state, in which commands are controls, activations or bodies; then what the environment
        itself remembers.
        """
        physics = np.empty(self.state_size - self.OWN_STATE)
        mujoco.mj_getState(self.mj_model, self.mj_data, physics, INTEGRATION_STATE)
        return np.concatenate([physics, self._own_state()])

    def set_state(self, state: ArrayLike) -> None:
        """Go back to a state that `get_state` gave; what follows is the same to the last bit.

        Raises:
            UsageError: not a state of this environment.
        """
        state, size = np.array(state, np.float64), self.state_size
        if state.shape != (size,) or not np.isfinite(state).all():
            raise UsageError(f"the state has shape {state.shape}; give {size} finite numbers from get_state()")
        physics, own = np.split(state, [size - self.OWN_STATE])
        self._set_own_state(own)
        mujoco.mj_setState(self.mj_model, self.mj_data, physics, INTEGRATION_STATE)
        self._after_physics()

    # --- What environments add, or do in their own way -------------------------------------------------------------

    @abstractmethod
    def _measurements(self) -> dict[str, NDArray]:
        """What is observed beside the pictures."""

    @abstractmethod
    def _own_state(self) -> ArrayLike:
        """What the environment itself remembers: (OWN_STATE,) numbers."""

    @abstractmethod
    def _set_own_state(self, own: NDArray[np.float64]) -> None:
        """Remember what `_own_state` gave.

        Raises:
            UsageError: it cannot have come from there.
        """

    def _after_physics(self) -> None:
        """Bring what is seen up to date with the state; leaves the state itself alone."""
        mujoco.mj_kinematics(self.mj_model, self.mj_data)
        mujoco.mj_camlight(self.mj_model, self.mj_data)
        self._picture = None

    def _take_picture(self) -> Picture:
        """Colour and depth from the static camera, at its size."""
        return self._camera.render(self.mj_data)

    def _shown_in(self, view: str) -> mujoco.MjData:
        """What this view shows."""
        return self.mj_data

    def _visible_groups(self, camera: str) -> tuple[int, ...]:
        """Groups of geoms that this camera sees."""
        return VISIBLE_GROUPS

    # --- Inside ----------------------------------------------------------------------------------------------------

    def _check_options(self, options: dict[str, Any] | None) -> dict[str, Any]:
        """The options of a reset.

        Raises:
            UsageError: there is one that is unknown.
        """
        options = options or {}
        unknown = sorted(set(options) - set(self.RESET_OPTIONS))
        if unknown:
            raise UsageError(f"unknown reset options {unknown}; there are {', '.join(self.RESET_OPTIONS)}")
        return options

    def _look(self) -> Picture:
        """The picture of the current state, drawn when it is first asked for."""
        if self._picture is None:
            self._picture = self._take_picture()
        return self._picture

    def _make_camera(self, name: str, size: int) -> StaticCamera:
        (near, far), groups = self.DEPTH_RANGES[name], self._visible_groups(name)
        return StaticCamera(
            self.mj_model, name, size, size, near, far, supersample=self._supersample, visible_groups=groups
        )

    def _picture_spaces(self) -> dict[str, gymnasium.Space]:
        if not self.images:
            return {}
        camera, box = self.camera, gymnasium.spaces.Box
        shape = (camera.height, camera.width)
        return {"rgb": box(0, 255, (*shape, 3), np.uint8), "depth": box(camera.near, camera.far, shape, np.float32)}
