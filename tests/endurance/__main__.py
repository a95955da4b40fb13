"""Kill the collector and the trainer at random moments, again and again, and compare with runs left in peace.

    python -m tests.endurance --kills 30 --out build/endurance

Each life begins like any other call of the command. Once it has got further than the life before, it is killed by
SIGKILL within some random time, all of its processes at once. In the end shards and weights must be, bit for bit, those
of an undisturbed run. Takes half an hour, so `make test` kills only once; writes endurance.json.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

Progress = Callable[[], int]


def start(module: str, arguments: Sequence[str]) -> subprocess.Popen[bytes]:
    """Start a command in a process group of its own."""
    code = f"from {module} import command; command()"
    return subprocess.Popen([sys.executable, "-c", code, *arguments], start_new_session=True, stderr=subprocess.DEVNULL)


def kill_often(module: str, arguments: Sequence[str], progress: Progress, kills: int, rng: random.Random) -> list[int]:
    """Kill a command `kills` times, then let it finish.

    Returns:
        Its progress at each kill.

    Raises:
        AssertionError: progress was lost, a life got nowhere, or the last one failed.
    """
    at_kill: list[int] = []
    for number in range(kills):
        before = progress()
        process = start(module, arguments)
        while progress() <= before:
            assert process.poll() is None, f"life {number} ended by itself at {progress()}, code {process.returncode}"
            time.sleep(0.02)
        time.sleep(rng.uniform(0, 2))
        if process.poll() is not None:  # it was faster than the executioner
            print(f"{module}: finished after {number} kills", flush=True)
            assert process.returncode == 0
            return at_kill
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        at_kill.append(progress())
        assert at_kill[-1] > before
        print(f"{module}: kill {number + 1} at {at_kill[-1]}", flush=True)
    assert start(module, arguments).wait() == 0
    return at_kill


def digest(folder: Path, pattern: str) -> dict[str, str]:
    """Name -> hash of the files of a folder."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.rglob(pattern))}


def collector(out: Path, kills: int, rng: random.Random) -> dict[str, object]:
    """Two workers on the tabletop; an episode is a shard."""
    arguments = ["--episodes", str(3 * kills + 6), "--steps", "60", "--workers", "2", "--seed", "3", "--out"]
    killed, peaceful = out / "collected", out / "collected-in-peace"
    at = kill_often(
        "data_collection.collect",
        [*arguments, str(killed)],
        lambda: len(list(killed.glob("shard-*.h5"))),
        kills,
        rng,
    )
    assert start("data_collection.collect", [*arguments, str(peaceful)]).wait() == 0
    same = digest(killed, "shard-*.h5") == digest(peaceful, "shard-*.h5")
    assert same, "the shards are not those of an undisturbed run"
    return {"kills": len(at), "shards": 3 * kills + 6, "shards_at_kills": at, "identical": same}


def trainer(out: Path, kills: int, rng: random.Random) -> dict[str, object]:
    """The tiny preset, a checkpoint every five steps; the data are those of the collector."""
    data = str(out / "collected")
    steps = 20 * kills + 20
    arguments = ["--preset", "tiny", "--data", data, "--steps", str(steps), "--validate-every", str(steps), "--out"]
    killed, peaceful = out / "trained", out / "trained-in-peace"

    def saved() -> int:
        return max((int(path.name[5:]) for path in (killed / "checkpoints").glob("step-????????")), default=0)

    at = kill_often("worldmodel.train", [*arguments, str(killed)], saved, kills, rng)
    assert start("worldmodel.train", [*arguments, str(peaceful)]).wait() == 0
    same = digest(killed / "model", "*.safetensors") == digest(peaceful / "model", "*.safetensors")
    assert same, "the weights are not those of an undisturbed run"
    return {"kills": len(at), "steps": steps, "saved_step_at_kills": at, "identical": same}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--out", type=Path, default=Path("build/endurance"))
    options = parser.parse_args()
    shutil.rmtree(options.out, ignore_errors=True)
    options.out.mkdir(parents=True)
    rng = random.Random(0)
    report = {"collector": collector(options.out, options.kills, rng)}
    report["trainer"] = trainer(options.out, options.kills, rng)
    (options.out / "endurance.json").write_text(json.dumps(report, indent=2) + "\n")
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
