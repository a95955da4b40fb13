"""robosuite's Panda and PandaGripper as one MuJoCo spec: its joints, inertias and collision meshes, lighter to draw.

The arm is driven in Cartesian space. A heavy body without shape, `target`, floats at the pose the hand should have;
six force-limited actuators pull the site `tcp` to it, as a real Panda does in Cartesian impedance mode. Because they
act on *relative* velocity the hand follows a moving target without lag, and because they are limited a blocked hand
pushes with a bounded force.
"""

from __future__ import annotations

import importlib.util
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import mujoco
import numpy as np

from envs.errors import UsageError
from envs.meshes import light_mesh

BASE_POSITION = (-0.34, -0.46, 0.24)  # CALVIN's
ARM_JOINTS = tuple(f"joint{i}" for i in range(1, 8))
FINGER_JOINTS = ("finger_joint1", "finger_joint2")
FINGER_TRAVEL = 0.04  # m, each finger
REST_ARM = (-1.218, 1.040, 2.120, -2.342, -0.870, 1.641, 0.553)  # rad, CALVIN's

FORCE_LIMIT = 500.0  # N along each axis of the target
TORQUE_LIMIT = 80.0  # N m about each axis of the target
STIFFNESS, DAMPING = 70_000.0, 1_000.0  # N/m, N s/m; more damping jerks blocks out of the fingers
ROTATION_STIFFNESS, ROTATION_DAMPING = 3_000.0, 60.0  # N m/rad, N m s/rad
POSTURE_STIFFNESS, JOINT_DAMPING, JOINT_ARMATURE = 4.0, 4.0, 0.03  # N m/rad, N m s/rad, kg m^2
INERTIA_SCALE = 0.1  # robosuite's moments of inertia are some ten times those of the real links
TARGET_MASS = 1e6  # kg; the hand's pull moves it by nanometres

COLLIDING_LINKS = ("link5", "link6", "link7", "right_gripper", "leftfinger", "rightfinger")
SHADES = {"white": (0.93, 0.93, 0.92, 1), "dark": (0.22, 0.22, 0.23, 1), "accent": (0.04, 0.54, 0.78, 1)}


def panda() -> mujoco.MjSpec:
    """The arm with its gripper, base at the origin, still without actuators on the arm."""
    arm = mujoco.MjSpec.from_file(str(_assets() / "robots/panda/robot.xml"))
    gripper = mujoco.MjSpec.from_file(str(_assets() / "grippers/panda_gripper.xml"))
    for spec, folder in ((arm, "robots/panda"), (gripper, "grippers")):
        _lighten(spec, _assets() / folder)
        _drop(spec, spec.cameras, spec.sensors, spec.sites)
    _drop(arm, arm.actuators, arm.materials)
    mount = arm.body("right_hand")
    arm.attach(gripper, prefix="", frame=mount.add_frame())
    for body in arm.bodies:
        body.gravcomp = 1
        body.inertia = np.array(body.inertia) * INERTIA_SCALE
    for name, rest in zip(ARM_JOINTS, REST_ARM, strict=True):
        joint = arm.joint(name)
        joint.damping, joint.armature = [JOINT_DAMPING, 0, 0], JOINT_ARMATURE
        joint.stiffness, joint.springref = [POSTURE_STIFFNESS, 0, 0], rest
    # A body of its own: MuJoCo's site actuators multiply a site's own rotation in the wrong order.
    tcp = arm.body("eef").add_body(name="tcp", quat=[np.sqrt(0.5), 0, 0, np.sqrt(0.5)])  # y: the fingers open
    tcp.add_site(name="tcp", group=5)
    return arm


def add_target(spec: mujoco.MjSpec) -> None:
    """Add the floating target pose and the six actuators that pull the hand to it."""
    target = spec.worldbody.add_body(name="target", gravcomp=1, mass=TARGET_MASS, inertia=[TARGET_MASS] * 3)
    target.explicitinertial = True
    target.add_freejoint(name="target")
    target.add_site(name="target", group=5)
    for axis in range(6):
        linear = axis < 3
        stiffness, damping = (STIFFNESS, DAMPING) if linear else (ROTATION_STIFFNESS, ROTATION_DAMPING)
        limit = FORCE_LIMIT if linear else TORQUE_LIMIT
        actuator = spec.add_actuator(
            name=f"pull_{'xyz'[axis % 3]}" if linear else f"turn_{'xyz'[axis % 3]}",
            trntype=mujoco.mjtTrn.mjTRN_SITE,
            target="tcp",
            refsite="target",
            gear=np.eye(6)[axis],
            forcerange=[-limit, limit],
            forcelimited=True,
        )
        actuator.set_to_position(kp=stiffness, kv=damping)


def _assets() -> Path:
    found = importlib.util.find_spec("robosuite")  # located, not imported: importing it takes seconds
    if found is None or not found.submodule_search_locations:
        raise UsageError("robosuite is not installed; pip install robosuite==1.5.2")
    return Path(next(iter(found.submodule_search_locations))) / "models" / "assets"


def _lighten(spec: mujoco.MjSpec, folder: Path) -> None:
    """Replace what is drawn by one light mesh for each body and shade; keep collision geoms of COLLIDING_LINKS."""
    for body in spec.bodies:
        files: dict[str, list[Path]] = defaultdict(list)
        pose: dict[str, np.ndarray] = {}
        for geom in list(body.geoms):
            if geom.group == 1:
                shade = _shade(spec, geom)
                key = f"{shade}/{geom.name}" if geom.name else shade  # named parts have poses of their own
                files[key].append(folder / spec.mesh(geom.meshname).file)
                pose[key] = np.array(geom.quat)
                spec.delete(geom)
            elif body.name not in COLLIDING_LINKS and not body.name.endswith("_tip"):
                spec.delete(geom)
        for key, paths in files.items():
            shade = key.split("/")[0]
            name = f"{body.name}_{shade}"
            light = light_mesh(sorted(paths))
            mesh = spec.add_mesh(name=name, uservert=light.vertices.ravel(), userface=light.faces.ravel())
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # thin parts have no volume to speak of
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=name,
                quat=pose[key],
                rgba=SHADES[shade],
                group=1,
                contype=0,
                conaffinity=0,
                mass=0,
            )
    used = {geom.meshname for body in spec.bodies for geom in body.geoms}
    _drop(spec, [mesh for mesh in spec.meshes if mesh.name not in used])


def _shade(spec: mujoco.MjSpec, geom: mujoco.MjsGeom) -> str:
    rgba = spec.material(geom.material).rgba if geom.material else geom.rgba
    red, green, blue = (float(channel) for channel in rgba[:3])
    if max(red, green, blue) - min(red, green, blue) > 0.2:
        return "accent"
    return "white" if red > 0.7 else "dark"


def _drop(spec: mujoco.MjSpec, *groups: Iterable) -> None:
    for group in groups:
        for element in list(group):
            spec.delete(element)
