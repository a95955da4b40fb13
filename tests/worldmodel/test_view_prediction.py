"""`view-prediction`: figure, film and recording show the prediction beside the truth; mistakes are one line."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from data_collection.dataset import RGBDDataset
from envs import ground_truth
from envs.command import run
from worldmodel import models as kinds
from worldmodel.checkpoint import save_model
from worldmodel.clips import Clips, ClipSource, ClipTruth
from worldmodel.colours import INK, PALETTE, PAPER, full_length, mask_colours, rgb_colours
from worldmodel.figure import film, sheet
from worldmodel.legends import legend
from worldmodel.pictures import Shown, predict, storyboard
from worldmodel.view_prediction import ViewOptions, labels, main

EPISODE, FRAMES = 1, 5  # the longest of the tiny dataset, 20 frames
FRAME_SECONDS = 0.1


class Clip(NamedTuple):
    row: int
    clips: Clips
    truth: ClipTruth
    models: list[Shown]


@pytest.fixture
def make_rival(make_model):
    def build(kind="sv2p", **config):
        like = make_model(**config)
        torch.manual_seed(1)
        return kinds.make_model(kind, like.config, like.context).eval()

    return build


@pytest.fixture
def model_folder(make_model, tmp_path):
    save_model(make_model(), tmp_path / "space", {})
    return tmp_path / "space"


@pytest.fixture
def rival_folder(make_rival, tmp_path):
    save_model(make_rival(), tmp_path / "pictures", {})
    return tmp_path / "pictures"


@pytest.fixture
def shown(make_model, make_rival, source):
    """The clip whose last step moves the most, its truth, and both kinds of model on it."""
    starts = source.starts(FRAMES)
    rows = starts[[int(source.truth_at(starts, FRAMES).scene_flow[:, 3, :2].abs().amax((1, 2, 3)).argmax())]]
    clips = source.at(rows, FRAMES)
    both = [predict("cloud", make_model(), clips, 2), predict("rival", make_rival(), clips, 2, samples=2)]
    return Clip(rows[0], clips, source.truth_at(rows, FRAMES), both)


def view(data, models, out, *more):
    clip = ("--context", "2", "--predicted", "3", "--episode", str(EPISODE))
    given = () if "--models" in more else ("--models", *map(str, models))
    given += () if "--out" in more else ("--out", *map(str, out if isinstance(out, list) else [out]))
    run(ViewOptions, main, ["--data", str(data), *given, *clip, *more])


def places(page, picture):
    """Where in a page a picture stands, as (row, column) of its upper left pixels."""
    height, width = picture.shape[:2]
    corners = np.argwhere((page[: 1 - height, : 1 - width] == picture[0, 0]).all(-1))
    return [(y, x) for y, x in corners.tolist() if (page[y : y + height, x : x + width] == picture).all()]


def test_storyboard_has_what_each_model_knows(shown):
    _, clips, truth, both = shown
    board = storyboard(clips, truth, 2, both, FRAME_SECONDS)
    rows = [(strip.section, strip.source) for strip in board.strips]
    assert rows == [
        ("RGB", "truth"),
        ("RGB", "cloud"),
        ("RGB", "rival"),
        ("RGB", "rival, sample 1"),
        ("RGB", "rival, sample 2"),
        ("depth", "truth"),
        ("depth", "cloud"),
        ("masks", "cloud"),
        ("masks", "rival"),
        *((section, who) for section in ("scene flow", "optical flow", "occlusion") for who in ("truth", "cloud")),
    ]
    for strip in board.strips:
        seen_too = strip.source == "truth" and strip.section in ("RGB", "depth")
        assert [picture is not None for picture in strip.pictures] == [seen_too] * 2 + [True] * 3, strip.section
    assert [row[1] for row in rows if row[0] == "occlusion"] == ["truth", "cloud"]
    assert len(storyboard(clips, None, 2, both, FRAME_SECONDS).strips) == len(rows) - 3
    assert len(storyboard(clips, truth, 2, both[1:], FRAME_SECONDS).strips) == 5


def test_storyboard_pictures_are_those_of_their_frame(shown, source):
    row, clips, truth, both = shown
    strips = {
        (strip.section, strip.source): strip.pictures
        for strip in storyboard(clips, truth, 2, both, FRAME_SECONDS).strips
    }
    motion = ground_truth.motion(
        source.dataset.camera,
        clips.depth[0, 3, 0],
        truth.bodies[0, 3],
        *source.dataset.load("body_pose")[row + np.array([9, 12])],
    )
    assert motion.disocclusion.any()
    assert (strips["occlusion", "truth"][4] == np.where(motion.disocclusion, INK, PAPER)[..., None]).all()
    assert (strips["RGB", "rival"][4] == rgb_colours(both[1].predictions[3].rgb[0])).all()
    assert (strips["RGB", "rival, sample 2"][3] == rgb_colours(both[1].samples[1, 1])).all()
    assert (both[1].samples[0] - both[1].samples[1]).abs().max() > 1e-4
    still = truth.bodies[0, 3] == 0
    assert (strips["optical flow", "truth"][4][still] == 255).all()
    assert (strips["optical flow", "truth"][4][~still] < 255).any()


def test_figure_puts_every_picture_in_its_row_and_column(shown):
    _, clips, truth, both = shown
    board = storyboard(clips, truth, 2, both, FRAME_SECONDS)
    page = sheet(board, 2, 2)
    assert (page[:, 0] == 255).all() and (page[0] == 255).all()  # no text is cut off
    frames = [rgb_colours(clips.rgb[0, t]).repeat(2, 0).repeat(2, 1) for t in range(FRAMES)]
    found = [places(page, frame) for frame in frames]
    assert [len(where) for where in found] == [0, 1, 0, 1, 1]  # two of three predicted columns, up to the last
    (top, first), (_, second), (_, third) = (found[t][0] for t in (1, 3, 4))
    assert found[3][0][0] == found[4][0][0] == top
    assert second - first == third - second > 48
    predicted = rgb_colours(both[0].predictions[3].rgb[0]).repeat(2, 0).repeat(2, 1)
    assert [third] == [column for row, column in places(page, predicted) if top + 32 <= row < top + 50]


def test_film_shows_all_frames_one_after_the_other(shown):
    _, clips, truth, both = shown
    pages = list(film(storyboard(clips, truth, 2, both, FRAME_SECONDS), 1))
    assert len(pages) == FRAMES and pages[0].shape[0] % 2 == pages[0].shape[1] % 2 == 0
    seen = places(pages[0], rgb_colours(clips.rgb[0, 0]))
    assert len(seen) == 5  # the truth, two models and two samples start from the same
    assert len(places(pages[4], rgb_colours(both[1].samples[0, 2]))) == 1


def test_command_writes_figure_and_film(tiny_dataset, model_folder, rival_folder, tmp_path, capsys):
    out = [tmp_path / "new" / "a.png", tmp_path / "new" / "a.mp4"]
    view(tiny_dataset, [model_folder, rival_folder], out, "--samples", "1", "--scale", "2")
    assert "space, pictures: 3 predicted frames" in capsys.readouterr().out
    figure, video = imageio.imread(out[0]), imageio.imread(out[1])
    assert np.ptp(figure) == 255 and len(video) == 2 * (FRAMES + 2 * 5)  # at 5 frames a second, ends held for one
    assert np.abs(video[0].astype(float) - video[-1]).max() > 50
    assert sorted(path.name for path in out[0].parent.iterdir()) == ["a.mp4", "a.png"]


def test_time_is_told_by_the_data(write_dataset, rival_folder, tmp_path):
    """At half the control rate that the model was trained at, frames are twice as far apart."""
    view(write_dataset(tmp_path / "slow", control_rate=15.0), [rival_folder], tmp_path / "a.mp4", "--scale", "1")
    video = imageio.imread(tmp_path / "a.mp4")
    assert len(video) == 4 * (FRAMES + 2 * 2)  # 2.5 frames a second, ends held for 2 frames


def test_sections_can_be_chosen(tiny_dataset, model_folder, rival_folder, tmp_path, capsys):
    heights = []
    for sections in ((), ("--sections", "rgb", "scene-flow")):
        view(tiny_dataset, [model_folder], tmp_path / "a.png", "--scale", "1", *sections)
        heights.append(len(imageio.imread(tmp_path / "a.png")))
    assert heights[0] - heights[1] == (2 + 1 + 2 + 2) * 16 + 3 * 3 + 4 * 12  # rows, gaps in sections, gaps between
    with pytest.raises(SystemExit):
        view(tiny_dataset, [rival_folder], tmp_path / "a.png", "--sections", "occlusion")
    assert "have RGB, masks; choose of them" in capsys.readouterr().err


def test_start_and_seed_decide_the_clip(tiny_dataset, rival_folder, tmp_path, capsys):
    def line(*more):
        view(tiny_dataset, [rival_folder], tmp_path / "a.png", "--scale", "1", *more)
        return capsys.readouterr().out, imageio.imread(tmp_path / "a.png")

    (said, first), (_, other) = line("--start", "1"), line("--start", "6")
    assert f"episode {EPISODE} from step 1" in said
    assert (first != other).any()
    drawn = [line("--seed", str(seed)) for seed in (1, 1, 2, 3)]
    assert drawn[0][0] == drawn[1][0] and len({said for said, _ in drawn}) > 1


def test_an_episode_that_is_drawn_is_long_enough_for_the_start(tiny_dataset, rival_folder, tmp_path, capsys):
    line = ["--data", tiny_dataset, "--models", rival_folder, "--out", tmp_path / "a.png", "--predicted", 3]
    for seed in range(4):  # only one of six episodes has a clip of 13 control steps from step 7
        run(ViewOptions, main, list(map(str, [*line, "--start", 7, "--seed", seed])))
        assert f"episode {EPISODE} from step 7" in capsys.readouterr().out


def test_model_is_the_same_option_as_models(tiny_dataset, model_folder, tmp_path):
    out = str(tmp_path / "a.png")
    run(
        ViewOptions, main, ["--data", str(tiny_dataset), "--model", str(model_folder), "--out", out, "--predicted", "2"]
    )
    assert (tmp_path / "a.png").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--episode", "99"), "--episode is 99"),
        (("--episode", "-1"), "--episode is -1"),
        (("--start", "1000"), "--start is 1000"),
        (("--predicted", "1000"), "episode 1 has 20 frames"),
        (("--out", "picture.jpg"), "picture.jpg"),
        (("--speed", "0"), "--speed is 0"),
        (("--speed", "inf"), "--speed is inf"),
        (("--models", "/nowhere"), "/nowhere"),
        (("--data", "/nowhere"), "/nowhere"),
    ],
)
def test_mistakes_are_one_line(tiny_dataset, model_folder, tmp_path, capsys, arguments, message):
    with pytest.raises(SystemExit) as end:
        view(tiny_dataset, [model_folder], tmp_path / "picture.png", *arguments)
    error = capsys.readouterr().err
    assert end.value.code == 2 and message in error and error.count("\n") == 1


def test_models_that_do_not_fit_are_refused(
    write_dataset, camera_of, make_rival, tiny_dataset, model_folder, tmp_path, capsys
):
    wide = write_dataset(tmp_path / "wide", (20, 20), camera_of(32, 16))
    other = make_rival("cdna", latents="none")
    other.context = replace(other.context, frame_gap=1)
    save_model(other, tmp_path / "other", {})
    for data, models, more, message in (
        (wide, [model_folder], (), "image size (16, 32)"),
        (tiny_dataset, [model_folder, tmp_path / "other"], (), "different frame gaps"),
        (tiny_dataset, [tmp_path / "other"], ("--samples", "2"), "no latents"),
    ):
        with pytest.raises(SystemExit):
            view(data, models, tmp_path / "picture.png", *more)
        assert message in capsys.readouterr().err


def test_labels_are_short_and_tell_models_apart(model_folder, tmp_path):
    assert labels(["t3vip", str(model_folder)]) == {"t3vip": "T3VIP", str(model_folder): "space"}
    runs = [str(tmp_path / run / "x" / "model") for run in ("a", "b")]
    assert labels(runs) == {run: run for run in runs}
    assert labels([str(tmp_path / "truth")]) == {str(tmp_path / "truth"): "model truth"}


def test_colours_mean_what_the_legends_say(shown):
    masks = torch.zeros(4, 1, 4)
    masks[[0, 1, 2, 3], 0, [0, 1, 2, 3]] = 1
    painted = mask_colours(masks, painted=(3,))[0]
    assert painted[[0, 3], 0].tolist() == [PAPER, INK]
    assert np.allclose(painted[1:3], 255 * PALETTE[:2], atol=0.51)
    flow = torch.zeros(3, 10, 10)
    assert full_length(flow, 0.001) == pytest.approx(0.01)
    flow[0] = 0.043
    assert full_length(flow, 0.001) == pytest.approx(0.05)
    _, clips, truth, both = shown
    unknown = storyboard(clips, None, 2, both, FRAME_SECONDS).scales  # an untrained model's noise is no motion
    assert unknown.scene_flow >= 0.01 and unknown.optical_flow >= 1.0
    board = storyboard(clips, truth, 2, both, FRAME_SECONDS)
    for section in board.sections:
        drawn = legend(section, board.scales, 128, 128)
        assert (drawn is None) == (section == "RGB")
        assert drawn is None or np.ptp(np.asarray(drawn)) > 50


def test_recording_holds_true_and_predicted_clouds(tiny_dataset, model_folder, rival_folder, tmp_path):
    rerun = pytest.importorskip("rerun")
    out = tmp_path / "a.rrd"
    view(tiny_dataset, [model_folder, rival_folder], out, "--start", "2")
    assert [path.name for path in tmp_path.glob("a.*")] == ["a.rrd"]
    table = rerun.dataframe.load_recording(out).view(index="step", contents="/**").select().read_all()
    assert table["step"].to_pylist() == [-1, 0, 1, 2, 3]
    dataset = RGBDDataset(tiny_dataset)
    clips = ClipSource(dataset, 3).at(np.array([dataset.episode_slices[EPISODE, 0] + 2]), FRAMES)
    points = dataset.camera.to_world(dataset.camera.unproject(clips.depth[0, 2, 0].numpy())).reshape(-1, 3)
    recorded = table["/world/truth/points:Position3D"].to_pylist()
    assert np.allclose(recorded[2], points, atol=1e-5)
    predicted = table["/world/predicted/space/points:Position3D"].to_pylist()
    assert predicted[0] is None and np.allclose(predicted[1], recorded[1]) and len(predicted[4]) > 0
    arrows = table["/world/truth/flow:Vector3D"].to_pylist()
    assert [bool(vectors) for vectors in arrows] == [True] * 4 + [False]
    assert [bool(way) for way in table["/world/truth/tcp:LineStrip3D"].to_pylist()] == [False] + [True] * 4
    assert "/pictures/predicted/pictures:ImageBuffer" in table.column_names
    assert not any(name.startswith("/world/predicted/pictures") for name in table.column_names)


def test_a_missing_viewer_or_display_is_said_before_any_work(model_folder, tmp_path, capsys, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setitem(sys.modules, "rerun", type(sys)("rerun"))
    with pytest.raises(SystemExit):
        run(ViewOptions, main, ["--data", "/nowhere", "--models", str(model_folder), "--view"])
    assert "--view needs a display" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(SystemExit):
        view("/nowhere", [model_folder], tmp_path / "a.rrd")
    assert "pip install --constraint constraints.txt --editable '.[viewer]'" in capsys.readouterr().err


def test_view_opens_the_viewer_on_a_recording(tiny_dataset, rival_folder, capsys, monkeypatch):
    pytest.importorskip("rerun")
    opened = []

    def viewer(command):
        opened.append((command[:-1], Path(command[-1]).read_bytes()[:4]))
        return subprocess.CompletedProcess(command, 1)

    monkeypatch.setenv("DISPLAY", ":7")
    monkeypatch.setattr(subprocess, "run", viewer)
    given = ["--data", str(tiny_dataset), "--models", str(rival_folder), "--predicted", "2", "--view"]
    with pytest.raises(SystemExit):
        run(ViewOptions, main, given)
    assert opened == [([sys.executable, "-m", "rerun_cli"], b"RRF2")]
    assert "the Rerun viewer ended with code 1" in capsys.readouterr().err
