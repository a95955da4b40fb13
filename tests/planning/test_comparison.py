"""Models against each other, from records made by hand."""

import json
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest

from planning.comparison import difference_table, differences, success_chart
from planning.film import film_path
from planning.filmstrip import filmstrip, telling
from planning.report import summarise, table
from tests.planning.servo_records import record

SHARES = (0.1, 0.3, 0.5, 0.8)  # of the way along the optical axis: one setup in each bin


def records(model, hits_3d, hits_2d):
    return [record(model, i, *values) for i, values in enumerate(zip(SHARES, hits_3d, hits_2d, strict=True))]


@pytest.fixture
def fleet():
    """T3VIP always arrives; SV2P always reaches the pixel, the point only across the optical axis."""
    return {
        "t3vip": records("t3vip", (1, 1, 1, 1), (1, 1, 1, 1)),
        "sv2p": records("sv2p", (1, 0, 0, 0), (1, 1, 1, 1)),
        "random": records("random", (0, 0, 0, 0), (0, 0, 0, 1)),
    }


def test_differences_are_paired_and_split_by_direction(fleet):
    entry = json.loads(json.dumps(differences(fleet)))["sv2p"]
    assert [entry[part]["episodes"] for part in ("all", "across", "along")] == [4, 2, 2]
    assert [entry[part]["difference_3d"] for part in ("all", "across", "along")] == [0.75, 0.5, 1.0]
    assert entry["all"]["only_t3vip_3d"] == 3 and entry["all"]["only_rival_3d"] == 0
    assert entry["all"]["p_3d"] == pytest.approx(2 * 0.5**3)
    low, high = entry["along"]["difference_3d_interval"]
    assert -1 <= low < 1 and high == 1  # of two pairs that fell out alike: no certainty
    assert entry["all"]["difference_2d"] == 0 and entry["all"]["p_2d"] == 1
    assert differences({"sv2p": fleet["sv2p"], "random": fleet["random"]}) == {}


def test_the_same_episodes_again_make_nothing_surer(fleet):
    """Repeats of controllers without randomness."""
    again = {
        name: [replace(record, repeat=repeat) for record in of_model for repeat in range(5)]
        for name, of_model in fleet.items()
    }
    once, often = differences(fleet)["sv2p"], differences(again)["sv2p"]
    for part, entry in often.items():
        for key in ("episodes", "only_t3vip_3d"):
            assert entry[key] == 5 * once[part][key]
        for key in ("difference_3d", "difference_3d_interval", "p_3d", "difference_2d_interval", "p_2d"):
            assert entry[key] == pytest.approx(once[part][key]), key
    once, often = summarise(fleet["sv2p"]), summarise(again["sv2p"])
    assert (often["episodes"], often["setups"], once["setups"]) == (20, 4, 4)
    for key in ("success_3d", "success_3d_interval", "success_2d_interval"):
        assert often[key] == pytest.approx(once[key])
        for part in ("across", "along"):
            assert often["by_axis_share"][part][key] == pytest.approx(once["by_axis_share"][part][key])


def test_a_part_without_setups_says_nothing(fleet):
    across = {name: of_model[:2] for name, of_model in fleet.items()}
    entry = differences(across)["sv2p"]["along"]
    assert entry["difference_3d"] is None and entry["difference_3d_interval"] == [-1, 1]
    assert " -  " in difference_table(differences(across))
    assert summarise(across["t3vip"])["by_axis_bin"][3]["success_3d"] is None


def test_summary_has_a_bin_for_every_share(fleet):
    bins = summarise(fleet["sv2p"])["by_axis_bin"]
    assert [part["episodes"] for part in bins] == [1, 1, 1, 1]
    assert [part["success_3d"] for part in bins] == [1, 0, 0, 0] and bins[2]["from"] == 0.5  # a bin has its lower bound
    assert all(0 <= part["success_2d_interval"][0] < 1 for part in bins)


def test_tables_and_chart(fleet, tmp_path):
    models = {name: summarise(of_model) for name, of_model in fleet.items()}
    assert len({len(line) for line in table(models).splitlines()}) == 1
    lines = difference_table(differences(fleet)).splitlines()
    assert len(lines) == 1 + 2 * 3 and "sv2p" in lines[1] and "+75" in lines[1]
    success_chart(models, tmp_path / "success.png", "title")
    assert iio.imread(tmp_path / "success.png").shape[1] > 1000
    part = {name: summarise(of_model[:2]) for name, of_model in fleet.items()}  # empty bins
    success_chart(part, tmp_path / "success.png", "title")


def test_the_most_telling_setup_is_a_reached_pixel_and_a_missed_point():
    ours = record("t3vip", 0, 0.5, 1, 1, final=0.01)
    reached, chance = record("sv2p", 0, 0.5, 0, 1, final=0.1), record("sv2p", 0, 0.5, 1, 1, final=0.01)
    lost, farther = record("sv2p", 0, 0.5, 0, 0, final=0.4), record("sv2p", 0, 0.5, 0, 1, final=0.2)
    away = record("sv2p", 0, 0.5, 0, 1, final=0.2, pixels=8.0)
    failed = record("t3vip", 0, 0.5, 0, 1, final=0.01)
    order = [(ours, farther), (ours, reached), (ours, away), (failed, farther), (ours, lost), (ours, chance)]
    assert sorted(order, key=telling, reverse=True) == order


def test_film_strip_shows_that_setup_at_common_times(fleet, tmp_path):
    for name, grey, lengths in (("t3vip", 60, (20, 20, 8, 20)), ("sv2p", 160, (20, 20, 30, 20))):
        for of_setup, length in zip(fleet[name], lengths, strict=True):
            frames = np.full((length, 32, 64, 3), grey, np.uint8)
            frames += (5 * np.arange(length)).clip(max=80).astype(np.uint8)[:, None, None, None]
            iio.imwrite(film_path(tmp_path, of_setup).with_suffix(".mp4"), frames, extension=".mp4", fps=15)
    filmed = {name: fleet[name] for name in ("t3vip", "sv2p")}
    filmed["sv2p"][2] = record("sv2p", 2, 0.5, 0, 1, final=0.3)
    assert filmstrip(tmp_path, filmed, tmp_path / "filmstrip.png")
    strip = iio.imread(tmp_path / "filmstrip.png").astype(int)
    assert strip.shape == (2 * 64 + 6, 5 * 32, 3)  # a model's two views of 32 x 32 on top of each other
    ours, theirs = strip[10, ::32, 0], strip[80, ::32, 0]
    assert abs(ours[0] - 60) < 8 and abs(theirs[0] - 160) < 8
    assert abs(ours[-1] - 95) < 8 and abs(theirs[-1] - 240) < 8  # the shorter film stays at its last frame
    assert theirs[2] < 230  # columns are moments, close together at first


def test_no_strip_without_common_films(fleet, tmp_path):
    assert not filmstrip(tmp_path, {name: fleet[name] for name in ("t3vip", "sv2p")}, tmp_path / "filmstrip.png")
    assert not (tmp_path / "filmstrip.png").exists()
