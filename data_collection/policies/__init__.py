"""Policies that act in environments to make data, by name."""

from __future__ import annotations

from data_collection.policies.base import Policy
from envs.errors import UsageError

POLICIES = ("play", "push", "poke", "predictive", "noise", "random")


def make_policy(name: str) -> Policy:
    """A new policy.

    Args:
        name: "play" (a script for the tabletop), "push" and "poke" (scripts for planar pushing) and "predictive" (a
            search, for the dexterous hand), which look into the simulator, "noise" (coloured noise), "random"
            (uniform), or what `stable_baselines.policy_name` gives.

    Raises:
        UsageError: no such policy, or a policy file that cannot be loaded.
    """
    if name == "play":
        from data_collection.policies.play import PlayPolicy

        return PlayPolicy()
    if name == "push":
        from data_collection.policies.push import PushPolicy

        return PushPolicy()
    if name == "poke":
        from data_collection.policies.poke import PokePolicy

        return PokePolicy()
    if name == "predictive":
        from data_collection.policies.predictive import PredictivePolicy

        return PredictivePolicy()
    if name == "noise":
        from data_collection.policies.coloured_noise import NoisePolicy

        return NoisePolicy()
    if name == "random":
        from data_collection.policies.random import RandomPolicy

        return RandomPolicy()
    if "#" in name:
        from data_collection.policies.stable_baselines import StableBaselinesPolicy

        return StableBaselinesPolicy(name)
    raise UsageError(f"no policy named '{name}'; choose one of {', '.join(POLICIES)}")


__all__ = ["POLICIES", "Policy", "make_policy"]
