"""What two processes do together, for test_ddp: `torchrun ddp_program.py DATA OUT OPTIONS`.

They train a run of their own, go on with one that a single process began, and write what else they saw as JSON.
"""

import json
import sys
from pathlib import Path

import torch

from data_collection.dataset import RGBDDataset
from envs.errors import UsageError
from worldmodel.clips import Clips, ClipSource
from worldmodel.held_out import ValidationSet
from worldmodel.ranks import Ranks, join_ranks
from worldmodel.train import parse_options, train_with
from worldmodel.trainer import Trainer

sys.path.insert(0, str(Path(__file__).parent))


def refused(work):
    try:
        work()
    except UsageError as error:
        return str(error)
    return None


def absent():
    raise UsageError("the first found nothing")


def spoiled_step(ranks: Ranks, data: Path, out: Path):
    """A clip of the second process is no number: was the step skipped by this one, too?"""
    from conftest import build_model

    source = ClipSource(RGBDDataset(data), 3)
    options = parse_options(["--preset", "tiny", "--data", str(data), "--out", str(out)])
    trainer = Trainer(build_model(), options, source, ValidationSet(source, 2, 4, 2, 2), {}, ranks)
    before = {name: value.clone() for name, value in trainer.model.state_dict().items()}
    clips = trainer.next_clips()
    if ranks.index == 1:
        clips = Clips(clips.rgb * torch.nan, clips.depth, clips.actions)
    trainer.update(clips)
    same = all(torch.equal(value, before[name]) for name, value in trainer.model.state_dict().items())
    return {"skipped": same, "bad_steps": trainer.bad_steps, "clips": len(clips.rgb)}


if __name__ == "__main__":
    data, out = Path(sys.argv[1]), Path(sys.argv[2])
    with join_ranks("cpu") as ranks:
        for run in ("together", "continued"):
            train_with(ranks, parse_options(["--data", str(data), "--out", str(out / run), *sys.argv[3:]]))
        seen = {
            "any": [ranks.any(ranks.index == 1), ranks.any(False)],
            "decided": ranks.decide(lambda: f"as {ranks.index} says"),
            "refused": refused(lambda: ranks.decide(absent)),
            "elsewhere": refused(lambda: ranks.begin_alike([], ranks.index)),
            **spoiled_step(ranks, data, out / "spoiled"),
        }
        (out / f"rank-{ranks.index}.json").write_text(json.dumps(seen))
