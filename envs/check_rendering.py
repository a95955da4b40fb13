"""`check-rendering`: which OpenGL is live, whether its depth is right, and how fast it draws."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import mujoco
import numpy as np

from envs.command import run
from envs.errors import UsageError
from envs.files import write_json
from envs.rendering import StaticCamera

TOLERANCE_MM = 1.0

_RADIUS, _HALF_SIDE = 0.15, 0.12
_SIDES = f"{_HALF_SIDE} {_HALF_SIDE} {_HALF_SIDE}"
_SCENE = f"""
<mujoco>
  <visual><map znear="0.5" zfar="12"/><quality numslices="64" numstacks="32"/></visual>
  <statistic extent="1"/>
  <asset>
    <texture name="check" type="2d" builtin="checker" width="128" height="128" rgb1=".2 .3 .4" rgb2=".8 .8 .7"/>
    <material name="check" texture="check" texrepeat="8 8"/>
  </asset>
  <worldbody>
    <light pos="1 -1 4" dir="-.2 .2 -1"/>
    <camera name="narrow" pos="0 0 4.2" fovy="10"/>
    <camera name="wide" pos="0 0 1.5" fovy="60"/>
    <geom type="plane" size="3 3 .1" material="check" group="1"/>
    <body pos="-.18 0 .3"><geom type="sphere" size="{_RADIUS}" rgba=".8 .2 .2 1" group="1"/></body>
    <body pos=".18 0 .3"><geom type="box" size="{_SIDES}" rgba=".2 .7 .3 1" group="2"/></body>
  </worldbody>
</mujoco>
"""


@dataclass(frozen=True)
class Config:
    """Say which OpenGL draws here, check its depth against known geometry, and measure its speed.

    EGL is taken where it works, else OSMesa; set MUJOCO_GL=egl or MUJOCO_GL=osmesa to insist on one. Ends with exit
    code 0 and OK, or with 1 and FAILED when depth is off by more than a millimetre, or with 2 and the packages to
    install when no OpenGL works.
    """

    size: int = 64
    """Side of the square picture, pixels."""
    supersample: int = 3
    """Samples per pixel along each side; an odd number."""
    seconds: float = 2.0
    """How long to measure the speed."""
    json: Path | None = None
    """Also write the findings to this file."""

    def __post_init__(self) -> None:
        if not 32 <= self.size <= 1024:
            raise UsageError(f"--size is {self.size}; give 32 to 1024 pixels")
        if not 0 < self.seconds <= 60:
            raise UsageError(f"--seconds is {self.seconds}; give more than 0 and at most 60")


@dataclass(frozen=True)
class Findings:
    """What `check` found."""

    renderer: str
    """The backend and GL_RENDERER."""
    narrow_error_mm: float
    """Worst depth error of a 10 degree camera 4.2 m away, millimetres."""
    wide_error_mm: float
    """Worst depth error of a 60 degree camera 1.5 m away, millimetres."""
    frames_per_second: float
    """RGB-D frames per second, anti-aliased."""
    threads: str
    """LP_NUM_THREADS: the threads that software Mesa adds to the process; 0 makes it a per-core figure."""

    @property
    def ok(self) -> bool:
        return max(self.narrow_error_mm, self.wide_error_mm) <= TOLERANCE_MM


def check(size: int, supersample: int, seconds: float) -> Findings:
    """Draw a sphere and a box on a plane at known places, compare depth, and time the pictures.

    Raises:
        UsageError: no OpenGL works.
    """
    model = mujoco.MjModel.from_xml_string(_SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with StaticCamera(model, "narrow", size, size, 3.0, 5.0, supersample) as camera:
        narrow = _depth_error(camera, data)
        renderer = camera.gl_renderer()
        frames, start = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < seconds or frames == 0:
            camera.render(data)
            frames += 1
    with StaticCamera(model, "wide", size, size, 0.8, 2.0, supersample) as camera:
        wide = _depth_error(camera, data)
    threads = os.environ.get("LP_NUM_THREADS", "unset")
    return Findings(renderer, 1e3 * narrow, 1e3 * wide, frames / elapsed, threads)


def _depth_error(camera: StaticCamera, data: mujoco.MjData) -> float:
    """The largest difference between drawn and analytic depth, metres, over pixels well inside of a surface."""
    _, depth = camera.render(data)
    ids = camera.segment(data)
    points = camera.geometry.to_world(camera.geometry.unproject(depth))
    # Both cameras look straight down, so that a depth error is a height error. The sphere is drawn as a
    # polyhedron: look at its top only.
    sphere, box = data.xpos[1], data.xpos[2]
    offset = points[..., :2] - sphere[:2]
    across = np.square(offset).sum(-1)
    top = (ids == 1) & (across < (0.3 * _RADIUS) ** 2)
    sphere_height = sphere[2] + np.sqrt(np.maximum(_RADIUS**2 - across, 0.0))
    lid = (ids == 2) & (np.abs(points[..., :2] - box[:2]).max(-1) < 0.8 * _HALF_SIDE)
    floor = (ids == 0) & (depth < camera.geometry.far)
    errors = [
        np.abs(points[..., 2] - height)[where]
        for where, height in ((top, sphere_height), (lid, box[2] + _HALF_SIDE), (floor, 0.0))
    ]
    if any(error.size == 0 for error in errors):
        return float("inf")  # something known to be in view was not drawn
    return float(max(error.max() for error in errors))


def main(config: Config) -> None:
    """Print the findings; exit code 1 when depth is wrong."""
    findings = check(config.size, config.supersample, config.seconds)
    picture = f"{config.size}x{config.size}, {config.supersample}x{config.supersample} samples a pixel"
    print(f"OpenGL      {findings.renderer}")
    print(f"speed       {findings.frames_per_second:.0f} RGB-D frames/s ({picture}, LP_NUM_THREADS={findings.threads})")
    print(f"depth error {findings.narrow_error_mm:.3f} mm (4.2 m away, fovy 10)")
    print(f"            {findings.wide_error_mm:.3f} mm (1.5 m away, fovy 60)")
    print("OK" if findings.ok else f"FAILED: depth is off by more than {TOLERANCE_MM} mm")
    if config.json is not None:
        try:
            write_json(config.json, asdict(findings) | {"ok": findings.ok})
        except OSError as error:
            raise UsageError(
                f"cannot write {config.json} ({error.strerror}); give a file in a folder that exists"
            ) from error
    if not findings.ok:
        sys.exit(1)


def command() -> None:
    """Entry point of `check-rendering`."""
    run(Config, main)


if __name__ == "__main__":
    command()
