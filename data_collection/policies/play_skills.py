"""The skills that play is made of: each a generator of waypoints that looks at the scene again before every move.

A skill that finds nothing to do returns without a waypoint; one that is abandoned is simply not asked again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from data_collection.policies.play_motion import Array, Waypoint
from data_collection.policies.play_scene import Block, Scene
from envs.tabletop.table import BLOCKS, HALF_DEPTH
from envs.tabletop.table import TOP as TABLE_TOP

Skill = Iterator[Waypoint]

OPEN, CLOSED = 1.0, -1.0
TABLE_LOW, TABLE_HIGH = np.array([-0.33, -0.165]), np.array([0.33, -0.01])  # m, where blocks should stay
START_LOW, START_HIGH = np.array([-0.35, -0.255]), np.array([0.35, 0.0])  # m, where the fingers come down
TABLE_EDGE = -HALF_DEPTH  # m, y of the front edge
FINGER_HEIGHT = 0.014  # m, TCP over the table when the fingertips just clear it
CLEARANCE = 0.07  # m over a block from which the hand moves sideways
CABINET_FRONT = -0.07  # m; beyond this y the hand only fits with its fingers spread along x
BUTTON_RADIUS = 0.075  # m, what a pushed block keeps away from
WIDEST_GRASP = 0.032  # m, half of what fits between the fingers
FINGERS = (-0.05, 0.05)  # m, where they are when open
CARRY_SHARE = 0.6  # how often a block is carried, not pushed


def reach(scene: Scene, rng: np.random.Generator) -> Skill:
    """Free movement through the whole workspace, in all directions, at all speeds."""
    yaw = float(rng.uniform(-0.6, 0.6)) if rng.random() < 0.5 else None
    tilt, gripper = rng.uniform(-0.2, 0.2, 2), rng.choice([OPEN, CLOSED])
    kind = rng.choice(["point", "along_view", "darts"], p=[0.4, 0.2, 0.4])
    speed, wander = rng.uniform(0.3, 1.5), rng.uniform(0.1, 0.3)
    move = partial(Waypoint, yaw=yaw, tilt=tilt, gripper=gripper, tolerance=0.03)
    if kind == "darts":
        for _ in range(rng.integers(3, 7)):
            yield move(_nearby_point(scene, rng), speed=rng.uniform(0.6, 2.0), noise=wander)
        return
    goal = _far_along_view(scene, rng) if kind == "along_view" else _random_point(scene, rng)
    yield move(goal, speed=speed, noise=wander * speed)


def push(scene: Scene, rng: np.random.Generator, name: str) -> Skill:
    """Push a block over the table with the fingers."""
    block = scene.block(name)
    gripper = rng.choice([CLOSED, CLOSED, OPEN])
    way = _push_way(scene, rng, name, room=0.03 if gripper == CLOSED else 0.07) if _within_reach(block) else None
    if way is None:
        return
    start, finish = way
    height = max(block.position[2], TABLE_TOP + FINGER_HEIGHT)
    over = block.position[2] + block.half_size[2] + CLEARANCE
    move = partial(Waypoint, yaw=rng.uniform(-0.4, 0.4), gripper=gripper, tolerance=0.012, noise=0.05)
    yield move(np.append(start, over), speed=0.9, tolerance=0.03, required=True)
    yield move(np.append(start, height), speed=0.7, required=True)
    yield move(np.append(finish, height), speed=rng.uniform(0.3, 0.9), noise=0.1)
    yield move(np.append(finish, over), speed=0.8, tolerance=0.04)


def carry(scene: Scene, rng: np.random.Generator, name: str) -> Skill:
    """Grasp a block, lift it, carry it elsewhere, put it down or let it fall."""
    block = scene.block(name)
    yaw = _grasp_yaw(scene, name) if _within_reach(block) else None
    if yaw is None:
        yield from push(scene, rng, name)
        return
    hold = partial(Waypoint, yaw=yaw, noise=0.02)
    yield hold(block.position + _at(0, 0, CLEARANCE), speed=0.9, tolerance=0.015, turn_tolerance=0.12, required=True)
    grip = scene.block(name).position
    yield hold(grip, speed=0.6, tolerance=0.01, required=True)
    yield hold(grip, gripper=CLOSED, dwell=7)
    height = grip[2] + rng.uniform(0.06, 0.35)
    carried = partial(Waypoint, gripper=CLOSED, noise=0.08, speed=rng.uniform(0.4, 1.0))
    yield carried(np.append(grip[:2], height), yaw=yaw, tolerance=0.05)
    if scene.block(name).position[2] < grip[2] + 0.01:
        return  # it slipped out
    place, turn = rng.uniform(TABLE_LOW, TABLE_HIGH - [0.0, 0.04]), rng.uniform(-0.4, 0.4)
    yield carried(np.append(place, height), yaw=turn, tolerance=0.04)
    if rng.random() < 0.7:
        yield carried(np.append(place, grip[2] + 0.005), yaw=turn, tolerance=0.015, noise=0.03)
    yield Waypoint(scene.tcp, gripper=OPEN, dwell=4, noise=0.02)
    yield Waypoint(scene.tcp + _at(0, 0, 0.08), gripper=OPEN, speed=0.7, tolerance=0.04)


def slide_drawer(scene: Scene, rng: np.random.Generator) -> Skill:
    """Hook the handle of the drawer from above with closed fingers; pull it open or push it shut."""
    behind = _at(0, 0.034, 0)  # between the bar of the handle and the drawer's front
    handle = scene.handle("drawer") + behind
    hook = partial(Waypoint, yaw=0.0, gripper=CLOSED, noise=0.03)
    yield hook(handle + _at(0, 0, 0.12), speed=0.9, tolerance=0.025, required=True)
    yield hook(scene.handle("drawer") + behind, speed=0.6, tolerance=0.012, required=True)
    yield hook(_slide_goal(scene, rng, "drawer") + behind, speed=rng.uniform(0.3, 0.9), noise=0.06, tolerance=0.015)
    yield hook(scene.tcp + _at(0, 0, 0.14), speed=0.8, tolerance=0.05, patience=25)


def slide_door(scene: Scene, rng: np.random.Generator) -> Skill:
    """Take the handle of the door between the fingers and slide it."""
    yield from _slide_by_grasp(scene, rng, "door", out=_at(0, -0.06, 0.05), tilt=0.55)


def move_switch(scene: Scene, rng: np.random.Generator) -> Skill:
    """Take the lever of the switch between the fingers and move it along its slot."""
    yield from _slide_by_grasp(scene, rng, "switch", out=_at(0, -0.06, 0.06), tilt=0.2)


def press_button(scene: Scene, rng: np.random.Generator) -> Skill:
    """Press the button from above with closed fingers."""
    top = scene.handle("button") + np.append(rng.uniform(-0.008, 0.008, 2), 0.0)
    press = partial(Waypoint, yaw=rng.uniform(-0.5, 0.5), gripper=CLOSED, noise=0.04)
    yield press(top + _at(0, 0, 0.06), speed=0.9, tolerance=0.02, required=True)
    yield press(top - _at(0, 0, 0.012), speed=rng.uniform(0.3, 0.7), tolerance=0.006, dwell=int(rng.integers(0, 6)))
    yield press(top + _at(0, 0, 0.1), speed=0.7, tolerance=0.05)


FIXTURE_SKILLS: dict[str, Callable[[Scene, np.random.Generator], Skill]] = {
    "drawer": slide_drawer,
    "door": slide_door,
    "button": press_button,
    "switch": move_switch,
}


def manipulation(scene: Scene, rng: np.random.Generator, thing: str) -> Skill:
    """A skill for one fixture or block."""
    if thing in BLOCKS:
        return (carry if rng.random() < CARRY_SHARE else push)(scene, rng, thing)
    return FIXTURE_SKILLS[thing](scene, rng)


def around_the_edge(scene: Scene, skill: Skill) -> Skill:
    """The same skill, with a detour wherever the front edge of the table, or an open drawer, would be in the way."""
    for waypoint in skill:
        start, goal = scene.tcp, waypoint.position
        low, high = (start, goal) if start[1] < goal[1] else (goal, start)
        if low[1] < TABLE_EDGE < high[1] and low[2] < TABLE_TOP + 0.03:
            corner = _at(low[0], TABLE_EDGE - 0.06, TABLE_TOP + 0.08)
            yield Waypoint(corner, gripper=waypoint.gripper, speed=waypoint.speed, tolerance=0.04)
        yield waypoint


def _slide_by_grasp(scene: Scene, rng: np.random.Generator, fixture: str, out: Array, tilt: float) -> Skill:
    """`out` (3,) is the way the hand comes from; tilted fingers point into the cabinet and keep the palm off it."""
    hold = partial(Waypoint, yaw=0.0, tilt=(tilt, 0.0), noise=0.03)
    yield hold(scene.handle(fixture) + out, speed=0.9, tolerance=0.025, turn_tolerance=0.15, required=True)
    yield hold(scene.handle(fixture), speed=0.7, tolerance=0.015, required=True)
    yield hold(scene.handle(fixture), gripper=CLOSED, dwell=6)
    yield hold(_slide_goal(scene, rng, fixture), gripper=CLOSED, speed=rng.uniform(0.3, 0.9), tolerance=0.015)
    yield hold(scene.tcp, gripper=OPEN, dwell=4)
    yield hold(scene.tcp + out, speed=0.7, tolerance=0.04)


def _slide_goal(scene: Scene, rng: np.random.Generator, fixture: str) -> Array:
    """Where the handle goes: mostly across the middle of its range."""
    now = scene.opening(fixture)
    wanted = rng.uniform(0.6, 1.05) if now < 0.5 else rng.uniform(-0.05, 0.4)
    return scene.handle(fixture) + (wanted - now) * scene.travel(fixture)


def _random_point(scene: Scene, rng: np.random.Generator) -> Array:
    """A free point of the workspace, more often near its faces: between points spread evenly one is in the middle."""
    while True:
        point = scene.low + (scene.high - scene.low) * rng.beta([0.75, 0.75, 0.9], [0.75, 0.75, 0.6])
        if scene.free(point):
            return point


def _nearby_point(scene: Scene, rng: np.random.Generator) -> Array:
    """A free point 6 to 35 cm away in any direction."""
    for _ in range(20):
        direction = rng.normal(size=3)
        point = scene.tcp + direction / np.linalg.norm(direction) * rng.uniform(0.06, 0.35)
        if scene.free(point):
            return point
    return _random_point(scene, rng)


def _far_along_view(scene: Scene, rng: np.random.Generator) -> Array:
    """A free point straight towards the camera or away from it: motion that a picture hardly shows."""
    step = 0.01 * scene.optical_axis
    backward, forward = (_free_steps(scene, sign * step) for sign in (-1.0, 1.0))
    steps = forward if forward > backward else -backward
    return scene.tcp + steps * rng.uniform(0.4, 1.0) * step


def _free_steps(scene: Scene, step: Array) -> int:
    point, count = scene.tcp + step, 0
    while scene.free(point):
        point, count = point + step, count + 1
    return count


def _push_way(scene: Scene, rng: np.random.Generator, name: str, room: float) -> tuple[Array, Array] | None:
    """Where on the table, (2,) each, the fingers come down behind a block and where they stop; None if nowhere.

    `room` is what they need beside the block, metres.
    """
    block = scene.block(name)
    button = scene.handle("button")[:2]
    for _ in range(12):
        way = rng.uniform(TABLE_LOW, TABLE_HIGH) - block.position[:2]
        length = float(np.linalg.norm(way))
        if length < 0.06:
            continue
        way *= min(length, 0.25) / length
        start = block.position[:2] - way / np.linalg.norm(way) * (np.linalg.norm(block.half_size[:2]) + room)
        finish = block.position[:2] + way
        inside = (start > START_LOW).all() and (start < START_HIGH).all()
        if inside and _clear(scene, start, name) and _distance_to_segment(button, start, finish) > BUTTON_RADIUS:
            return start, finish
    return None


def _distance_to_segment(point: Array, start: Array, end: Array) -> float:
    along = np.clip((point - start) @ (end - start) / ((end - start) @ (end - start)), 0.0, 1.0)
    return float(np.linalg.norm(start + along * (end - start) - point))


def _within_reach(block: Block) -> bool:
    x, y, z = block.position
    return bool(abs(x) < 0.40 and -0.22 < y < 0.03 and TABLE_TOP < z < TABLE_TOP + 0.2)


def _grasp_yaw(scene: Scene, name: str) -> float | None:
    """Yaw at which the fingers close over the block; None where the hand does not fit."""
    block = scene.block(name)
    for axis in np.argsort(block.half_size):
        direction = block.rotation[:, axis]
        if block.half_size[axis] > WIDEST_GRASP or abs(direction[2]) > 0.2:
            continue
        yaw = float(np.arctan2(direction[1], direction[0]))
        yaw = (yaw + np.pi / 2) % np.pi - np.pi / 2  # the hand is symmetric
        fits = block.position[1] < CABINET_FRONT or abs(yaw) < 0.45
        if fits and all(_clear(scene, block.position[:2] + side * direction[:2], name) for side in FINGERS):
            return yaw
    return None


def _clear(scene: Scene, place: Array, name: str) -> bool:
    """Whether a place (2,) on the table is clear of the blocks other than `name`."""
    return all(np.linalg.norm(scene.block(other).position[:2] - place) > 0.055 for other in BLOCKS if other != name)


def _at(x: float, y: float, z: float) -> Array:
    return np.array([x, y, z], dtype=np.float64)
