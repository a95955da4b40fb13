"""Every world model by its name: what `train-worldmodel --model` can make."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, cast

from envs.errors import UsageError
from worldmodel.config import ModelConfig, ModelContext
from worldmodel.kernels import CDNA, SNA, SV2P
from worldmodel.t3vip import T3VIP
from worldmodel.world_model import WorldModel

ModelName = Literal["t3vip", "t3vip-d", "sv2p", "sna", "cdna"]
KINDS: dict[str, type[WorldModel]] = {kind.kind: kind for kind in (T3VIP, SV2P, SNA, CDNA)}
DETERMINISTIC = ("t3vip-d", "sna", "cdna")


def named_config(name: ModelName, config: ModelConfig) -> tuple[str, ModelConfig]:
    """The kind of a model and its architecture: those without latents have none whatever the config says."""
    if name in DETERMINISTIC:
        config = replace(config, latents="none")
    return name.removesuffix("-d"), config


def name_of(kind: str, config: ModelConfig) -> ModelName:
    """The name of a model of this kind and architecture: what `named_config` takes."""
    name = f"{kind}-d" if config.latents == "none" and f"{kind}-d" in DETERMINISTIC else kind
    return cast(ModelName, name)


def make_model(kind: str, config: ModelConfig, context: ModelContext) -> WorldModel:
    """A model with fresh weights.

    Raises:
        UsageError: there is no such kind.
    """
    if kind not in KINDS:
        raise UsageError(f"no model of the kind '{kind}'; there are {', '.join(KINDS)}")
    return KINDS[kind](config, context)
