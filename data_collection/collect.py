"""`collect-rollouts`: have a policy act in an environment and write what happens as a dataset."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from data_collection.environments import (
    extra_kwargs,
    known_env,
    resolve_env,
    usual_policy,
    usual_steps,
    versions,
)
from data_collection.manifest import MANIFEST_NAME, Manifest, read_manifest
from data_collection.policies import POLICIES
from data_collection.policies.stable_baselines import SUFFIX, policy_name
from data_collection.process_workers import ProcessPool
from data_collection.ray_cluster import connect
from data_collection.schema import SHARD_PATTERN, read_shard
from data_collection.workers import ERROR_LOG, Collected, WorkerLost, collect_episodes
from data_collection.writer import shard_path
from envs.command import end_on_sigterm, run
from envs.errors import UsageError
from envs.files import LOCK_NAME, locked, remove_leftovers

IMAGE_SIZE = 64  # pixels
MAX_TIMEOUT = 1_000_000  # seconds; the system waits for no more than twice that in one go


@dataclass(frozen=True)
class Config:
    """Collect RGB-D episodes into a dataset folder. The same command on the same folder goes on where it stopped."""

    out: Path
    """Folder of the dataset; made if it is not there."""
    env: str = "tabletop"
    """Environment: a short name (tabletop, planar-push, dexhand), or any Gymnasium id. Another environment must observe
    rgb, depth and proprio, and have camera, get_state, ACTION_AGGREGATION, ACTION_SCALE and control_rate, as
    docs/data.md says."""
    scene: str | None = None
    """Scene or split, where the environment has several (tabletop: A, B, C, D, usually C; planar-push: train,
    validation, test, all, usually train)."""
    env_kwargs: str = "{}"
    """More keyword arguments of the environment, a JSON object: '{"depth_noise": 0.002}' for planar-push,
    '{"goal_angle": 90}' for dexhand. docs/environments.md lists them."""
    episodes: int = 400
    """Episodes the dataset shall have; a larger number extends it."""
    steps: int | None = None
    """Actions in an episode, which has one frame more; usually 240, with dexhand 100."""
    policy: str | None = None
    """Who acts: play (a script for the tabletop), push and poke (for planar-push: pushes as in Omnipush, or mixed with
    moves that miss), predictive (a search in the simulator, for dexhand), noise (smooth), random (uniform); usually the
    environment's own. Or the .zip of a policy that Stable-Baselines3 trained on dictionaries, as train-policy makes it;
    loading one runs code that is in it."""
    seed: int = 0
    """With the number of an episode it fixes that episode, whatever the number of workers."""
    workers: int = 2
    """Processes that collect."""
    ray: str | None = None
    """Have them on a Ray cluster: HOST:PORT of its head, auto for the one that runs here, local for one that is started
    here and ends with the command. The episodes are the same; only this process writes them."""
    image_size: int | None = None
    """Height and width of the images, pixels; usually 64, a multiple of 8 for the world model. Another environment is
    given it as `image_size`, and only if the option is."""
    ground_truth: bool = False
    """Also record what a model never sees: body ids of the pixels and poses of the bodies (for scene flow)."""
    episode_timeout: float = 300.0
    """Seconds after which a worker that has not finished its episode counts as hung and is replaced."""

    def __post_init__(self) -> None:
        for name, least in (("episodes", 1), ("steps", 1), ("workers", 1), ("seed", 0), ("image_size", 8)):
            value = getattr(self, name)
            if value is not None and value < least:
                option = name.replace("_", "-")
                raise UsageError(f"--{option} is {value}; give a whole number of at least {least}")
        extra_kwargs(self.env, self.env_kwargs)
        if not 0 < self.episode_timeout <= MAX_TIMEOUT:
            raise UsageError(
                f"--episode-timeout is {self.episode_timeout}; give a positive number of seconds, at most {MAX_TIMEOUT}"
            )
        if self.policy is not None and self.policy not in POLICIES and not self.policy.endswith(SUFFIX):
            raise UsageError(
                f"--policy is '{self.policy}'; choose one of {', '.join(POLICIES)}, or give a {SUFFIX} of "
                "Stable-Baselines3"
            )
        if self.out.exists() and not self.out.is_dir():
            raise UsageError(f"--out {self.out} is a file; give a folder")

    def manifest(self) -> Manifest:
        env_id, env_kwargs = resolve_env(self.env, self.scene)
        size = self.image_size or (IMAGE_SIZE if known_env(self.env) else None)
        if size is not None:
            env_kwargs["image_size"] = size
        policy = self.policy or usual_policy(self.env)
        return Manifest(
            env_id=env_id,
            env_kwargs=env_kwargs | extra_kwargs(self.env, self.env_kwargs),
            policy=policy_name(Path(policy)) if policy.endswith(SUFFIX) else policy,
            seed=self.seed,
            steps=usual_steps(self.env) if self.steps is None else self.steps,
            ground_truth=self.ground_truth,
            episodes=self.episodes,
        )


def main(config: Config) -> None:
    """Collect the episodes that the dataset does not have yet."""
    manifest, folder = config.manifest(), config.out
    new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder), _cleared_if_in_vain(folder) if new else contextlib.nullcontext():
        _begin(manifest, folder)
        missing = [number for number in range(config.episodes) if not shard_path(folder, number).exists()]
        done = config.episodes - len(missing)
        with tqdm(total=config.episodes, initial=done, unit="episode", desc=folder.name, file=sys.stderr) as progress:
            for event in _collect(config, manifest, missing):
                if isinstance(event, Collected):
                    progress.update()
                else:
                    lost = f"{event.worker} lost episode {event.episode}: {event.reason}"
                    progress.write(f"{lost}; replaced, the episode starts again", file=sys.stderr)
        there = len(list(folder.glob(SHARD_PATTERN)))
    print(f"{there} episodes in {folder}; look at them with: inspect-dataset {folder}")


def _collect(config: Config, manifest: Manifest, missing: list[int]) -> Iterator[Collected | WorkerLost]:
    """Collect the missing episodes with the workers that are asked for."""
    folder, workers = config.out, min(config.workers, len(missing))
    if config.ray is None or not missing:
        yield from collect_episodes(ProcessPool(manifest, folder, config.episode_timeout), folder, missing, workers)
        return
    with connect(None if config.ray == "local" else config.ray, workers):
        from data_collection.ray_workers import RayPool  # it takes seconds to import Ray: only for those who use it

        on_ray = RayPool(manifest, folder, config.episode_timeout)
        if on_ray.cpus < workers:
            print(f"the Ray cluster has {on_ray.cpus} CPUs: so many workers, not {workers}", file=sys.stderr)
        yield from collect_episodes(on_ray, folder, missing, max(1, min(workers, on_ray.cpus)))


@contextlib.contextmanager
def _cleared_if_in_vain(folder: Path) -> Iterator[None]:
    """Remove a folder that was made for episodes of which none came; the log of what failed keeps it."""
    try:
        yield
    except BaseException:
        if not any(folder.glob(SHARD_PATTERN)) and not (folder / ERROR_LOG).exists():
            remove_leftovers(folder)
            for name in (MANIFEST_NAME, LOCK_NAME):
                (folder / name).unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # somebody else put something there
                folder.rmdir()
        raise


def _begin(manifest: Manifest, folder: Path) -> None:
    """Check that the folder is new or of the same run, and that what it has is whole."""
    before = read_manifest(folder)
    shards = sorted(folder.glob(SHARD_PATTERN))
    if before is None:
        if shards:
            raise UsageError(f"{folder} has shards but no {MANIFEST_NAME}; choose another --out")
    elif shards:  # without any, as after options that did not work, there is nothing to go on with
        manifest.check_continues(before, folder)
    remove_leftovers(folder)
    now = versions()  # once: it reads all of the source
    makers = [read_shard(shard).attrs["versions"] for shard in shards]
    if any(maker != now for maker in makers):
        print(f"warning: {folder} holds episodes made by other versions of the programs", file=sys.stderr)
    if before is None or not shards or before.episodes < manifest.episodes:
        manifest.save(folder)


def command() -> None:
    end_on_sigterm("run the same command again to go on")
    run(Config, main)
