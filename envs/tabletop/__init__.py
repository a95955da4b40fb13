"""A Panda arm at a play table with a drawer, a sliding door, a button, a switch, two lamps and three blocks."""

from envs.tabletop.env import TabletopEnv

__all__ = ["TabletopEnv"]
