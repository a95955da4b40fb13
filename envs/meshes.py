"""Visual meshes light enough for a software renderer: read, merged, decimated once, kept in the user's cache.

A 64x64 picture of the stock Panda costs 170,000 triangles; with 500 a part it looks the same and renders ten times
faster. Only what is drawn is touched, never a mesh that collides.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import fast_simplification
import numpy as np
from numpy.typing import NDArray

from envs.errors import UsageError
from envs.files import written_aside

CACHE_FORMAT = b"t3vip-mesh-1"  # part of every key: raise it when the result of `decimate` changes
WELD_DECIMALS = 5  # vertices closer than 0.01 mm are one; exporters split them at every edge


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (V, 3) float32, metres.
        faces: (F, 3) int32, indices into `vertices`, counter-clockwise from outside.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]


def light_mesh(paths: Sequence[Path], max_faces: int = 500) -> Mesh:
    """The meshes of some files as one of at most `max_faces` triangles; computed once, then read from the cache.

    The cache only saves time: where it cannot be read or written, the mesh is computed again.

    Args:
        paths: Wavefront `.obj` or binary `.stl` files in one common frame.
        max_faces: upper bound on the triangles.
    """
    key = hashlib.sha256(CACHE_FORMAT + str(max_faces).encode())
    for path in paths:
        key.update(hashlib.sha256(path.read_bytes()).digest())
    cached = cache_dir() / "meshes" / f"{key.hexdigest()[:32]}.npz"
    with contextlib.suppress(OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile):  # not there, or damaged
        if cached.exists():
            with np.load(cached, allow_pickle=False) as arrays:
                return Mesh(arrays["vertices"], arrays["faces"])
    mesh = decimate(merge([read_mesh(path) for path in paths]), max_faces)
    with contextlib.suppress(OSError):
        _store(cached, mesh)
    return mesh


def cache_dir() -> Path:
    """Where derived files live: `$T3VIP_CACHE`, else `$XDG_CACHE_HOME/t3vip`, else `~/.cache/t3vip`."""
    own = os.environ.get("T3VIP_CACHE")
    return Path(own) if own else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "t3vip"


def read_mesh(path: Path) -> Mesh:
    """Read a Wavefront `.obj` or a binary `.stl`."""
    readers = {".obj": _read_obj, ".stl": _read_stl}
    if path.suffix not in readers:
        raise UsageError(f"cannot read the mesh {path.name}; give a .obj or a binary .stl file")
    return _weld(*readers[path.suffix](path))


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """All meshes as one."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces).astype(np.int32))


def decimate(mesh: Mesh, max_faces: int) -> Mesh:
    """Collapse edges of least quadric error until at most `max_faces` triangles are left.

    Raises:
        UsageError: the mesh has so many loose parts that this is not to be had.
    """
    vertices, faces, budget = mesh.vertices, mesh.faces, max_faces
    while len(faces) > max_faces:  # the simplifier treats the count as a wish
        vertices, faces = fast_simplification.simplify(vertices, faces, target_count=budget, agg=7.0)
        budget = int(budget * 0.8)
        if budget < 4 and len(faces) > max_faces:
            raise UsageError(
                f"the mesh cannot be made lighter than {len(faces)} triangles; allow it more than {max_faces}"
            )
    used, faces = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used].astype(np.float32), faces.reshape(-1, 3).astype(np.int32))


def _read_obj(path: Path) -> tuple[NDArray, NDArray]:
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    for line in path.read_text().splitlines():
        kind, *fields = line.split() or [""]
        if kind == "v":
            vertices.append([float(field) for field in fields[:3]])
        elif kind == "f":
            corners = [int(field.split("/")[0]) for field in fields]
            corners = [corner - 1 if corner > 0 else len(vertices) + corner for corner in corners]
            faces += [[corners[0], a, b] for a, b in itertools.pairwise(corners[1:])]
    return np.array(vertices, np.float64), np.array(faces, np.int64)


def _read_stl(path: Path) -> tuple[NDArray, NDArray]:
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
    corners = np.frombuffer(path.read_bytes(), record, offset=84)["corners"]
    return corners.reshape(-1, 3).astype(np.float64), np.arange(3 * len(corners)).reshape(-1, 3)


def _weld(vertices: NDArray, faces: NDArray) -> Mesh:
    unique, index = np.unique(vertices.round(WELD_DECIMALS), axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return Mesh(unique.astype(np.float32), faces[proper].astype(np.int32))


def _store(path: Path, mesh: Mesh) -> None:
    """Written aside, so that workers that start together never see half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_aside(path) as aside, aside.open("wb") as file:
        np.savez_compressed(file, vertices=mesh.vertices, faces=mesh.faces)
