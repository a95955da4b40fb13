"""The static RGB-D camera: one pass of MuJoCo's renderer gives anti-aliased colour and exact metric depth."""

from __future__ import annotations

import os
import weakref
from collections.abc import Sequence
from types import TracebackType
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.camera import CameraModel
from envs.errors import UsageError
from envs.gl import OffscreenContext, create_context

VISIBLE_GROUPS = (1, 2)
"""Geom groups that are drawn. Group 0 holds collision shapes (robosuite's habit), 3 and up hold aids and targets."""


class StaticCamera:
    """A camera that stands still in a MuJoCo model and sees colour, depth and body ids.

    The OpenGL context is made at the first picture, in the process and thread that ask for it, and lives until `close`.
    A copy of a camera, also a pickled one, makes its own. Sites, tendons, lights and other decoration are never drawn,
    nor are shadows, reflections, fog and haze.

    Args:
        model: the compiled model.
        name: an MJCF `<camera>` that is fixed in the world.
        width: pixels in a row.
        height: rows.
        near: least depth that is told apart, metres; nearer is clipped to it.
        far: greatest depth that is told apart, metres; farther, and where nothing is, is clipped to it.
        supersample: the scene is drawn this many times wider and higher. Colour is averaged over each block, depth and
            ids are its centre sample: hence an odd number.
        visible_groups: geom groups that are drawn.

    Raises:
        UsageError: no such camera, or it moves, or the numbers do not fit together.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        name: str,
        width: int,
        height: int,
        near: float,
        far: float,
        supersample: int = 3,
        visible_groups: Sequence[int] = VISIBLE_GROUPS,
    ) -> None:
        if not isinstance(supersample, (int, np.integer)) or supersample < 1 or supersample % 2 == 0:
            raise UsageError(f"supersample is {supersample!r}; give an odd number, so that a block has a centre sample")
        if not visible_groups or not set(visible_groups) <= set(range(mujoco.mjNGROUP)):
            raise UsageError(f"visible_groups is {visible_groups!r}; give numbers from 0 to {mujoco.mjNGROUP - 1}")
        self._model = model
        self._id = _fixed_camera_id(model, name)
        self.geometry = _camera_model(model, self._id, width, height, near, far)
        _check_clipping(model, self.geometry)
        self.supersample = supersample

        self._groups = tuple(visible_groups)
        self._canvas: _Canvas | None = None

    def render(self, data: mujoco.MjData) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Colour and depth, from one and the same pass.

        Args:
            data: the state to show; its kinematics must be up to date (after `mj_step`, `mj_forward`, ...).

        Returns:
            rgb: (height, width, 3) uint8, anti-aliased.
            depth: (height, width) float32, planar, metres, at the pixel centres, clipped to [near, far].

        Raises:
            UsageError: no OpenGL works, or it draws no picture so large.
        """
        canvas = self._ensure_canvas()
        frustum = canvas.draw(data).camera[0]
        depth = metric_depth(self._centre_samples(canvas.zbuffer), frustum.frustum_near, frustum.frustum_far)
        depth = np.clip(depth, self.geometry.near, self.geometry.far)
        rgb = block_average(canvas.rgb, self.supersample)
        return rgb[::-1].copy(), depth[::-1].astype(np.float32)

    def segment(self, data: mujoco.MjData) -> NDArray[np.int32]:
        """The body under each pixel centre, at the very samples that `render` takes depth from.

        Args:
            data: the state to show; its kinematics must be up to date.

        Returns:
            (height, width) int32 body ids; 0 is the world, and where nothing is.

        Raises:
            UsageError: no OpenGL works, or it draws no picture so large.
        """
        canvas = self._ensure_canvas()
        scene = canvas.draw(data, ids=True)
        samples = self._centre_samples(canvas.rgb).astype(np.int32)[::-1]
        segment_id = samples[..., 0] | samples[..., 1] << 8 | samples[..., 2] << 16  # 0: nothing drawn
        body_of = np.zeros(scene.ngeom + 1, np.int32)
        for geom in scene.geoms[: scene.ngeom]:
            if geom.segid >= 0 and geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                body_of[geom.segid + 1] = self._model.geom_bodyid[geom.objid]
        return body_of[segment_id]

    def gl_renderer(self) -> str:
        """What draws, e.g. `egl: llvmpipe (LLVM 15.0.6, 256 bits)`.

        Raises:
            UsageError: no OpenGL works.
        """
        gl = self._ensure_canvas().gl
        return f"{gl.backend}: {gl.gl_renderer()}"

    def close(self) -> None:
        """Give the OpenGL context back. The camera may still be used: the next picture makes a new one."""
        if self._canvas is not None:
            self._canvas.free()
        self._canvas = None

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_canvas": None}

    def __enter__(self) -> StaticCamera:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _ensure_canvas(self) -> _Canvas:
        if self._canvas is None:
            large = self.geometry.width * self.supersample, self.geometry.height * self.supersample
            self._canvas = _Canvas(self._model, self._id, *large, self._groups)
        return self._canvas

    def _centre_samples(self, image: NDArray[Any]) -> NDArray[Any]:
        middle = self.supersample // 2
        return image[middle :: self.supersample, middle :: self.supersample]


class _Canvas:
    """An OpenGL context, and what MuJoCo draws in it of a model as a camera sees it.

    Raises:
        UsageError: no OpenGL works, or it draws no picture so large.
    """

    def __init__(self, model: mujoco.MjModel, camera: int, width: int, height: int, groups: tuple[int, ...]) -> None:
        self.gl = create_context()
        self.gl.make_current()
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        try:
            self._mjr = _offscreen_renderer(model, self._viewport)
        except UsageError:
            self.gl.free()
            raise
        self.free = weakref.finalize(self, _free, self.gl, self._mjr, os.getpid())
        self._model = model
        self.rgb = np.empty((height, width, 3), np.uint8)
        self.zbuffer = np.empty((height, width), np.float32)
        self._option = mujoco.MjvOption()
        for kind in ("geomgroup", "sitegroup", "jointgroup", "tendongroup", "actuatorgroup", "flexgroup", "skingroup"):
            getattr(self._option, kind)[:] = 0
        for group in groups:
            self._option.geomgroup[group] = self._option.flexgroup[group] = self._option.skingroup[group] = 1
        self._view = mujoco.MjvCamera()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._view.fixedcamid = camera
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + model.nskin + 64)
        unwanted = mujoco.mjtRndFlag
        for flag in (unwanted.mjRND_SHADOW, unwanted.mjRND_REFLECTION, unwanted.mjRND_FOG, unwanted.mjRND_HAZE):
            self._scene.flags[flag] = False

    def draw(self, data: mujoco.MjData, ids: bool = False) -> mujoco.MjvScene:
        """Draw colour and depth into `rgb` and `zbuffer`, bottom row first, or ids as colours into `rgb` alone."""
        self.gl.make_current()
        physical = mujoco.mjtCatBit.mjCAT_STATIC | mujoco.mjtCatBit.mjCAT_DYNAMIC
        mujoco.mjv_updateScene(self._model, data, self._option, None, self._view, physical, self._scene)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = ids
        self._scene.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = ids
        mujoco.mjr_render(self._viewport, self._scene, self._mjr)
        mujoco.mjr_readPixels(self.rgb, None if ids else self.zbuffer, self._viewport, self._mjr)
        return self._scene


def block_average(image: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
    """The mean of each block of `side` x `side` pixels, rounded half up: (H, W, C) to (H / side, W / side, C)."""
    if side == 1:
        return image
    height, width, channels = image.shape
    rows = image.reshape(height // side, side, width * channels).sum(1, dtype=np.uint32)
    blocks = rows.reshape(height // side, width // side, side, channels)
    total = blocks[:, :, 0].copy()
    for column in range(1, side):  # much faster than a sum over an axis this short
        total += blocks[:, :, column]
    return ((total + side * side // 2) // (side * side)).astype(np.uint8)


def metric_depth(zbuffer: NDArray[np.float32], near: float, far: float) -> NDArray[np.float64]:
    """Planar depth from MuJoCo's reversed z-buffer (1 at the near plane, 0 at the far plane).

    Args:
        zbuffer: any shape, as `mjr_readPixels` gives it with `mjDEPTH_ZEROFAR`.
        near: the near plane of the frustum, metres.
        far: the far plane of the frustum, metres.

    Returns:
        Depth of the same shape, float64, metres.
    """
    span = far - near
    return (far * near / span) / (zbuffer.astype(np.float64) + 0.5 * (far + near) / span - 0.5)


def _fixed_camera_id(model: mujoco.MjModel, name: str) -> int:
    camera_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, name)
    if camera_id < 0:
        known = [model.camera(i).name for i in range(model.ncam)]
        raise UsageError(f"the model has no camera {name!r}; it has {known}")
    body = model.cam_bodyid[camera_id]
    fixed = model.cam_mode[camera_id] == mujoco.mjtCamLight.mjCAMLIGHT_FIXED
    if not fixed or model.body_weldid[body] != 0 or model.body_mocapid[body] >= 0:
        raise UsageError(f"camera {name!r} moves; give it mode='fixed' and a body that is fixed in the world")
    if model.cam_sensorsize[camera_id].any():
        raise UsageError(f"camera {name!r} has a sensorsize; state its fovy instead")
    return camera_id


def _camera_model(
    model: mujoco.MjModel, camera_id: int, width: int, height: int, near: float, far: float
) -> CameraModel:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    pose = np.eye(4)
    pose[:3, :3] = data.cam_xmat[camera_id].reshape(3, 3) * [1, -1, -1]  # OpenGL looks along -z, with +y up
    pose[:3, 3] = data.cam_xpos[camera_id]
    return CameraModel.from_fovy(width, height, float(model.cam_fovy[camera_id]), pose, near, far)


def _check_clipping(model: mujoco.MjModel, camera: CameraModel) -> None:
    near, far = (plane * model.stat.extent for plane in (model.vis.map.znear, model.vis.map.zfar))
    rounding = 1 + 1e-5  # the model keeps single precision
    if near > camera.near * rounding or far * rounding < camera.far:
        raise UsageError(
            f"the model is clipped to {near:.3g} .. {far:.3g} m, which does not hold the camera's working range"
            f" {camera.near:g} .. {camera.far:g} m; set <visual><map znear zfar/> (they are times <statistic extent/>)"
        )


def _offscreen_renderer(model: mujoco.MjModel, viewport: mujoco.MjrRect) -> Any:
    """MuJoCo's renderer, with a framebuffer of this size, on the current OpenGL context; the model stays as it was.

    Raises:
        UsageError: OpenGL makes no framebuffer so large.
    """
    settings = (
        (model.vis.global_, "offwidth", viewport.width),
        (model.vis.global_, "offheight", viewport.height),
        (model.vis.quality, "offsamples", 0),  # multisampling costs 3x and blends depth across edges
        (model.vis.quality, "shadowsize", 0),
    )
    before = [getattr(owner, name) for owner, name, _ in settings]
    try:
        for owner, name, value in settings:
            setattr(owner, name, value)
        renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50)
    except mujoco.FatalError as error:
        raise UsageError(
            f"OpenGL does not draw {viewport.width} x {viewport.height} samples ({error}); give a smaller image size "
            "or supersample"
        ) from error
    finally:
        for (owner, name, _), value in zip(settings, before, strict=True):
            setattr(owner, name, value)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, renderer)
    renderer.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
    return renderer


def _free(gl: OffscreenContext, renderer: Any, process: int) -> None:
    if os.getpid() == process:  # a forked child must not touch its parent's context
        with gl.in_passing():  # Python's garbage collector may come here in the midst of another camera's picture
            renderer.free()
            gl.free()
