"""Seconds of finding the best of many sampled futures of one clip."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from tests.benchmarks.timing import median_seconds
from worldmodel.checkpoint import load_model
from worldmodel.clips import Clips
from worldmodel.devices import best_precision
from worldmodel.measurement import Networks, Sampling, measure_best
from worldmodel.memory import keep_freed_memory
from worldmodel.perceptual import PerceptualNetwork

CHANNELS = (3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)
LINEAR = (64, 128, 256, 512, 512)
CONTEXT = 2


def best_of_seconds(samples: int, predicted: int, repeats: int) -> float:
    """Median seconds of predicting a clip `samples` times with the shipped T3VIP, choosing by VGG and scoring the best.

    VGG has random weights here, which takes as long as the true ones and needs no network.
    """
    keep_freed_memory()
    model, weights = load_model("t3vip"), _random_weights()
    deciding = PerceptualNetwork(weights)
    networks = Networks(PerceptualNetwork(weights, best_precision(model.device)), deciding)
    frames, camera = CONTEXT + predicted, model.camera
    rgb = torch.rand((1, frames, 3, camera.height, camera.width))
    depth = torch.full((1, frames, 1, camera.height, camera.width), (camera.near + camera.far) / 2)
    clip = Clips(rgb, depth, torch.zeros((1, frames - 1, model.context.action_dim)))
    sampling = Sampling(samples, "vgg")
    with torch.inference_mode():
        return median_seconds(lambda: measure_best(model, clip, 0, CONTEXT, networks, sampling), repeats)


def _random_weights() -> dict[str, Tensor]:
    weights = {f"linear{i}": torch.rand(channels) for i, channels in enumerate(LINEAR)}
    for i, (inputs, outputs) in enumerate(itertools.pairwise(CHANNELS)):
        weights[f"conv{i}.weight"] = torch.randn((outputs, inputs, 3, 3)) / (9 * inputs) ** 0.5
        weights[f"conv{i}.bias"] = torch.zeros(outputs)
    return weights
