"""Motion that is true gets full marks; motion that is wrong by a known amount gets the marks it must."""

import pytest
import torch

from worldmodel.motion_scores import Motion, motion_statistics, no_motion, predicted_motion, true_motion
from worldmodel.rollout import unroll
from worldmodel.scores import join, score_clips

CONTEXT, FRAMES = 2, 4


@pytest.fixture
def known(source):
    starts = source.spread(4, FRAMES)
    clips, truth = source.at(starts, FRAMES), source.truth_at(starts, FRAMES)
    return clips, truth, true_motion(source.dataset.camera, clips, truth, CONTEXT)


def scores(predicted, motion, hand):
    statistics = join([motion_statistics(predicted, motion, hand)])
    return score_clips(statistics, torch.arange(len(hand)).numpy())


def test_the_truth_gets_full_marks_and_stillness_none(known):
    _, truth, motion = known
    hand = truth.hand[:, CONTEXT - 1 :]
    full, none = scores(motion, motion, hand), scores(no_motion(motion), motion, hand)
    for name in ("flow3d_epe_moving", "flow3d_epe_hand_relative", "flow2d_epe_moving", "false_flow_m"):
        assert full[name] == 0, name
    assert full["disocclusion_f1"] == full["motion_ari"] == full["body_ari"] == 1
    assert none["flow3d_epe_moving_relative"] == 1 and none["false_flow_m"] == 0
    assert none["disocclusion_f1"] == none["motion_ari"] == none["body_ari"] == 0


def test_errors_count_on_moving_pixels_in_metres_and_in_pixels(known):
    _, truth, motion = known
    off = Motion(
        motion.scene_flow + torch.tensor([0.0, 0.003, 0.004]).view(3, 1, 1),
        motion.optical_flow + torch.tensor([0.6, 0.8]).view(2, 1, 1),
        torch.ones_like(motion.disocclusion),
        motion.parts + 5 * (motion.parts > 0),  # other names, the same parts
    )
    result = scores(off, motion, truth.hand[:, CONTEXT - 1 :])
    assert result["flow3d_epe_moving"] == result["flow3d_epe_hand"] == pytest.approx(0.005, rel=1e-4)
    assert result["false_flow_m"] == pytest.approx(0.005, rel=1e-4)
    assert result["flow2d_epe_moving"] == pytest.approx(1, rel=1e-4)
    share = float(motion.disocclusion.double().mean())
    assert result["disocclusion_f1"] == pytest.approx(2 * share / (1 + share)) and result["body_ari"] == 1
    assert "flow3d_epe_moving" not in result["curves"]


def test_the_hand_counts_where_it_moves_and_a_frame_at_rest_says_nothing_of_parts(known):
    _, truth, motion = known
    everywhere = torch.ones_like(truth.hand[:, CONTEXT - 1 :])
    none = scores(no_motion(motion), motion, everywhere)
    assert none["flow3d_epe_hand"] == pytest.approx(none["flow3d_epe_moving"])
    hand = everywhere.clone()
    hand[..., :12] = False  # half of the picture
    assert scores(no_motion(motion), motion, hand)["flow3d_epe_hand_relative"] == pytest.approx(1)
    rested = Motion(motion.scene_flow, motion.optical_flow, motion.disocclusion, motion.parts.clone())
    rested.parts[:, 1] = 0
    rested.parts[:, 1, 0, :15] = 1  # too few to tell
    statistics = motion_statistics(no_motion(motion), rested, everywhere)
    assert (statistics["frames_in_motion"] == 1).all()
    assert scores(motion, rested, everywhere)["body_ari"] == 1
    slow = torch.zeros_like(motion.scene_flow)
    slow[:, 0, 0] = 0.002  # metres: neither moving nor still
    statistics = motion_statistics(motion, Motion(slow, *list(vars(motion).values())[1:]), everywhere)
    assert (statistics["still"] == 16 * 24).all() and not statistics["moving"].any()


def test_the_models_own_motion_is_read_as_it_is(known, make_model):
    clips, _, motion = known
    rollout = unroll(make_model(), clips, CONTEXT, truth=1.0)
    predicted = predicted_motion(rollout, CONTEXT)
    for ours, theirs in zip(vars(predicted).values(), vars(motion).values(), strict=True):
        assert ours.shape == theirs.shape and ours.dtype == theirs.dtype
    assert torch.equal(predicted.scene_flow[:, 0], rollout.predictions[CONTEXT - 1].scene_flow)
    still = predicted_motion(unroll(make_model(), clips, CONTEXT, truth=1.0, still=True), CONTEXT)
    assert not still.parts.any() and predicted.parts.any()
