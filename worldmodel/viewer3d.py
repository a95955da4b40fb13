"""Predicted beside true point clouds over time, for the Rerun viewer: as a recording, or live.

Entities: `world/truth` and `world/predicted/MODEL`, each with `points` (coloured as seen or predicted), `flow` (arrows:
the motion from this frame to the next, where there is some) and `tcp` (its way so far, where the truth is known);
`world/camera` with the true picture; `pictures/truth` and `pictures/predicted/MODEL` in 2D. Timelines: `step` and
`ahead`, 0 at the last frame seen. World frame, metres.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from envs.camera import CameraModel
from envs.errors import UsageError
from envs.files import written_aside
from worldmodel.clips import Clips, ClipTruth
from worldmodel.colours import PALETTE, rgb_colours
from worldmodel.figure import TRUTH
from worldmodel.metrics import MOVING_M
from worldmodel.pictures import Shown
from worldmodel.t3vip import T3VIP
from worldmodel.tracking import tcp_way

APPLICATION = "view-prediction"
INSTALL = "pip install --constraint constraints.txt --editable '.[viewer]'"
ARROW_STRIDE = 2  # every other moving pixel of a row and a column gets an arrow
FRUSTUM_M = 0.5
BACKGROUND = [228, 231, 236]  # white arms shall not vanish before it
COLOURS = (255 * PALETTE[[2, 1, 0, 3, 4, 5, 6, 7, 8, 9]]).round().astype(np.uint8)  # the truth's first: green


@dataclass(frozen=True)
class Scene:
    """What there is to see of one clip."""

    camera: CameraModel
    clips: Clips
    truth: ClipTruth | None
    context: int
    frame_seconds: float
    models: Sequence[Shown]


@dataclass(frozen=True)
class _Cloud:
    """One source at one frame, camera frame, metres."""

    rgb: Tensor
    """(3, H, W)."""
    depth: Tensor
    """(1, H, W)."""
    flow: Tensor | None
    """(3, H, W) to the next frame, or None where there is no next one or nobody knows."""


def require_rerun(display: bool = False) -> None:
    """Check, before any work, that a scene can be written and, with `display`, shown.

    Raises:
        UsageError: Rerun is not installed or does not load, or there is no display.
    """
    _rerun()
    if display and sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UsageError(
            "--view needs a display and there is none; write --out FILE.rrd and open it elsewhere: rerun FILE.rrd"
        )


def write_scene(scene: Scene, path: Path) -> None:
    """Write a recording that `rerun PATH` opens."""
    recording = _rerun().RecordingStream(APPLICATION)
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_aside(path) as aside:
        recording.save(aside)
        _Recorder(scene, recording).record()
        recording.disconnect()


def view_scene(scene: Scene) -> None:
    """Show the scene in the viewer that came with this Python's Rerun, whatever is on the PATH; wait till it is closed.

    Raises:
        UsageError: the viewer does not start.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{APPLICATION}.rrd"
        write_scene(scene, path)
        code = subprocess.run([sys.executable, "-m", "rerun_cli", str(path)]).returncode
    if code:
        raise UsageError(f"the Rerun viewer ended with code {code}; write --out FILE.rrd and open it elsewhere")


def _rerun() -> Any:
    try:
        return importlib.import_module("rerun")
    except ImportError as error:
        raise UsageError(f"the 3D view needs Rerun ({error}); install it with: {INSTALL}") from error


def _blueprint(scene: Scene) -> Any:
    """Above the clouds, each on its own and together; the camera, far off, in a tab; below, the pictures."""
    rrb = importlib.import_module("rerun.blueprint")

    def view(name: str, *contents: str) -> Any:
        return rrb.Spatial3DView(name=name, origin="world", contents=list(contents), background=BACKGROUND)

    spatial = [shown.name for shown in scene.models if shown.clouds]
    clouds = [view(name, f"{_entity('world', name)}/**") for name in (TRUTH, *spatial)]
    if spatial:
        together = view("together", "world/**", "- world/camera/**")
        clouds.append(rrb.Tabs(together, view("with the camera", "world/**")))
    pictures = [
        rrb.Spatial2DView(name=name, origin=_entity("pictures", name))
        for name in (TRUTH, *(shown.name for shown in scene.models))
    ]
    layout = rrb.Vertical(rrb.Horizontal(*clouds), rrb.Horizontal(*pictures), row_shares=[3, 1])
    return rrb.Blueprint(layout, collapse_panels=True)


def _entity(kind: str, source: str) -> str:
    """The path of a source's entities; what is special in a model's name is escaped."""
    parts = [kind, source] if source == TRUTH else [kind, "predicted", source]
    return str(_rerun().new_entity_path(parts))


class _Recorder:
    """Sends a scene to a recording."""

    def __init__(self, scene: Scene, recording: Any) -> None:
        self.rr, self.scene, self.recording, self.camera = _rerun(), scene, recording, scene.camera

    def record(self) -> None:
        """All of it."""
        self.recording.send_blueprint(_blueprint(self.scene))
        self._record_camera()
        sources: dict[str, Iterator[tuple[int, _Cloud]]] = {TRUTH: _true_clouds(self.scene)}
        sources |= {shown.name: _predicted_clouds(self.scene, shown) for shown in self.scene.models if shown.clouds}
        tracks = _tracks(self.scene)
        for number, (name, clouds) in enumerate(sources.items()):
            colour = COLOURS[number % len(COLOURS)]
            for frame, cloud in clouds:
                self._go_to(frame)
                self._record_cloud(_entity("world", name), cloud, colour)
                way = tracks[name][: max(0, frame - self.scene.context + 2)] if name in tracks else ()
                if len(way):
                    path = f"{_entity('world', name)}/tcp"
                    self._log(path, self.rr.LineStrips3D([way], radii=0.004, colors=colour))
                    self._log(f"{path}/now", self.rr.Points3D(way[-1:], radii=0.012, colors=colour))
        self._record_pictures()
        self.recording.flush(blocking=True)

    def _log(self, path: str, *what: Any, static: bool = False) -> None:
        self.recording.log(path, *what, static=static, strict=True)

    def _go_to(self, frame: int) -> None:
        step = frame - self.scene.context + 1
        self.recording.set_time("step", sequence=step)
        self.recording.set_time("ahead", duration=step * self.scene.frame_seconds)

    def _record_camera(self) -> None:
        rr, pose = self.rr, self.camera.world_T_camera
        lens = rr.Pinhole(
            image_from_camera=self.camera.K,
            resolution=[self.camera.width, self.camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=FRUSTUM_M,
        )
        # Up is z. What the viewer takes for forward is where it first looks: more or less where the camera does.
        x, y = pose[:2, 2]
        forward = ("FLU" if x > 0 else "BRU") if abs(x) > abs(y) else ("RFU" if y > 0 else "LBU")
        self._log("world", getattr(rr.ViewCoordinates, forward), static=True)
        self._log("world/camera", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]), lens, static=True)

    def _record_cloud(self, path: str, cloud: _Cloud, colour: NDArray[np.uint8]) -> None:
        camera, depth = self.camera, cloud.depth[0].cpu().numpy()
        points = camera.to_world(camera.unproject(depth))  # (H, W, 3)
        surface = depth < camera.far - 1e-3 * (camera.far - camera.near)  # nobody knows what is beyond the range
        radii = 0.7 * depth[surface] / camera.K[0, 0]  # neighbours just touch
        self._log(
            f"{path}/points", self.rr.Points3D(points[surface], colors=rgb_colours(cloud.rgb)[surface], radii=radii)
        )
        if cloud.flow is None:
            self._log(f"{path}/flow", self.rr.Clear(recursive=False))
            return
        flow = cloud.flow.permute(1, 2, 0).cpu().numpy() @ camera.world_T_camera[:3, :3].T
        chosen = surface & (np.linalg.norm(flow, axis=-1) > MOVING_M)
        chosen[(np.indices(depth.shape) % ARROW_STRIDE).any(0)] = False
        arrows = self.rr.Arrows3D(origins=points[chosen], vectors=flow[chosen], colors=colour, radii=0.0015)
        self._log(f"{path}/flow", arrows)

    def _record_pictures(self) -> None:
        scene, now = self.scene, self.scene.context - 1
        for frame, picture in enumerate(scene.clips.rgb[0]):
            self._go_to(frame)
            image = self.rr.Image(rgb_colours(picture))
            self._log("world/camera", image)
            self._log(_entity("pictures", TRUTH), image)
        for shown in scene.models:
            frames = [scene.clips.rgb[0, now], *(prediction.rgb[0] for prediction in shown.predictions[now:])]
            for frame, picture in enumerate(frames, start=now):
                self._go_to(frame)
                self._log(_entity("pictures", shown.name), self.rr.Image(rgb_colours(picture)))


def _true_clouds(scene: Scene) -> Iterator[tuple[int, _Cloud]]:
    clips, frames = scene.clips, scene.clips.rgb.shape[1]
    for t in range(frames):
        flow = None if scene.truth is None or t == frames - 1 else scene.truth.scene_flow[0, t]
        yield t, _Cloud(clips.rgb[0, t], clips.depth[0, t], flow)


def _predicted_clouds(scene: Scene, shown: Shown) -> Iterator[tuple[int, _Cloud]]:
    """From the last frame seen on: the frame as the model has it, and where it says its points go."""
    clouds, now = shown.clouds, scene.context - 1
    rgb, depth = scene.clips.rgb[0, now], scene.clips.depth[0, now]
    for t in range(now, len(clouds)):
        yield t, _Cloud(rgb, depth, clouds[t].scene_flow[0])
        rgb, depth = clouds[t].rgb[0], clouds[t].depth[0]
    yield len(clouds), _Cloud(rgb, depth, None)


@torch.inference_mode()
def _tracks(scene: Scene) -> dict[str, NDArray[np.float64]]:
    """The TCP's way (P+1, 3) from the last frame seen on, world frame: the true one, and as each model moves it."""
    if scene.truth is None or scene.truth.tcp is None:
        return {}
    now, camera = scene.context - 1, scene.camera
    tcp = scene.truth.tcp[0, now:]
    tracks = {TRUTH: camera.to_world(tcp.numpy())}
    points = torch.from_numpy(camera.unproject(scene.clips.depth[0, now, 0].numpy())).permute(2, 0, 1).float()
    for shown in scene.models:
        if not isinstance(shown.model, T3VIP):
            continue
        device, steps = shown.model.device, ((cloud.transform, cloud.masks[:, :1]) for cloud in shown.clouds[now:])
        way = tcp_way(points.to(device), tcp[0].to(device), shown.model.intrinsics, steps)
        tracks[shown.name] = camera.to_world(way.cpu().numpy())
    return tracks
