"""Scores of pictures and segmentations against torchmetrics, and scores made of statistics against plain sums."""

import numpy as np
import pytest
import torch
from torchmetrics.functional.clustering import adjusted_rand_score
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

from worldmodel.metrics import adjusted_rand_index, relative_depth_error, squared_error, ssim
from worldmodel.scores import compare_clips, score_clips

EPISODES = np.array([0, 0, 1, 1, 2, 3])


@pytest.fixture
def pictures():
    generator = torch.Generator().manual_seed(0)
    target = torch.rand((6, 3, 3, 16, 24), generator=generator)
    return (target + 0.2 * torch.randn(target.shape, generator=generator)).clamp(0, 1), target


def test_ssim_is_that_of_torchmetrics(pictures):
    predicted, target = (x.flatten(0, 1) for x in pictures)
    reference = structural_similarity_index_measure(predicted, target, data_range=1.0, reduction="none")
    torch.testing.assert_close(ssim(predicted, target), reference, atol=1e-5, rtol=0)
    torch.testing.assert_close(ssim(target, target), torch.ones(18))


def test_psnr_and_rmse_of_clips_are_pooled_for_each_frame(pictures):
    predicted, target = pictures
    depth, true_depth = predicted[:, :, :1] + 1, target[:, :, :1] + 1
    statistics = {"se": squared_error(predicted, target), "depth_se": squared_error(depth, true_depth)}
    statistics["depth_absrel"] = relative_depth_error(depth, true_depth)
    scores = score_clips({name: value.double() for name, value in statistics.items()}, EPISODES)
    psnr = [float(peak_signal_noise_ratio(predicted[:, t], target[:, t], data_range=1.0)) for t in range(3)]
    assert scores["curves"]["psnr"] == pytest.approx(psnr, abs=1e-4)
    assert scores["psnr"] == pytest.approx(np.mean(psnr), abs=1e-4)
    rmse = [float((depth[:, t] - true_depth[:, t]).square().mean().sqrt()) for t in range(3)]
    assert scores["curves"]["depth_rmse"] == pytest.approx(rmse, rel=1e-5)
    absrel = float(((depth - true_depth).abs() / true_depth).mean())
    assert scores["depth_absrel"] == pytest.approx(absrel, rel=1e-5)
    assert scores["ssim"] is None and scores["vgg"] is None and "vgg" not in scores["curves"]


def test_intervals_come_from_resampling_episodes():
    def interval(values, episodes):
        scores = score_clips({"ssim": torch.tensor(values, dtype=torch.float64).unsqueeze(1)}, np.array(episodes))
        return scores["ssim"], scores["intervals"]["ssim"]

    clips = np.repeat(np.random.default_rng(0).normal(0.5, 0.1, 50), 20)
    mean, (low, high) = interval(clips, np.repeat(np.arange(50), 20))
    standard_error = clips[::20].std() / 50**0.5  # twenty equal clips of an episode say no more than one
    assert low < mean < high and high - low == pytest.approx(2 * 1.96 * standard_error, rel=0.15)
    assert interval([0.5, 0.5, 0.5], [0, 1, 2]) == (0.5, [0.5, 0.5])
    assert interval([0.5, 0.5, 0.5], [0, 0, 1]) == (0.5, [0.5, 0.5])  # a resample may hold more clips, or fewer
    assert interval([0.1, 0.9], [4, 4]) == (0.5, None)


def test_resamples_in_which_a_score_is_not_defined_do_not_count():
    moving = torch.tensor([[0.0], [4.0]], dtype=torch.float64)  # nothing moves in one of two episodes
    statistics = {"moving": moving, "moving_error": 0.5 * moving, "moving_length": moving, "moving_error_px": moving}
    assert score_clips(statistics, np.array([0, 1]))["intervals"]["flow3d_epe_moving"] == [0.5, 0.5]
    nothing = {name: torch.zeros_like(moving) for name in statistics}
    scores = score_clips(nothing, np.array([0, 1]))
    assert scores["flow3d_epe_moving"] is None and scores["intervals"]["flow3d_epe_moving"] is None


def test_differences_are_resampled_together():
    rng = np.random.default_rng(0)
    episodes, hard = np.arange(40), rng.normal(0.5, 0.2, 40)
    ours, theirs = ({"ssim": torch.from_numpy(hard + shift)[:, None]} for shift in (0.03, rng.normal(0, 0.01, 40)))
    result = compare_clips(ours, theirs, episodes)
    assert list(result) == ["ssim"]
    low, high = result["ssim"]["interval"]
    assert 0.02 < low < result["ssim"]["difference"] < high < 0.04
    apart = score_clips(ours, episodes)["intervals"]["ssim"]
    assert apart[0] < score_clips(theirs, episodes)["ssim"] < apart[1]  # which alone would not tell them apart


@pytest.mark.parametrize("parts", [(1, 2), (2, 2), (3, 5), (4, 1)])
def test_adjusted_rand_index_is_that_of_torchmetrics(parts):
    generator = torch.Generator().manual_seed(1)
    ours, noise = (torch.randint(count, (12, 9), generator=generator) for count in parts)
    for theirs in (noise, torch.where(noise > 0, ours, noise)):
        reference = float(adjusted_rand_score(ours.flatten(), theirs.flatten()))
        assert adjusted_rand_index(ours, theirs) == pytest.approx(reference, abs=1e-6)
    assert adjusted_rand_index(ours, 7 - ours) == pytest.approx(1)
