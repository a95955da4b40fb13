"""A Shadow Hand turns a cube towards a goal pose; hand and cube are gymnasium-robotics'."""

from envs.dexhand.env import DexHandEnv

__all__ = ["DexHandEnv"]
