"""A round tip pushes an object of four sides, out of 70 objects, about on a table; stands in for Omnipush."""

from envs.planar_push.env import PlanarPushEnv

__all__ = ["PlanarPushEnv"]
