"""Making the episodes of a run one by one, each a shard: the same bytes whoever makes it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from data_collection.environments import describe_env, make_env
from data_collection.manifest import Manifest
from data_collection.policies import make_policy
from data_collection.rollout import collect_episode
from data_collection.writer import write_shard


class EpisodeMaker:
    """An environment to collect from, and what a shard says about it.

    Args:
        manifest: what an episode is.

    Raises:
        UsageError: the environment cannot be used.
    """

    def __init__(self, manifest: Manifest) -> None:
        self._manifest = manifest
        self._env = make_env(manifest.env_id, manifest.env_kwargs, manifest.ground_truth)
        self._attrs = describe_env(self._env, manifest.env_id, manifest.env_kwargs)
        self._attrs |= {"policy": manifest.policy, "seed": manifest.seed}

    def write(self, episode: int, path: Path, on_step: Callable[[], None] = lambda: None) -> None:
        """Collect an episode and write its shard, whole or not at all.

        Args:
            episode: its number in the run.
            path: of the shard.
            on_step: called before every step, and before the shard is written.

        Raises:
            UsageError: the policy or what the environment gave cannot be used.
        """
        run = self._manifest
        policy = make_policy(run.policy)
        columns, terminated = collect_episode(
            self._env, policy, run.steps, run.seed, episode, run.ground_truth, on_step
        )
        on_step()
        write_shard(path, [columns], self._attrs, [episode], [terminated])
