"""Scores against references, and the scores of models whose scores are known."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from worldmodel import clips
from worldmodel.clips import ClipSource
from worldmodel.colours import colour_wheel
from worldmodel.held_out import ValidationSet
from worldmodel.pictures import picture_prediction
from worldmodel.validation import summary, validate


@pytest.fixture
def validation(source):
    return ValidationSet(source, clips=5, frames=5, context=2, batch=2)


def test_only_an_arm_has_a_tcp_to_track(make_model, validation, monkeypatch):
    monkeypatch.setattr(clips, "ROBOT_OBS", 3)  # of some other robot than the one that the data is of
    scores = validate(make_model(), validation)
    assert "flow_error_moving" in scores and "tracking_error" not in scores
    assert "false flow" in summary(scores) and "tracking" not in summary(scores)


def test_what_nothing_moves_for_has_no_score(make_model, validation, monkeypatch):
    def truth_at(starts, frames):
        truth = ClipSource.truth_at(validation.source, starts, frames)
        return replace(truth, scene_flow=torch.zeros_like(truth.scene_flow), tcp=truth.tcp[:, :1].expand_as(truth.tcp))

    monkeypatch.setattr(validation.source, "truth_at", truth_at)
    scores = validate(make_model(), validation)
    assert "false_flow_m" in scores
    assert not {"flow_error_moving", "flow_error_hand", "tracking_error"} & scores.keys()
    assert "false flow" in summary(scores) and "nan" not in summary(scores)


def test_depth_that_stays_has_no_share_of_copyings(make_model, validation):
    scores = validate(make_model(), validation)
    still = scores | {"copy_depth_rmse": [0.0] * 3, "depth_rmse": [0.25] * 3}
    assert "of copying's" in summary(scores) and "depth RMSE 0.250 m" in summary(still)


def test_without_transforms_the_scores_are_those_of_copying(make_model, validation, monkeypatch):
    model = make_model()
    moving, predict = validate(model, validation), model.predict
    monkeypatch.setattr(model, "predict", lambda *given, **options: predict(*given, **(options | {"still": True})))
    still = validate(model, validation)
    assert still["psnr"] == pytest.approx(still["copy_psnr"], abs=0.02)
    assert still["depth_rmse"] == pytest.approx(still["copy_depth_rmse"], rel=1e-3)
    assert still["inpainted"] == 0 and still["false_flow_m"] < 1e-5
    for name in ("flow_error_moving", "flow_error_hand", "tracking_error"):
        assert still[name] == pytest.approx(1, abs=1e-3)
    assert moving["psnr"][0] < still["psnr"][0] - 1 and moving["inpainted"] > 0  # random motion is worse than none
    assert moving["copy_psnr"] == still["copy_psnr"]


def test_scores_do_not_depend_on_the_batches(make_model, source, validation):
    model = make_model().train()
    whole = validate(model, ValidationSet(source, clips=5, frames=5, context=2, batch=5))
    assert model.training
    for name, value in validate(model, validation).items():
        assert value == pytest.approx(whole[name], rel=1e-2), name
    assert len(whole["psnr"]) == 3 and "dB over copy" in summary(whole) and "tracking error" in summary(whole)
    json.dumps(whole, allow_nan=False)


def test_the_hue_is_the_direction():
    flow = torch.zeros(2, 1, 3)
    flow[0, 0, 1], flow[0, 0, 2] = 5.0, -5.0
    still, right, left = colour_wheel(flow, 5.0)[0].tolist()
    assert still == [255, 255, 255] and right == [255, 0, 0] and left == [0, 255, 255]


def test_a_picture_shows_each_predicted_frame(make_model, source, validation, tmp_path):
    import imageio.v3 as imageio

    clips, starts = next(validation.batches())
    truth = source.truth_at(starts[:1], validation.frames)
    picture_prediction(make_model(), clips, truth, 2, source.frame_seconds, tmp_path / "new" / "a.png", scale=1)
    sheet = imageio.imread(tmp_path / "new" / "a.png")
    windows = np.lib.stride_tricks.sliding_window_view(sheet, (16, 24, 3))[:, :, 0]
    for frame in clips.rgb[0, 1:]:
        picture = (255 * frame).round().byte().permute(1, 2, 0).numpy()
        assert (windows == picture).all((2, 3, 4)).any()
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.png"]
