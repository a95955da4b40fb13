"""Everything together: gymnasium-robotics' Shadow Hand and cube, our cameras and light, as one MuJoCo model."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import mujoco

from envs import viewpoints
from envs.errors import UsageError
from envs.meshes import light_mesh

CONTROL_RATE, SUBSTEPS = 25, 8  # Hz, physics steps in a control step
TIMESTEP = 1 / (CONTROL_RATE * SUBSTEPS)  # s; 2 ms in the original, which costs twice as much and grips no better
TOLERANCE = 1e-6  # of the solver

PALM = (1.0, 0.895, 0.15)  # m, the middle of what the camera looks at
STATIC_CAMERA = {"fovy": 12.0, "distance": 1.05, "elevation": 52.0, "azimuth": -60.0}  # degrees, m
SIDE_CAMERA = {"fovy": 18.0, "distance": 1.05, "elevation": 30.0, "azimuth": -35.0}
DEPTH_RANGES = {"static": (0.83, 1.33), "side": (0.5, 3.0)}  # m; that of the DexHand data, and one for people

VISIBLE, FOR_PEOPLE, INVISIBLE = 2, 5, 4  # geom groups; the hand's meshes are in group 1
MAX_FACES, MANY_FACES = 250, 500  # of a part of the hand; of a large one
COLLIDING_MESH, STAND_INS = "robot0:forearm_cvx", {"robot0:forearm": "forearm_electric_cvx.stl"}
"""The only mesh that collides; and the files of meshes in place of those that no decimation makes light."""

CUBE_SIDE = 0.05  # m
FLOOR_COLOUR = (0.55, 0.57, 0.60)


def build_model() -> mujoco.MjModel:
    """The compiled model: hand, cube, and the goal as a mocap body that only people see."""
    folder = asset_folder()
    spec = mujoco.MjSpec.from_file(str(folder / "hand" / "manipulate_block.xml"))
    spec.modelname = "dexhand"
    _drop_what_is_not_used(spec)
    _lighten_meshes(spec, folder / "stls" / "hand")
    _set_options(spec)
    _add_goal(spec)
    _set_looks(spec)
    return spec.compile()


def asset_folder() -> Path:
    """Where gymnasium-robotics keeps its models; does not import it.

    Raises:
        UsageError: it is not installed.
    """
    found = importlib.util.find_spec("gymnasium_robotics")
    if found is None or found.origin is None:
        raise UsageError("gymnasium-robotics is not installed, whose hand and cube this is; pip install it")
    return Path(found.origin).parent / "envs" / "assets"


def _drop_what_is_not_used(spec: mujoco.MjSpec) -> None:
    spec.delete(spec.body("target"))  # a free body that is simulated to be looked at; `goal` replaces it
    spec.delete(spec.geom("object_hidden"))
    for group in (spec.sensors, spec.sites, spec.lights):
        for element in list(group):
            spec.delete(element)


def _lighten_meshes(spec: mujoco.MjSpec, folder: Path) -> None:
    """Fewer triangles for what is drawn; what collides stays as it is."""
    for mesh in spec.meshes:
        if mesh.name == COLLIDING_MESH:
            continue
        faces = MANY_FACES if mesh.name in ("robot0:forearm", "robot0:palm") else MAX_FACES
        light = light_mesh([folder / STAND_INS.get(mesh.name, Path(mesh.file).name)], faces)
        mesh.file = ""
        mesh.uservert, mesh.userface = light.vertices.ravel(), light.faces.ravel()
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL


def _set_options(spec: mujoco.MjSpec) -> None:
    spec.option.timestep, spec.option.tolerance = TIMESTEP, TOLERANCE
    for joint in spec.joints:
        joint.frictionloss = 0  # a milli-newton-metre that makes up half of all constraints
    spec.stat.extent, spec.stat.center = 1.0, list(PALM)
    spec.visual.map.znear, spec.visual.map.zfar = 0.4, 4.0
    quality = spec.visual.quality  # cost is per triangle
    quality.offsamples, quality.numquads, quality.numslices, quality.numstacks = 0, 1, 16, 8


def _add_goal(spec: mujoco.MjSpec) -> None:
    goal = spec.worldbody.add_body(name="goal", pos=PALM, mocap=True)
    goal.add_geom(
        name="goal",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[CUBE_SIDE / 2] * 3,
        material="material:object",
        contype=0,
        conaffinity=0,
        group=FOR_PEOPLE,
    )


def _set_looks(spec: mujoco.MjSpec) -> None:
    spec.geom("object").group = VISIBLE
    spec.geom("floor0").group = INVISIBLE  # as in the original: the background is empty, and clipped
    for texture in spec.textures:
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            texture.builtin = mujoco.mjtBuiltin.mjBUILTIN_FLAT
            texture.rgb1 = texture.rgb2 = FLOOR_COLOUR
            texture.width, texture.height = 8, 48
    for light in spec.lights:
        spec.delete(light)
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.3] * 3, [0.15] * 3
    spec.visual.headlight.specular = [0.0] * 3
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[1, 0.5, 2],
        dir=[0.35, 0.35, -1],
        diffuse=[0.5] * 3,
        specular=[0.1] * 3,
        castshadow=False,
    )
    for name, view in (("static", STATIC_CAMERA), ("side", SIDE_CAMERA)):
        eye, axes = viewpoints.orbit(PALM, view["distance"], view["elevation"], view["azimuth"])
        spec.worldbody.add_camera(name=name, pos=eye, quat=viewpoints.quaternion(axes), fovy=view["fovy"])
