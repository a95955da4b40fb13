"""The play table: a body with a drawer, a cabinet with a sliding door, a button, a switch, two lamps, three blocks.

Every fixture is one MuJoCo joint of the same name whose 0 is closed or at rest. The front of the cabinet leans back
by 30 degrees; the door, its handle and the switch live in that plane.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from envs.tabletop.layouts import Layout

TOP = 0.44  # m, height of the table's surface
HALF_WIDTH, HALF_DEPTH = 0.42, 0.20  # m
BOARD = 0.012  # m, thickness of boards
BLOCKS = ("block_red", "block_blue", "block_pink")
BLOCK_COLOURS = ((0.85, 0.08, 0.08, 1), (0.10, 0.22, 0.85, 1), (0.95, 0.45, 0.75, 1))
BLOCK_SIDE, BLOCK_MASS = 0.04, 0.25  # m, kg

DRAWER_TRAVEL, BUTTON_TRAVEL, SWITCH_TRAVEL = 0.22, 0.02, 0.088  # m
FIXTURE_FRICTION = 4.0  # N, as in CALVIN
FIXTURE_ARMATURE = 1.0  # kg; MuJoCo's contacts and limits are as stiff as what they hold is heavy
SLOPE_FOOT = np.array([0.0, 0.03, TOP])  # the cabinet's front plane meets the table here
SLOPE_UP = np.array([0.0, 0.5, np.sqrt(0.75)])  # along the plane, upwards
SLOPE_OUT = np.array([0.0, -np.sqrt(0.75), 0.5])  # its normal, towards the robot
SLOPE_QUAT = [np.cos(np.pi / 6), np.sin(np.pi / 6), 0.0, 0.0]  # local x, y, z = x, SLOPE_UP, SLOPE_OUT
UPRIGHT_QUAT = [np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]  # local x, y, z = x, z, -y
SLOPE_HEIGHT = 0.21  # m along SLOPE_UP
CABINET_TOP = 0.625  # m

VISIBLE = 1  # geom group
STATIC, BLOCK, FIXTURE, ROBOT = 1, 2, 4, 8  # contact classes
HITS = {STATIC: BLOCK | ROBOT, FIXTURE: BLOCK | ROBOT, BLOCK: BLOCK | ROBOT, ROBOT: 0}

STIFF_SOLREF, STIFF_SOLIMP = [0.009, 1], [0.95, 0.99, 0.001, 0.5, 2]  # twice the time step is the least

METAL = (0.75, 0.76, 0.78, 1)
SHADOW = (0.12, 0.12, 0.13, 1)
LED_COLOURS = {False: (0.10, 0.25, 0.12, 1), True: (0.15, 0.95, 0.25, 1)}
BULB_COLOURS = {False: (0.45, 0.43, 0.36, 1), True: (1.0, 0.88, 0.15, 1)}


def add_table(spec: mujoco.MjSpec, layout: Layout) -> None:
    """Add table, fixtures, lamps and blocks to the world of `spec`; needs materials `body` and `door`."""
    table = spec.worldbody.add_body(name="table")
    _add_body(table, layout)
    _add_cabinet(table, layout)
    _add_drawer(table, layout)
    _add_door(table, layout)
    _add_button(table, layout)
    _add_switch(table, layout)
    _add_lamps(table, layout)
    for name, length, rgba in zip(BLOCKS, layout.block_lengths, BLOCK_COLOURS, strict=True):
        block = spec.worldbody.add_body(name=name, pos=[0, 0, 1])
        block.add_freejoint(name=name)
        sides = [length, BLOCK_SIDE, BLOCK_SIDE]
        geom = _box(block, BLOCK, [0, 0, 0], sides, rgba=rgba, name=name)
        geom.mass = BLOCK_MASS


def _add_body(table: mujoco.MjsBody, layout: Layout) -> None:
    """A block of wood with a well for the drawer."""
    left, right = layout.drawer_x - 0.142, layout.drawer_x + 0.142
    low, high, front, back = 0.0, TOP - 0.03, -HALF_DEPTH, HALF_DEPTH
    _span(table, (-HALF_WIDTH, HALF_WIDTH), (front, back), (high, TOP), name="table_top")
    _span(table, (-HALF_WIDTH, left), (front, back), (low, high))
    _span(table, (right, HALF_WIDTH), (front, back), (low, high))
    _span(table, (left, right), (front, back), (low, 0.255))
    _span(table, (left, right), (back - BOARD, back), (0.255, high))


def _add_cabinet(table: mujoco.MjsBody, layout: Layout) -> None:
    """Back, top, ends, and the sloping panels beside the door's opening."""
    left, right = opening(layout)
    _span(table, (-HALF_WIDTH, HALF_WIDTH), (HALF_DEPTH - BOARD, HALF_DEPTH), (TOP, CABINET_TOP))
    _span(table, (-HALF_WIDTH, HALF_WIDTH), (0.13, HALF_DEPTH), (CABINET_TOP, CABINET_TOP + BOARD))
    for start, end in ((-HALF_WIDTH, left), (right, HALF_WIDTH)):
        _slope_box(table, (start, end), (0, SLOPE_HEIGHT), (-BOARD, 0), material="body")
        edge = end - BOARD if start < 0 and end == left else start
        _span(table, (edge, edge + BOARD), (0.09, HALF_DEPTH), (TOP, CABINET_TOP))
    for end in (-HALF_WIDTH, HALF_WIDTH - BOARD):
        _span(table, (end, end + BOARD), (0.11, HALF_DEPTH), (TOP, CABINET_TOP))
    _span(table, (left, right), (0.075, HALF_DEPTH - BOARD), (TOP, TOP + 0.004), material="door", name="plank")


def _add_drawer(table: mujoco.MjsBody, layout: Layout) -> None:
    drawer = table.add_body(name="drawer", pos=[layout.drawer_x, -HALF_DEPTH, 0.32], gravcomp=1)
    _joint(drawer, "drawer", [0, -1, 0], DRAWER_TRAVEL, damping=8)
    wall, depth, height = 0.01, 0.28, 0.10
    front = _box(drawer, FIXTURE, [0, -0.006, 0.01], [0.28, 0.13, 0.016], quat=UPRIGHT_QUAT, material="door", mass=0.4)
    front.name = "drawer_front"
    _box(drawer, FIXTURE, [0, depth / 2, -0.055], [0.26, depth, wall], material="body", mass=0.2)
    _box(drawer, FIXTURE, [0, depth - wall / 2, -0.01], [0.26, wall, height - 0.02], material="body", mass=0.1)
    for side in (-0.125, 0.125):
        _box(drawer, FIXTURE, [side, depth / 2, -0.01], [wall, depth, height - 0.02], material="body", mass=0.1)
    for side in (-0.06, 0.06):
        _box(drawer, FIXTURE, [side, -0.044, 0.015], [0.012, 0.066, 0.012], rgba=METAL, mass=0.02)
    _box(drawer, FIXTURE, [0, -0.077, 0.015], [0.132, 0.012, 0.03], rgba=METAL, mass=0.05)
    drawer.add_site(name="drawer_handle", pos=[0, -0.077, 0.015], group=5)


def _add_door(table: mujoco.MjsBody, layout: Layout) -> None:
    """A panel one compartment wide; the handle stands out of its left edge."""
    foot = SLOPE_FOOT + np.array([layout.door_x, 0, 0])
    door = table.add_body(name="door", pos=foot, quat=SLOPE_QUAT, gravcomp=1)  # y along the slope, z out of it
    _joint(door, "door", [-1, 0, 0], layout.door_travel, damping=8)
    width, middle = layout.door_travel, SLOPE_HEIGHT / 2
    panel = _box(door, FIXTURE, [width / 2 - 0.02, middle, -0.004], [width, SLOPE_HEIGHT - 0.012, 0.008], mass=0.4)
    panel.material, panel.name = "door", "door_panel"
    _box(door, FIXTURE, [0, middle, 0.024], [0.018, 0.09, 0.048], rgba=METAL, mass=0.1)
    door.add_site(name="door_handle", pos=[0, middle, 0.03], group=5)


def _add_button(table: mujoco.MjsBody, layout: Layout) -> None:
    place = [layout.button_x, -0.12, TOP]
    _box(table, STATIC, np.add(place, [0, 0, 0.005]), [0.075, 0.075, 0.01], rgba=SHADOW, name="button_base")
    button = table.add_body(name="button", pos=np.add(place, [0, 0, 0.02]), gravcomp=1)
    joint = _joint(button, "button", [0, 0, -1], BUTTON_TRAVEL, damping=4, friction=0.1)
    joint.stiffness, joint.springref = [150, 0, 0], -0.01
    cap = button.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.026, 0.012, 0], pos=[0, 0, 0.003], rgba=(0.55, 0.1, 0.1, 1)
    )
    _contacts(cap, FIXTURE)
    cap.mass, cap.name = 0.1, "button_cap"
    button.add_site(name="button_top", pos=[0, 0, 0.015], group=5)


def _add_switch(table: mujoco.MjsBody, layout: Layout) -> None:
    start = 0.063  # m along the slope, CALVIN's resting place
    slot = (start - 0.02, start + SWITCH_TRAVEL + 0.02)
    x = layout.switch_x
    _slope_box(table, (x - 0.022, x + 0.022), slot, (0, 0.002), rgba=SHADOW)
    foot = SLOPE_FOOT + np.array([x, 0, 0]) + start * SLOPE_UP
    switch = table.add_body(name="switch", pos=foot, quat=SLOPE_QUAT, gravcomp=1)
    _joint(switch, "switch", [0, 1, 0], SWITCH_TRAVEL, damping=8)
    _box(switch, FIXTURE, [0, 0, 0.03], [0.03, 0.02, 0.056], rgba=METAL, mass=0.1, name="switch_lever")
    switch.add_site(name="switch_tip", pos=[0, 0, 0.056], group=5)


def _add_lamps(table: mujoco.MjsBody, layout: Layout) -> None:
    height = CABINET_TOP + BOARD
    for name, x, rgba in (("led", layout.button_x, LED_COLOURS), ("bulb", layout.switch_x, BULB_COLOURS)):
        foot = table.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.026, 0.004, 0], rgba=SHADOW)
        foot.pos = [x, 0.16, height + 0.004]
        lamp = table.add_geom(type=mujoco.mjtGeom.mjGEOM_ELLIPSOID, size=[0.024, 0.024, 0.026], rgba=rgba[False])
        lamp.pos, lamp.name = [x, 0.16, height + 0.022], name
        for geom in (foot, lamp):
            _contacts(geom, STATIC)


def opening(layout: Layout) -> tuple[float, float]:
    """Left and right end of the opening behind the door: two compartments, each as wide as the door."""
    right = layout.door_x + layout.door_travel - 0.02
    return right - 2 * layout.door_travel, right


def _joint(
    body: mujoco.MjsBody, name: str, axis: Sequence[float], travel: float, damping: float, friction=FIXTURE_FRICTION
) -> mujoco.MjsJoint:
    joint = body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, range=[0, travel])
    joint.limited, joint.solref_limit, joint.solimp_limit = True, STIFF_SOLREF, STIFF_SOLIMP
    joint.frictionloss, joint.damping, joint.armature = friction, [damping, 0, 0], FIXTURE_ARMATURE
    return joint


def _span(table: mujoco.MjsBody, x: Sequence[float], y: Sequence[float], z: Sequence[float], **look) -> None:
    """An upright static box between two coordinates on each axis; the wood shows on its top or front, the larger."""
    low, high = np.array([x, y, z], np.float64).T
    middle, sides = (low + high) / 2, high - low
    if (sides <= 0).any():
        return
    look = {"material": "body"} | look
    if sides[2] > sides[1]:
        _box(table, STATIC, middle, sides[[0, 2, 1]], quat=UPRIGHT_QUAT, **look)
    else:
        _box(table, STATIC, middle, sides, **look)


def _slope_box(table: mujoco.MjsBody, x: Sequence[float], up: Sequence[float], out: Sequence[float], **look) -> None:
    """A box in the cabinet's front plane: spans of x, along the slope, and out of it."""
    low, high = np.array([x, up, out], np.float64).T
    if (high > low).all():
        middle = (low + high) / 2
        place = SLOPE_FOOT + np.array([middle[0], 0, 0]) + middle[1] * SLOPE_UP + middle[2] * SLOPE_OUT
        _box(table, STATIC, place, high - low, quat=SLOPE_QUAT, **look)


def _box(body: mujoco.MjsBody, contact: int, place, sides, **look) -> mujoco.MjsGeom:
    geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=place, size=np.asarray(sides) / 2, **look)
    _contacts(geom, contact)
    return geom


def _contacts(geom: mujoco.MjsGeom, contact: int) -> None:
    geom.group = VISIBLE
    set_contacts(geom, contact)
    geom.friction = [0.7, 0.005, 0.0001]


def set_contacts(geom: mujoco.MjsGeom, contact: int) -> None:
    """Let `geom` collide as one of the classes STATIC, BLOCK, FIXTURE, ROBOT."""
    geom.contype, geom.conaffinity = contact, HITS[contact]
    geom.solref, geom.solimp = STIFF_SOLREF, STIFF_SOLIMP
