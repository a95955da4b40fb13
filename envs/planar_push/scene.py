"""Everything together: table, light, cameras, tip and object, composed with dm_control's `mjcf`."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from envs import viewpoints
from envs.gl import mujoco_gl
from envs.planar_push.wardrobe import CONTACTS, VISIBLE, add_object

CONTROL_RATE, SUBSTEPS = 12, 20  # Hz, physics steps in a control step; a push of Omnipush has 12 frames and takes 1 s
TIMESTEP = 1 / (CONTROL_RATE * SUBSTEPS)  # s

STATIC_CAMERA = {"fovy": 33.0, "distance": 1.05, "elevation": 70.0, "azimuth": -90.0}  # degrees, m
SIDE_CAMERA = {"fovy": 30.0, "distance": 1.2, "elevation": 32.0, "azimuth": -55.0}
DEPTH_RANGES = {"static": (0.35, 1.2), "side": (0.35, 4.0)}  # m; Omnipush's, and one for people

TIP_RADIUS, TIP_HEIGHT = 0.008, 0.016  # m, of the ball at the end of the rod, and how high its centre is
ROD_TOP, HOLDER_TOP = 0.11, 0.16  # m
TIP_MASS, TIP_STIFFNESS, TIP_DAMPING = 1.0, 1e5, 2e3  # kg, N/m, N s/m: as stiff as an industrial arm

TABLE_COLOUR = [0.80, 0.76, 0.68, 1]  # plain: a texture would double the cost of a picture
TIP_COLOUR, HOLDER_COLOUR = [0.85, 0.30, 0.12, 1], [0.45, 0.12, 0.10, 1]


def build_model() -> mujoco.MjModel:
    """The compiled model; it shows an object once its `Wardrobe` is worn."""
    mjcf = _import_mjcf()
    root = mjcf.RootElement(model="planar_push")
    _set_options(root)
    _add_surroundings(root)
    _add_tip(root)
    add_object(mjcf, root)
    return mujoco.MjModel.from_xml_string(root.to_xml_string(), root.get_assets())


def _import_mjcf() -> Any:
    """dm_control's `mjcf`, without OpenGL: its import would bind PyOpenGL to a platform for the life of the process."""
    with mujoco_gl("disable"):
        from dm_control import mjcf
    return mjcf


def _set_options(root: Any) -> None:
    root.compiler.angle, root.compiler.fusestatic = "radian", True
    option, statistic, visual = root.option, root.statistic, root.visual
    option.timestep, option.integrator = TIMESTEP, "implicitfast"
    option.cone, option.impratio = "elliptic", 10  # an object that is not pushed does not creep
    statistic.extent, statistic.center, statistic.meaninertia = 1.0, [0, 0, 0], 0.1
    visual.map.znear, visual.map.zfar = 0.3, 5.0
    visual.headlight.active = 0  # every light costs by the pixel
    quality = visual.quality  # cost is per triangle
    quality.offsamples, quality.numquads, quality.numslices, quality.numstacks = 0, 1, 16, 8


def _add_surroundings(root: Any) -> None:
    contype, conaffinity = CONTACTS["table"]
    root.worldbody.add(
        "geom",
        name="table",
        type="plane",
        size=[3, 3, 0.1],
        rgba=TABLE_COLOUR,
        contype=contype,
        conaffinity=conaffinity,
        group=VISIBLE,
    )
    root.worldbody.add(
        "light", directional=True, pos=[0, 0, 2], dir=[0.45, 0.3, -1], ambient=[0.5] * 3, diffuse=[0.6] * 3,
        specular=[0] * 3,
    )  # fmt: skip
    for name, view in (("static", STATIC_CAMERA), ("side", SIDE_CAMERA)):
        eye, axes = viewpoints.orbit(np.zeros(3), view["distance"], view["elevation"], view["azimuth"])
        root.worldbody.add("camera", name=name, pos=eye, xyaxes=axes[:, :2].T.ravel(), fovy=view["fovy"])


def _add_tip(root: Any) -> None:
    """A rod that ends in a ball, so that it touches at a known height; springs and dampers hold it to its target."""
    tip = root.worldbody.add("body", name="tip", pos=[0, 0, TIP_HEIGHT])
    contype, conaffinity = CONTACTS["tip"]
    tip.add("inertial", pos=[0, 0, 0], mass=TIP_MASS, diaginertia=[1e-3] * 3)
    tip.add(
        "geom",
        name="tip",
        type="sphere",
        size=[TIP_RADIUS],
        rgba=TIP_COLOUR,
        contype=contype,
        conaffinity=conaffinity,
        priority=1,
        solref=[0.01, 1],
        group=VISIBLE,
    )
    for name, low, high, radius, colour in (
        ("rod", TIP_HEIGHT, ROD_TOP, TIP_RADIUS, TIP_COLOUR),
        ("holder", ROD_TOP, HOLDER_TOP, 2 * TIP_RADIUS, HOLDER_COLOUR),
    ):
        ends = [0, 0, low - TIP_HEIGHT, 0, 0, high - TIP_HEIGHT]
        tip.add(
            "geom", name=name, type="cylinder", fromto=ends, size=[radius], rgba=colour, contype=0, conaffinity=0,
            group=VISIBLE,
        )  # fmt: skip
    for axis, name in zip(np.eye(3), ("tip_x", "tip_y"), strict=False):
        tip.add("joint", name=name, type="slide", axis=axis)
    for name in ("tip_x", "tip_y"):
        spring = {"gainprm": [TIP_STIFFNESS], "biasprm": [0, -TIP_STIFFNESS, 0]}
        root.actuator.add(
            "general", name=f"spring_{name}", joint=name, dyntype="integrator", biastype="affine", **spring
        )
    for name in ("tip_x", "tip_y"):
        root.actuator.add("velocity", name=f"damper_{name}", joint=name, kv=TIP_DAMPING)
