"""Procedural wood, the same to the last bit on every machine with the same numpy."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.tabletop.layouts import Wood

SIZE = 128  # px


def wood_image(wood: Wood) -> NDArray[np.uint8]:
    """Grain along the first axis: wavy growth rings and fine streaks.

    Returns:
        (SIZE, SIZE, 3) uint8.
    """
    rng = np.random.default_rng(wood.seed)
    along, across = np.meshgrid(np.linspace(0, 1, SIZE), np.linspace(0, 1, SIZE), indexing="ij")
    phases = rng.uniform(0, 2 * np.pi, 3)
    waves = sum(
        amplitude * np.sin(2 * np.pi * frequency * along + phase)
        for amplitude, frequency, phase in zip((0.5, 0.25, 0.12), (1, 2, 5), phases, strict=True)
    )
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * wood.rings * across + waves)
    streaks = np.repeat(rng.uniform(-0.18, 0.18, (1, SIZE)), SIZE, axis=0)
    blend = np.clip(rings**1.5 + streaks, 0, 1)[..., None]
    colours = blend * np.array(wood.dark) + (1 - blend) * np.array(wood.light)
    return (255 * colours).round().astype(np.uint8)


def add_wood(spec: mujoco.MjSpec, name: str, wood: Wood) -> None:
    """Add the material `name`: the wood seen along a geom's local z axis, its grain along y."""
    texture = spec.add_texture(
        name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=SIZE, height=SIZE, nchannel=3
    )  # a cube texture would show on every face, at twice the cost of a pixel in software
    texture.data = wood_image(wood).tobytes()
    add_textured_material(spec, name, name)


def add_textured_material(spec: mujoco.MjSpec, name: str, texture: str, repeat: int = 1) -> None:
    """Add the material `name` that shows `texture`."""
    textures = [""] * mujoco.mjtTextureRole.mjNTEXROLE
    textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture
    spec.add_material(name=name, textures=textures, texrepeat=[repeat, repeat], specular=0.1, shininess=0.1)
