"""Pictures of a prediction beside the truth: RGB, depth, masks, scene flow, optical flow, occlusion."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as imageio
import matplotlib
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from worldmodel.clips import Clips, ClipTruth
from worldmodel.rollout import Rollout, unroll
from worldmodel.t3vip import CloudPrediction
from worldmodel.world_model import WorldModel

Image = NDArray[np.uint8]
FLOW_FULL_M = 0.06
"""Length of a scene flow that gets full colour."""


def colour_wheel(flow: Tensor, full: float) -> Image:
    """A 2D field as colours: the direction is the hue, the length the saturation, still is white.

    Args:
        flow: (2, H, W), to the right and downwards.
        full: length of full saturation.

    Returns:
        (H, W, 3) uint8.
    """
    field = flow.detach().float().cpu().numpy()
    hue = np.arctan2(field[1], field[0]) / (2 * np.pi) % 1.0
    saturation = np.clip(np.hypot(field[0], field[1]) / full, 0, 1)
    colours = matplotlib.colors.hsv_to_rgb(np.stack((hue, saturation, np.ones_like(hue)), axis=-1))
    return (255 * colours).astype(np.uint8)


def wheel_legend(size: int) -> Image:
    """The colour wheel itself, (size, size, 3) uint8: what colour each direction gets."""
    axis = torch.linspace(-1, 1, size)
    v, u = torch.meshgrid(axis, axis, indexing="ij")
    legend = colour_wheel(torch.stack((u, v)), 1.0)
    legend[(u.square() + v.square() > 1).numpy()] = 255
    return legend


def scene_flow_colours(flow: Tensor, full: float = FLOW_FULL_M) -> Image:
    """(3, H, W) metres to (H, W, 3) uint8: grey is still; x, y, z add red, green, blue."""
    return (255 * (0.5 + 0.5 * (flow / full).clamp(-1, 1))).byte().permute(1, 2, 0).cpu().numpy()


def depth_colours(depth: Tensor, near: float, far: float) -> Image:
    """(1, H, W) metres to (H, W, 3) uint8, near is bright."""
    scaled = ((far - depth[0]) / (far - near)).clamp(0, 1).cpu().numpy()
    return (255 * matplotlib.colormaps["magma"](scaled)[..., :3]).astype(np.uint8)


def mask_colours(masks: Tensor) -> Image:
    """(K, H, W) masks to (H, W, 3) uint8: the background black, every other mask a colour, blended as the masks are."""
    palette = torch.from_numpy(matplotlib.colormaps["tab10"](np.arange(masks.shape[0] - 1) % 10)[:, :3]).to(masks)
    return (255 * torch.einsum("khw,kc->hwc", masks[1:], palette)).byte().cpu().numpy()


def _rgb(picture: Tensor) -> Image:
    return (255 * picture.clamp(0, 1)).round().byte().permute(1, 2, 0).cpu().numpy()


def _shadow(mask: Tensor) -> Image:
    return (255 * mask[0]).byte().unsqueeze(-1).expand(-1, -1, 3).cpu().numpy()


def rollout_rows(
    model: WorldModel, clips: Clips, rollout: Rollout, truth: ClipTruth | None, context: int
) -> list[list[Image]]:
    """Rows of pictures of the first clip, one column a predicted step: truth above, prediction below."""
    near, far = model.camera.near, model.camera.far
    steps = range(context - 1, len(rollout.predictions))
    made = [rollout.predictions[t] for t in steps]
    rows = [
        [_rgb(clips.rgb[0, t + 1]) for t in steps],
        [_rgb(p.rgb[0]) for p in made],
        [mask_colours(p.masks[0]) for p in made],
    ]
    clouds = [prediction for prediction in made if isinstance(prediction, CloudPrediction)]
    if not clouds:
        return rows
    rows[2:2] = [
        [depth_colours(clips.depth[0, t + 1], near, far) for t in steps],
        [depth_colours(p.depth[0], near, far) for p in clouds],
    ]
    if truth is not None:
        rows.append([scene_flow_colours(truth.scene_flow[0, t]) for t in steps])
    rows.append([scene_flow_colours(p.scene_flow[0]) for p in clouds])
    rows.append([colour_wheel(p.optical_flow[0], 5.0) for p in clouds])
    rows.append([_shadow(p.occlusion[0]) for p in clouds])
    return rows


def tile(rows: list[list[Image]], scale: int = 1, gap: int = 2) -> Image:
    """Pictures of one size in rows and columns on white, each enlarged `scale` times."""
    height, width = rows[0][0].shape[:2]
    height, width = height * scale, width * scale
    columns = max(map(len, rows))
    sheet = np.full((len(rows) * (height + gap) - gap, columns * (width + gap) - gap, 3), 255, np.uint8)
    for r, row in enumerate(rows):
        for c, picture in enumerate(row):
            large = picture.repeat(scale, axis=0).repeat(scale, axis=1)
            sheet[r * (height + gap) : r * (height + gap) + height, c * (width + gap) : c * (width + gap) + width] = (
                large
            )
    return sheet


@torch.inference_mode()
def picture_prediction(
    model: WorldModel, clips: Clips, truth: ClipTruth | None, context: int, path: Path, scale: int = 2
) -> None:
    """Write a PNG of a free-running prediction of the first clip beside the truth.

    Rows: true and predicted RGB, true and predicted depth, masks, true (where known) and predicted scene flow,
    predicted optical flow on the colour wheel, occlusion; of a model of pictures RGB and masks only. Columns: the
    predicted steps. The true scene flow starts from true frames, the predicted one from predicted frames.
    """
    was_training = model.training
    model.eval()
    first = Clips(clips.rgb[:1], clips.depth[:1], clips.actions[:1]).to(model.device)
    sheet = tile(rollout_rows(model, first, unroll(model, first, context), truth, context), scale)
    model.train(was_training)
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(path.name + ".tmp")
    aside.write_bytes(imageio.imwrite("<bytes>", sheet, extension=".png"))
    aside.replace(path)
