"""Everything together: floor, light, cameras, table and robot, compiled into one MuJoCo model."""

from __future__ import annotations

from typing import Any

import mujoco

from envs import viewpoints
from envs.tabletop import robot, table
from envs.tabletop.layouts import layout
from envs.tabletop.textures import add_textured_material, add_wood

CONTROL_RATE, SUBSTEPS = 30, 8  # Hz, physics steps in a control step; CALVIN's
TIMESTEP = 1 / (CONTROL_RATE * SUBSTEPS)  # s

STATIC_CAMERA: dict[str, Any] = {
    "fovy": 10.0,
    "eye": (2.871, -2.167, 2.555),
    "target": (-0.026, -0.030, 0.392),
    "up": (0.404, 0.226, 0.886),  # CALVIN's; not upright, its pictures lean
}
SIDE_CAMERA: dict[str, Any] = {
    "fovy": 24.0,
    "eye": (-1.05, -2.35, 1.75),
    "target": (-0.04, -0.12, 0.42),
    "up": (0.0, 0.0, 1.0),
}
STATIC_DEPTH_RANGE = (3.4, 6.3)  # m; CALVIN's 3.7 would cut off a forearm that is stretched towards the camera
SIDE_DEPTH_RANGE = (1.6, 6.0)  # m


def build_model(scene: str) -> mujoco.MjModel:
    """The compiled model of scene "A", "B", "C" or "D"."""
    spec = mujoco.MjSpec()
    spec.modelname = f"tabletop_{scene.lower()}"
    place = layout(scene)
    _set_options(spec)
    _add_surroundings(spec)
    add_wood(spec, "body", place.body)
    add_wood(spec, "door", place.door)
    table.add_table(spec, place)
    mount = spec.worldbody.add_frame(pos=robot.BASE_POSITION)
    spec.attach(robot.panda(), prefix="", frame=mount)
    for body in spec.bodies:
        for geom in body.geoms:
            if (geom.group == 0 and body.name in robot.COLLIDING_LINKS) or body.name.endswith("_tip"):
                table.set_contacts(geom, table.ROBOT)
                geom.group, geom.condim = 3, 4  # torsional friction: a held block does not swing
    robot.add_target(spec)
    return spec.compile()


def _set_options(spec: mujoco.MjSpec) -> None:
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10  # a grasped block does not creep out of the fingers
    spec.stat.meaninertia = 1.0  # scales the solver's tolerance; the heavy target must not loosen it
    spec.stat.extent, spec.stat.center = 1.0, [0, 0, 0.4]
    spec.visual.map.znear, spec.visual.map.zfar = 1.5, 8.0
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.42] * 3, [0.25] * 3
    spec.visual.headlight.specular = [0.0] * 3
    quality = spec.visual.quality  # cost is per triangle: boxes need one quad a face
    quality.offsamples, quality.numquads, quality.numslices, quality.numstacks = 0, 1, 16, 8


def _add_surroundings(spec: mujoco.MjSpec) -> None:
    sky = {"type": mujoco.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mujoco.mjtBuiltin.mjBUILTIN_GRADIENT}
    spec.add_texture(name="sky", rgb1=[0.80, 0.83, 0.86], rgb2=[0.62, 0.64, 0.66], width=16, height=96, **sky)
    spec.add_texture(
        name="floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.62, 0.64, 0.66],
        rgb2=[0.57, 0.59, 0.61],
        width=64,
        height=64,
    )
    add_textured_material(spec, "floor", "floor", repeat=6)
    floor = spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2.4, 2.4, 0.1], material="floor"
    )
    floor.contype, floor.conaffinity, floor.group = table.STATIC, table.HITS[table.STATIC], table.VISIBLE
    foot_height = robot.BASE_POSITION[2] / 2
    foot = spec.worldbody.add_geom(name="pedestal", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.1, foot_height, 0])
    foot.pos, foot.rgba = [*robot.BASE_POSITION[:2], foot_height], [0.3, 0.3, 0.32, 1]
    foot.contype, foot.conaffinity, foot.group = 0, 0, table.VISIBLE
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[0.5, -1, 3],
        dir=[-0.25, 0.55, -1],
        diffuse=[0.5] * 3,
        specular=[0.15] * 3,
        castshadow=False,
    )
    for name, view in (("static", STATIC_CAMERA), ("side", SIDE_CAMERA)):
        axes = viewpoints.look_at(view["eye"], view["target"], view["up"])
        spec.worldbody.add_camera(name=name, pos=view["eye"], fovy=view["fovy"], quat=viewpoints.quaternion(axes))
