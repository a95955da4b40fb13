"""The object and its changes of sides.

One compiled model serves all objects: at each of its four faces the centre piece carries all four shapes, and a
`Wardrobe` shows those of one object and lets them be touched. So an episode with another object needs no new model and
no new OpenGL context.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.planar_push import pieces
from envs.planar_push.hidden import Hidden
from envs.planar_push.objects import SHAPES, SIDES

GAP, HEIGHT = 0.002, 0.042  # m, lower and upper end of the object's sides
FOOT_RADIUS = 0.003  # m; an object stands on one foot in the middle of each side
MARKERS = ((0.021, 0.021), (-0.021, 0.021), (-0.021, -0.021), (0.0, 0.021))  # m; uneven, so that one sees a turn
SIDE_COLOUR, CENTRE_COLOUR, MARKER_COLOUR = [0.16, 0.36, 0.62, 1], [0.20, 0.22, 0.25, 1], [0.92, 0.92, 0.88, 1]

VISIBLE, INVISIBLE = 2, 4  # geom groups
STATISTICS = ("extent", "center", "meaninertia", "meanmass", "meansize")
CONTACTS = {"side": (1, 2), "tip": (2, 1), "foot": (4, 8), "table": (8, 4), "nothing": (0, 0)}
"""What touches what: contype and conaffinity."""


class Wardrobe:
    """Turns the object of a model into any of the 70, with any hidden variables."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model, self._scratch = model, mujoco.MjData(model)
        self._body = body = model.body("object").id
        self._boxes = slice(model.body_bvhadr[body], model.body_bvhadr[body] + model.body_bvhnum[body])
        self._box_centres = model.bvh_aabb[self._boxes, :3] + model.body_ipos[body]
        names = [model.geom(i).name for i in range(model.ngeom)]
        self._parts, self._feet = (
            {
                (side, digit): [i for i, name in enumerate(names) if name.startswith(f"side_{side}_{shape}/{kind}")]
                for side in range(SIDES)
                for digit, shape in SHAPES.items()
            }
            for kind in ("part", "foot")
        )

    def wear(self, name: str, hidden: Hidden) -> None:
        """Change the model; what `MjData` derives from it is stale until the next `mj_forward` or `mj_step`."""
        model = self._model
        for side in range(SIDES):
            for digit in SHAPES:
                worn, parts, feet = name[side] == digit, self._parts[side, digit], self._feet[side, digit]
                _set_contacts(model, parts, "side" if worn else "nothing")
                _set_contacts(model, feet, "foot" if worn else "nothing")
                model.geom_group[parts] = VISIBLE if worn else INVISIBLE
                model.geom_friction[feet, 0] = hidden.table_friction
        model.geom_friction[model.geom("tip").id, 0] = hidden.tip_friction
        mass, centre, spread = pieces.mass_properties(name, hidden.mass, hidden.weights)
        body, thickness = self._body, mass * (HEIGHT - GAP) ** 2 / 12
        model.body_mass[body] = mass
        model.body_inertia[body] = [
            spread[1] + thickness,
            spread[0] + thickness,
            spread.sum(),
        ]  # off-diagonals left out
        self._set_centre_of_mass(np.array([*centre, (GAP + HEIGHT) / 2]))
        stat = {name: np.copy(getattr(model.stat, name)) for name in STATISTICS}
        mujoco.mj_setConst(model, self._scratch)
        for name, value in stat.items():  # the clipping planes and the tolerance of the solver hang on them
            setattr(model.stat, name, value)

    def _set_centre_of_mass(self, place: NDArray[np.float64]) -> None:
        """Move the centre of mass; the boxes that collisions are looked for in, told from it, stay where they are."""
        self._model.body_ipos[self._body] = place
        self._model.bvh_aabb[self._boxes, :3] = self._box_centres - place


def _set_contacts(model: mujoco.MjModel, geoms: list[int], kind: str) -> None:
    model.geom_contype[geoms], model.geom_conaffinity[geoms] = CONTACTS[kind]


def add_object(mjcf: Any, root: Any) -> None:
    """Add the centre piece, with a mount at each face that every shape is attached to, to the root of a model."""
    body = root.worldbody.add("body", name="object")
    body.add("freejoint", name="object")
    body.add("inertial", pos=[0, 0, 0.02], mass=1, diaginertia=[1e-3] * 3)
    look = {"mass": 0, "group": VISIBLE}
    centre = {"mesh": _add_prism(root, "centre", pieces.centre_outline()), "rgba": CENTRE_COLOUR}
    contype, conaffinity = CONTACTS["side"]
    body.add("geom", name="centre", type="mesh", contype=contype, conaffinity=conaffinity, **centre, **look)
    for i, place in enumerate(MARKERS):
        body.add(
            "geom", name=f"marker_{i}", type="sphere", pos=[*place, HEIGHT], size=[0.006], rgba=MARKER_COLOUR,
            contype=0, conaffinity=0, **look,
        )  # fmt: skip
    for side in range(SIDES):
        angle = 2 * np.pi * side / SIDES
        pos = pieces.HALF_WIDTH * np.array([np.cos(angle), np.sin(angle), 0])
        mount = body.add("site", name=f"mount_{side}", pos=pos, quat=[np.cos(angle / 2), 0, 0, np.sin(angle / 2)])
        for shape in SHAPES.values():
            mount.attach(_side(mjcf, f"side_{side}_{shape}", shape))


def _side(mjcf: Any, name: str, shape: str) -> Any:
    """A side of this shape with its foot, as a model of its own."""
    root = mjcf.RootElement(model=name)
    contype, conaffinity = CONTACTS["side"]
    for i, outline in enumerate(pieces.side_outlines(shape)):
        root.worldbody.add(
            "geom",
            name=f"part_{i}",
            type="mesh",
            mesh=_add_prism(root, f"part_{i}", outline),
            rgba=SIDE_COLOUR,
            contype=contype,
            conaffinity=conaffinity,
            mass=0,
        )
    contype, conaffinity = CONTACTS["foot"]
    root.worldbody.add(
        "geom",
        name="foot",
        type="sphere",
        group=INVISIBLE,
        size=[FOOT_RADIUS],
        pos=[pieces.side_area_and_centroid(shape)[1], 0, FOOT_RADIUS],
        contype=contype,
        conaffinity=conaffinity,
        priority=1,
        solref=[0.01, 1],
        mass=0,
    )
    return root


def _add_prism(root: Any, name: str, outline: pieces.Outline) -> Any:
    """A mesh that stands on this outline (N, 2); MuJoCo takes its convex hull."""
    corners = [np.column_stack([outline, np.full(len(outline), z)]) for z in (GAP, HEIGHT)]
    return root.asset.add("mesh", name=name, vertex=np.concatenate(corners).ravel())
