"""`inspect-dataset`: what is in a dataset, as a table, as JSON, as pictures; and its repair."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from data_collection.dataset import RGBDDataset
from data_collection.manifest import read_manifest
from data_collection.pictures import write_contact_sheet, write_film
from data_collection.repair import find_damage, repair
from data_collection.statistics import describe
from envs.command import run
from envs.errors import UsageError
from envs.files import write_json

REPORT_FOLDER = "inspection"


@dataclass(frozen=True)
class Config:
    """Say what is in a dataset; writes inspection.json, a contact sheet and a video into DIR/inspection."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """The dataset's folder."""
    repair: bool = False
    """First drop what is damaged: move it to DIR/damaged and say so."""
    verify: bool = True
    """Read every byte and compare with the checksums."""
    pictures: bool = True
    """Write the contact sheet and the video."""
    clips: int = 6
    """Episodes in the pictures, evenly spread over the dataset."""
    out: Path | None = None
    """Where the report goes; DIR/inspection when not given."""

    def __post_init__(self) -> None:
        if self.clips < 1:
            raise UsageError(f"--clips is {self.clips}; give a whole number of at least 1")


def main(config: Config) -> None:
    """Repair if asked, check, describe, draw."""
    if config.repair:
        done = repair(config.path)
        print("\n".join(done) if done else "nothing is damaged")
    dataset = RGBDDataset(config.path)
    if config.verify and not config.repair and (damage := find_damage(config.path)):
        more = f" (and {len(damage) - 1} more)" if len(damage) > 1 else ""
        raise UsageError(f"{damage[0]}{more}; drop it with: inspect-dataset {config.path} --repair")
    report = describe(dataset)
    manifest = read_manifest(config.path)
    if manifest is not None:
        report["episodes_asked_for"] = manifest.episodes
    folder = config.out or config.path / REPORT_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "inspection.json", report)
    print(table(report))
    if config.pictures:
        count = min(config.clips, dataset.episodes)
        chosen = np.linspace(0, dataset.episodes - 1, count).round().astype(int).tolist()
        write_contact_sheet(dataset, chosen, folder / "contact_sheet.png")
        write_film(dataset, chosen, folder / "episodes.mp4")
    print(f"report in {folder}")


def table(report: dict[str, Any]) -> str:
    """The report as lines for a terminal."""
    asked = report.get("episodes_asked_for", report["episodes"])
    steps = report["episode_steps"]
    lines = [
        f"environment   {report['env_id']}, policy {report['policy']}, seed {report['seed']}",
        f"episodes      {report['episodes']} of {asked}, {steps['min']} to {steps['max']} steps each",
        f"frames        {report['frames']} of {report['image_size'][0]}x{report['image_size'][1]}, "
        f"{report['hours']:g} h, {report['bytes'] / 1e6:.1f} MB",
        f"content hash  {report['content_hash']}",
        "made by       " + "; ".join(f"source {maker.get('source', 'unknown')}" for maker in report["versions"]),
        "",
        f"{'column':<14}{'shape':<22}{'dtype':<9}{'min':>12}{'max':>12}",
    ]
    for name, column in report["columns"].items():
        low, high = np.min(column["min"]), np.max(column["max"])
        lines.append(f"{name:<14}{column['shape']!s:<22}{column['dtype']:<9}{low:>12.4g}{high:>12.4g}")
    if "workspace" in report:
        reached = report["workspace"]
        lines += [
            "",
            f"workspace     {reached['share_of_cells_visited']:.0%} of its {reached['cell_m'] * 100:g} cm cells "
            f"visited, {reached['share_of_frames_inside']:.0%} of frames inside, evenness {reached['evenness']:.2f}",
        ]
    if "moved" in report:
        lines += ["", "share of episodes in which it moved"]
        lines += [f"  {name:<12}{share:>5.0%}" for name, share in report["moved"].items()]
    if "goals" in report:
        goals = report["goals"]
        steps = goals["median_steps_to_reach"]
        lines += [
            "",
            f"goals         {goals['given']}, {goals['reached']:.0%} reached"
            + (f" after {steps:g} steps (median)" if steps is not None else "")
            + f"; rotation error {goals['median_degrees_at_start']:.0f} degrees where they are given, "
            f"{goals['median_degrees_at_end']:.0f} where they end (medians); "
            f"{goals['episodes_dropped']:.0%} of episodes drop the cube",
        ]
    return "\n".join(lines)


def command() -> None:
    run(Config, main)
