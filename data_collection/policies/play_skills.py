"""The skills that play is made of: each a generator of waypoints that looks at the scene again before every move.

Stopping early is abandoning: a skill that finds nothing to do returns without a waypoint.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from data_collection.policies.play_motion import Array, Waypoint
from data_collection.policies.play_scene import BLOCKS, Block, Scene
from envs.tabletop.table import HALF_DEPTH
from envs.tabletop.table import TOP as TABLE_TOP

Skill = Iterator[Waypoint]

OPEN, CLOSED = 1.0, -1.0
TABLE_LOW = np.array([-0.36, -0.17])  # m, where blocks should stay on the table
TABLE_HIGH = np.array([0.36, 0.0])
TABLE_EDGE = -HALF_DEPTH  # m, y of the front edge
FINGER_HEIGHT = 0.014  # m, TCP over the table when the fingertips just clear it
CLEARANCE = 0.07  # m over a block from which the hand moves sideways
CABINET_FRONT = -0.07  # m; beyond this y the hand only fits with its fingers spread along x


def reach(scene: Scene, rng: np.random.Generator) -> Skill:
    """Free movement through the whole workspace, in all directions, at all speeds."""
    gripper = rng.choice([OPEN, CLOSED])
    yaw, tilt = rng.uniform(-0.6, 0.6), tuple(rng.uniform(-0.2, 0.2, 2))
    goal = _far_along_view(scene, rng) if rng.random() < 0.25 else _random_point(scene, rng)
    move = partial(Waypoint, yaw=yaw, tilt=tilt, gripper=gripper, tolerance=0.03, noise=rng.uniform(0.1, 0.3))
    speed = rng.uniform(0.25, 1.2)
    for corner in _over_the_edge(scene, goal):
        yield move(corner, speed=speed)
    yield move(goal, speed=speed)


def push(scene: Scene, rng: np.random.Generator, name: str) -> Skill:
    """Push a block over the table with the fingers."""
    block = scene.block(name)
    if not _within_reach(block):
        return
    for _ in range(8):
        end = rng.uniform(TABLE_LOW, TABLE_HIGH)
        way = end - block.position[:2]
        length = np.linalg.norm(way)
        direction = way / max(length, 1e-6)
        start = block.position[:2] - direction * (np.linalg.norm(block.half_size[:2]) + 0.03)
        if length > 0.05 and (start < TABLE_HIGH + [0.06, 0.01]).all() and (start > TABLE_LOW - [0.06, 0.08]).all():
            break
    else:
        return
    yaw, speed = rng.uniform(-0.4, 0.4), rng.uniform(0.3, 0.8)
    height = max(block.position[2], TABLE_TOP + FINGER_HEIGHT)
    move = partial(Waypoint, yaw=yaw, gripper=rng.choice([CLOSED, CLOSED, OPEN]), tolerance=0.012, noise=0.05)
    above = np.array([*start, block.position[2] + block.half_size[2] + CLEARANCE])
    yield move(above, speed=0.8, tolerance=0.03, required=True)
    yield move(np.array([*start, height]), speed=0.6, required=True)
    finish = block.position[:2] + direction * min(length, 0.25)
    yield move(np.array([*finish, height]), speed=speed, noise=0.1)
    yield move(np.array([*finish, above[2]]), speed=0.7, tolerance=0.04)


def carry(scene: Scene, rng: np.random.Generator, name: str) -> Skill:
    """Grasp a block, lift it, carry it elsewhere, put it down or let it fall."""
    block = scene.block(name)
    yaw = _grasp_yaw(block)
    if yaw is None:
        yield from push(scene, rng, name)
        return
    hold = partial(Waypoint, yaw=yaw, noise=0.02)
    yield hold(block.position + [0, 0, CLEARANCE], speed=0.8, tolerance=0.015, required=True)
    block = scene.block(name)
    yield hold(block.position, speed=0.5, tolerance=0.008, required=True)
    yield hold(block.position, gripper=CLOSED, dwell=8)
    carried = partial(Waypoint, gripper=CLOSED, noise=0.1, speed=rng.uniform(0.4, 0.9))
    place = rng.uniform(TABLE_LOW, TABLE_HIGH - [0.0, 0.04])
    height = block.position[2] + rng.uniform(0.06, 0.25)
    lifted = block.position + [0, 0, height - block.position[2]]
    yield carried(lifted, yaw=yaw, tolerance=0.05)
    if scene.block(name).position[2] < block.position[2] + 0.01:
        return  # it slipped out
    turn = rng.uniform(-0.4, 0.4)
    yield carried(np.array([*place, height]), yaw=turn, tolerance=0.04)
    if rng.random() < 0.7:
        yield carried(np.array([*place, block.position[2] + 0.005]), yaw=turn, tolerance=0.015, noise=0.03)
    yield Waypoint(scene.tcp, turn, gripper=OPEN, dwell=4, noise=0.02)
    yield Waypoint(scene.tcp + [0, 0, 0.08], turn, gripper=OPEN, speed=0.6, tolerance=0.04)


def slide_drawer(scene: Scene, rng: np.random.Generator) -> Skill:
    """Hook the handle of the drawer from above with closed fingers; pull it open or push it shut."""
    behind = np.array([0.0, 0.034, 0.0])  # between the bar of the handle and the drawer's front
    handle = scene.handle("drawer") + behind
    hook = partial(Waypoint, gripper=CLOSED, noise=0.03)
    for corner in _over_the_edge(scene, handle):
        yield hook(corner, speed=0.9, tolerance=0.04)
    yield hook(handle + [0, 0, 0.12], speed=0.9, tolerance=0.025, required=True)
    yield hook(scene.handle("drawer") + behind, speed=0.6, tolerance=0.012, required=True)
    yield hook(_slide_goal(scene, rng, "drawer") + behind, speed=rng.uniform(0.3, 0.8), noise=0.06, tolerance=0.015)
    yield hook(scene.tcp + [0, 0, 0.14], speed=0.8, tolerance=0.05, patience=25)


def slide_door(scene: Scene, rng: np.random.Generator) -> Skill:
    """Take the handle of the door between the fingers and slide it."""
    yield from _slide_by_grasp(scene, rng, "door", out=np.array([0.0, -0.05, 0.05]))


def move_switch(scene: Scene, rng: np.random.Generator) -> Skill:
    """Take the lever of the switch between the fingers and move it along its slot."""
    yield from _slide_by_grasp(scene, rng, "switch", out=np.array([0.0, -0.06, 0.06]))


def press_button(scene: Scene, rng: np.random.Generator) -> Skill:
    """Press the button from above with closed fingers."""
    top = scene.handle("button")
    press = partial(Waypoint, yaw=rng.uniform(-0.5, 0.5), gripper=CLOSED, noise=0.04)
    yield press(top + [*rng.uniform(-0.008, 0.008, 2), 0.06], speed=0.9, tolerance=0.02, required=True)
    yield press(top + [0, 0, -0.012], speed=rng.uniform(0.3, 0.7), tolerance=0.006, dwell=int(rng.integers(0, 6)))
    yield press(top + [0, 0, 0.1], speed=0.7, tolerance=0.05)


def _slide_by_grasp(scene: Scene, rng: np.random.Generator, fixture: str, out: Array) -> Skill:
    hold = partial(Waypoint, noise=0.03)
    yield hold(scene.handle(fixture) + out, speed=0.9, tolerance=0.025, required=True)
    yield hold(scene.handle(fixture), speed=0.6, tolerance=0.015, required=True)
    yield hold(scene.handle(fixture), gripper=CLOSED, dwell=6)
    goal = _slide_goal(scene, rng, fixture)
    yield hold(goal, gripper=CLOSED, speed=rng.uniform(0.3, 0.8), tolerance=0.015)
    yield hold(scene.tcp, gripper=OPEN, dwell=4)
    yield hold(scene.tcp + out, speed=0.7, tolerance=0.04)


def _slide_goal(scene: Scene, rng: np.random.Generator, fixture: str) -> Array:
    """Where the handle goes: mostly across the middle of its range."""
    now = scene.opening(fixture)
    wanted = rng.uniform(0.6, 1.05) if now < 0.5 else rng.uniform(-0.05, 0.4)
    return scene.handle(fixture) + (wanted - now) * scene.travel(fixture)


def _random_point(scene: Scene, rng: np.random.Generator) -> Array:
    """A free point of the workspace, more often near its faces: between points spread evenly the hand is in the middle."""
    while True:
        point = scene.low + (scene.high - scene.low) * rng.beta(0.75, 0.75, 3)
        if scene.free(point):
            return point


def _far_along_view(scene: Scene, rng: np.random.Generator) -> Array:
    """A free point straight towards the camera or away from it: motion that a picture hardly shows."""
    step = 0.01 * scene.optical_axis
    backward, forward = (_free_steps(scene, sign * step) for sign in (-1.0, 1.0))
    steps = forward * rng.uniform(0.4, 1.0) if forward > backward else -backward * rng.uniform(0.4, 1.0)
    return scene.tcp + steps * step


def _free_steps(scene: Scene, step: Array) -> int:
    point, count = scene.tcp + step, 0
    while scene.free(point) and (point > scene.low).all() and (point < scene.high).all():
        point, count = point + step, count + 1
    return count


def _over_the_edge(scene: Scene, goal: Array) -> list[Array]:
    """Corners on the way to a goal when the table's front edge is in between."""
    start = scene.tcp
    low, high = (start, goal) if start[1] < goal[1] else (goal, start)
    if low[1] < TABLE_EDGE < high[1] and low[2] < TABLE_TOP + 0.03:
        return [np.array([low[0], TABLE_EDGE - 0.06, TABLE_TOP + 0.08])]
    return []


def _within_reach(block: Block) -> bool:
    x, y, z = block.position
    return bool(abs(x) < 0.40 and -0.22 < y < 0.03 and TABLE_TOP < z < TABLE_TOP + 0.2)


def _grasp_yaw(block: Block) -> float | None:
    """Yaw at which the fingers close over the block; None where the hand does not fit."""
    if not _within_reach(block):
        return None
    for axis in np.argsort(block.half_size):
        direction = block.rotation[:, axis]
        if block.half_size[axis] < 0.032 and abs(direction[2]) < 0.2:
            yaw = float(np.arctan2(direction[1], direction[0]))
            yaw = (yaw + np.pi / 2) % np.pi - np.pi / 2  # the hand is symmetric
            if block.position[1] < CABINET_FRONT or abs(yaw) < 0.45:
                return yaw
    return None


FIXTURE_SKILLS: dict[str, Callable[[Scene, np.random.Generator], Skill]] = {
    "drawer": slide_drawer,
    "door": slide_door,
    "button": press_button,
    "switch": move_switch,
}


def manipulation(scene: Scene, rng: np.random.Generator, thing: str) -> Skill:
    """A skill for one fixture or block."""
    if thing in BLOCKS:
        return (carry if rng.random() < 0.5 else push)(scene, rng, thing)
    return FIXTURE_SKILLS[thing](scene, rng)
