"""Every benchmark by its name: what is compared with what. A quick run has sizes to try it out, not to quote."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from tests.benchmarks.child import measure
from tests.benchmarks.result import Result, cost, rate
from tests.benchmarks.timing import MMAP_EVERYTHING

Size = dict[str, Any]  # arguments of a subject
PLAN_LIMIT_S = 0.4
BEST_OF_LIMIT_S = 20.0
WAIT_LIMIT_PERCENT = 5.0
PUSH_STEPS_LEAST = 300
KNN_RADIUS = 5  # the presets'


def tabletop_rgbd_steps(quick: bool) -> Result:
    """Control steps of the tabletop with RGB-D on one core."""
    ours = measure("rendering.tabletop_steps", cores=1, steps=5 if quick else 150, repeats=1 if quick else 5)
    stock = measure("rendering.robosuite_steps", 1, _same_opengl(), steps=2 if quick else 30, repeats=1 if quick else 5)
    what = "robosuite's camera path (Lift, Panda, OSC_POSE, one 64x64 camera with depth, 30 Hz), one core"
    return rate("tabletop_rgbd_steps", ours, "steps/s", stock, what)


def dexhand_rgbd_steps(quick: bool) -> Result:
    """Control steps of the hand with RGB-D on one core, without a policy."""
    size: Size = {"steps": 2 if quick else 100, "repeats": 1 if quick else 5}
    ours = measure("rendering.dexhand_steps", cores=1, **size)
    stock = measure("rendering.manipulate_block_steps", 1, _same_opengl(), **size)
    what = "gymnasium-robotics' HandManipulateBlock, 64x64 picture and depth after each step, one core"
    return rate("dexhand_rgbd_steps", ours, "steps/s", stock, what)


def planar_push_rgbd_steps(quick: bool) -> Result:
    """Control steps of the pusher with RGB-D on one core, without a policy."""
    size: Size = {"steps": 2 if quick else 200, "repeats": 1 if quick else 5}
    ours = measure("rendering.planar_push_steps", cores=1, **size)
    return rate("planar_push_rgbd_steps", ours, "steps/s", PUSH_STEPS_LEAST, "the least wanted, one core")


def import_calvin(quick: bool) -> Result:
    """Importing a gigabyte in CALVIN's layout by one process."""
    size: Size = {"frames": 4, "size": 64} if quick else {"frames": 3600, "size": 200}
    found = measure("importing.import_speed", cores=1, **size)
    what = f"reading and unpacking the same arrays alone; {found['gigabytes']:.2g} GB"
    return rate("import_calvin", found["import"], "GB/s", found["unpack"], what)


def import_memory(quick: bool) -> Result:
    """Peak memory of importing, by one process."""
    frames = (4, 8) if quick else (241, 1205)
    size = 64 if quick else 200
    few, many = (
        measure("importing.import_mebibytes", 1, MMAP_EVERYTHING, frames=number, size=size) for number in frames
    )
    return cost("import_memory", many, "MiB", few, f"{frames[0]} frames; this with {frames[1]}")


def rgbd_frames(quick: bool) -> Result:
    """Supersampled RGB-D frames of the tabletop on one core."""
    size: Size = {"frames": 3 if quick else 100, "repeats": 1 if quick else 5}
    ours = measure("rendering.tabletop_frames", cores=1, **size)
    two_pass = measure("rendering.two_pass_frames", 1, _same_opengl(), **size)
    return rate("rgbd_frames", ours, "frames/s", two_pass, "mujoco.Renderer twice at 192x192, averaged, one core")


def collect(quick: bool) -> Result:
    """Collecting scripted play with two workers."""
    size: Size = {"episodes": 4, "steps": 5} if quick else {"episodes": 14, "steps": 120}
    one, two = (measure("collection.collected_steps", workers=workers, **size) for workers in (1, 2))
    return rate("collect", two, "steps/s", one, "the same with one worker; this with two, on two cores")


def knn_loss(quick: bool) -> Result:
    """The kNN loss on all predictions of a batch, forward and backward."""
    size = _knn_size(quick) | {"repeats": 1 if quick else 7}
    ours, unfolded = (measure("losses.alignment_seconds", kind=kind, **size) for kind in ("ours", "plain"))
    return cost("knn_loss", ours, "s", unfolded, "unfold")


def knn_loss_memory(quick: bool) -> Result:
    """Peak memory of the same."""
    ours, unfolded = (
        measure("losses.alignment_mebibytes", environment=MMAP_EVERYTHING, kind=kind, **_knn_size(quick))
        for kind in ("ours", "plain")
    )
    return cost("knn_loss_memory", ours, "MiB", unfolded, "unfold")


def knn_against_chamfer(quick: bool) -> Result:
    """The kNN loss against the chamfer distance that it stands in for, forward and backward: the paper's claim."""
    ours = measure("losses.alignment_seconds", kind="ours", repeats=1 if quick else 7, **_knn_size(quick))
    full = measure("losses.alignment_seconds", kind="chamfer", repeats=1 if quick else 3, **_knn_size(quick))
    return cost("knn_against_chamfer", ours, "s", full, "our chamfer distance, which stores no distances")


def knn_against_chamfer_memory(quick: bool) -> Result:
    """Peak memory of the same on one pair of clouds a clip, against the plain chamfer distance."""
    size = _knn_size(quick, predictions=1)
    ours, rows, matrix = (
        measure("losses.alignment_mebibytes", environment=MMAP_EVERYTHING, kind=kind, **size)
        for kind in ("ours", "chamfer", "plain chamfer")
    )
    what = f"chamfer distance by a matrix of all distances; ours, which stores none: {rows:.3g} MiB"
    return cost("knn_against_chamfer_memory", ours, "MiB", matrix, what)


def splat(quick: bool) -> Result:
    """Splatting a batch of RGB-D frames in mode `average`, forward and backward."""
    size: Size = {"frames": 2, "size": 16, "repeats": 1} if quick else {"frames": 16, "size": 64, "repeats": 31}
    ours, plain = (measure("losses.splat_seconds", kind=kind, **size) for kind in ("ours", "plain"))
    return cost("splat", 1e3 * ours, "ms", 1e3 * plain, "index_add of the four corners")


def train_step(quick: bool) -> Result:
    """An update of the `cpu` preset: 16 clips of 12 frames, all losses."""
    repeats = 1 if quick else 3  # it is long
    plain = measure("training.step_seconds", kind="plain", preset=_preset(quick), repeats=repeats)
    what = "the same network in fp32, default layout and memory, eager, sum over transformed clouds, unfold"
    return cost("train_step", _our_training(quick)["update"], "s", plain["update"], what)


def cdna_step(quick: bool) -> Result:
    """An update of CDNA at full width, kernels of 5 x 5: 16 clips of 12 frames."""
    size: Size = {"width": 0.25, "frames": 3, "repeats": 1} if quick else {"width": 1.0, "frames": 12, "repeats": 5}
    ours, plain = (
        measure("training.cdna_step_seconds", kind=kind, preset=_preset(quick), **size) for kind in ("ours", "plain")
    )
    return cost("cdna_step", ours, "s", plain, "the same network in fp32, default layout and memory, eager")


def data_wait(quick: bool) -> Result:
    """What share of a training step goes into waiting for its clips."""
    ours = _our_training(quick)
    share = 100 * ours["wait"] / (ours["wait"] + ours["update"])
    return cost("data_wait", share, "%", WAIT_LIMIT_PERCENT, "the limit")


def plan_action(quick: bool) -> Result:
    """A planned action of the T3VIP controller on two cores."""
    search = {"population": 4, "iterations": 1, "elites": 2} if quick else {}
    found = measure("planning.action_seconds", decisions=1 if quick else 15, search=search)
    what = f"the limit; {found['rollouts']} rollouts, {found['model']} model"
    return cost("plan_action", found["seconds"], "s", PLAN_LIMIT_S, what)


def best_of_100(quick: bool) -> Result:
    """The best of 100 futures of a clip: 2 frames seen, 10 predicted, chosen by VGG, all scores."""
    size: Size = (
        {"samples": 2, "predicted": 1, "repeats": 1} if quick else {"samples": 100, "predicted": 10, "repeats": 3}
    )
    return cost("best_of_100", measure("evaluation.best_of_seconds", **size), "s", BEST_OF_LIMIT_S, "the limit")


BENCHMARKS: dict[str, Callable[[bool], Result]] = {
    function.__name__: function
    for function in (
        tabletop_rgbd_steps,
        dexhand_rgbd_steps,
        planar_push_rgbd_steps,
        rgbd_frames,
        collect,
        import_calvin,
        import_memory,
        knn_loss,
        knn_loss_memory,
        knn_against_chamfer,
        knn_against_chamfer_memory,
        splat,
        train_step,
        cdna_step,
        data_wait,
        plan_action,
        best_of_100,
    )
}


@functools.cache
def opengl() -> str:
    """What draws here, e.g. `egl: llvmpipe (...)`."""
    return str(measure("rendering.opengl", cores=1))


def _same_opengl() -> dict[str, str]:
    """Lets the usual ways, which do not choose by themselves, draw with what we draw with."""
    return {"MUJOCO_GL": opengl().split(":")[0]}


@functools.cache
def _our_training(quick: bool) -> dict[str, float]:
    size: Size = {"preset": _preset(quick), "repeats": 1 if quick else 9}
    return dict(measure("training.step_seconds", kind="ours", **size))


def _preset(quick: bool) -> str:
    return "tiny" if quick else "cpu"


def _knn_size(quick: bool, predictions: int = 11) -> Size:
    frames = 2 if quick else 16 * predictions
    return {"frames": frames, "size": 16 if quick else 64, "radius": 2 if quick else KNN_RADIUS}
