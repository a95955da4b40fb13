"""Clips against the rows they come from, and the truth about them against the motion that made them."""

import h5py
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from data_collection.actions import aggregate_actions
from data_collection.dataset import RGBDDataset
from envs.errors import UsageError
from worldmodel.clips import FOLLOWING_SECONDS, Clips, ClipSource, usual_column
from worldmodel.colour_jitter import ColourJitter
from worldmodel.geometry import pixel_rays, project
from worldmodel.splatting import splat

GAP, FRAMES = 3, 4


@pytest.fixture(scope="module")
def dataset(tiny_dataset):
    return RGBDDataset(tiny_dataset)


@pytest.fixture(scope="module")
def starts(source):
    return source.starts(FRAMES)


def test_frames_are_a_gap_apart(source, dataset, starts):
    clips = source.at(starts, FRAMES)
    rgb, depth = dataset.load("rgb"), dataset.load("depth")
    assert clips.rgb.shape == (len(starts), FRAMES, 3, 16, 24) and clips.depth.shape == (len(starts), FRAMES, 1, 16, 24)
    for t in range(FRAMES):
        rows = starts + GAP * t
        np.testing.assert_array_equal((255 * clips.rgb[:, t]).round().permute(0, 2, 3, 1).numpy(), rgb[rows])
        metres = 1.0 + depth[rows] * (2.0 / 65535)
        np.testing.assert_allclose(clips.depth[:, t, 0], metres, atol=1e-5)


def test_actions_in_between_are_added_up_and_none_is_dropped(source, dataset, starts):
    clips, raw, attrs = source.at(starts, FRAMES), dataset.load("action"), dataset.attrs
    for clip, start in zip(clips.actions.numpy(), starts, strict=True):
        for t in range(FRAMES - 1):
            rows = raw[start + GAP * t : start + GAP * (t + 1)]
            expected = aggregate_actions(rows, attrs["action_aggregation"], attrs["action_scale"])
            np.testing.assert_allclose(clip[t], expected, atol=1e-6)
            np.testing.assert_allclose(clip[t, :3], rows[0, :3] + rows[1, :3] + rows[2, :3], atol=1e-5)
            assert clip[t, 6] == rows[2, 6]
    assert clips.actions.abs().max() > 1  # in the dataset's units, not an average


@pytest.mark.parametrize("gap", [1, 3, 5])
def test_no_clip_crosses_episodes_and_none_is_missed(dataset, gap):
    source, span = ClipSource(dataset, gap), (FRAMES - 1) * gap + 1
    episode = np.repeat(np.arange(dataset.episodes), dataset.episode_lengths)
    starts = source.starts(FRAMES)
    assert (episode[starts] == episode[starts + span - 1]).all()
    rows = np.arange(len(episode) - span + 1)
    assert starts.tolist() == rows[episode[rows] == episode[rows + span - 1]].tolist()


def test_train_and_held_out_episodes_are_apart(dataset):
    train = ClipSource(dataset, GAP, slice(0, 5))
    held_out = ClipSource(dataset, GAP, slice(5, None), share=train)
    last = dataset.episode_slices[5, 0]
    assert train.starts(FRAMES).max() + GAP * (FRAMES - 1) < last <= held_out.starts(FRAMES).min()
    assert torch.equal(held_out.at(np.array([last]), 2).rgb, train.at(np.array([last]), 2).rgb)


def test_the_same_seed_and_step_give_the_same_clips(source):
    def draw(*seed):
        return source.sample(np.random.default_rng(seed), 6, FRAMES)

    first, again, other = draw(0, 7), draw(0, 7), draw(0, 8)
    for name in ("rgb", "depth", "actions"):
        assert torch.equal(getattr(first, name), getattr(again, name))
        assert not torch.equal(getattr(first, name), getattr(other, name))


def test_spread_covers_the_data_evenly(source, starts):
    chosen = source.spread(5, FRAMES)
    assert chosen[0] == starts[0] and chosen[-1] == starts[-1] and (np.diff(chosen) > 0).all() and len(chosen) == 5
    assert source.spread(1000, FRAMES).tolist() == starts.tolist()


@pytest.mark.parametrize("gap", [1, 3])
def test_true_flow_is_the_motion_of_the_square(dataset, gap):
    source = ClipSource(dataset, gap)
    starts = source.spread(6, FRAMES)
    truth, state, body = source.truth_at(starts, FRAMES), dataset.load("state"), dataset.load("segmentation")
    points = dataset.camera.unproject(source.at(starts, FRAMES).depth[:, :, 0].numpy())
    for b, start in enumerate(starts):
        for t in range(FRAMES - 1):
            (*centre, angle), (*later, turned) = state[start + gap * t], state[start + gap * (t + 1)]
            turn = Rotation.from_euler("z", turned - angle)
            on_square = body[start + gap * t] == 1
            cloud = points[b, t][on_square]
            flow = truth.scene_flow[b, t].permute(1, 2, 0).numpy()
            np.testing.assert_allclose(flow[on_square], turn.apply(cloud - centre) + later - cloud, atol=1e-4)
            assert not flow[~on_square].any()
            np.testing.assert_array_equal(truth.hand[b, t], on_square)
        tcp = state[start + gap * np.arange(FRAMES), :3]
        np.testing.assert_allclose(truth.tcp[b], tcp, atol=1e-5)
    assert truth.scene_flow.norm(dim=2).max() > 0.01


def test_the_next_frame_is_this_one_thrown_along_its_true_flow(dataset):
    """The clips, the truth, the geometry and the splatting speak of one world."""
    source = ClipSource(dataset, 8)  # far enough for a pixel or two
    starts = source.spread(12, 2)
    clips, truth = source.at(starts, 2), source.truth_at(starts, 2)
    K = torch.from_numpy(np.array(dataset.camera.K)).float()
    moved = clips.depth[:, 0] * pixel_rays(K, 16, 24) + truth.scene_flow[:, 0]
    values = torch.cat((clips.rgb[:, 0], moved[:, 2:]), dim=1)
    warped, coverage = splat(values, project(moved, K), moved[:, 2:])
    seen = coverage > 0.5
    for channels, target in ((slice(0, 3), clips.rgb), (slice(3, 4), clips.depth)):
        error = (warped[:, channels] - target[:, 1])[seen.expand_as(target[:, 1])].square().mean()
        copying = (target[:, 0] - target[:, 1])[seen.expand_as(target[:, 1])].square().mean()
        assert error < 0.5 * copying


def test_statistics_of_aggregated_actions(source, tmp_path, write_dataset):
    mean, std = source.action_statistics()
    actions = source.actions_at(source.starts(2), 2)[:, 0]
    np.testing.assert_allclose(mean, actions.mean(0), atol=1e-5)
    np.testing.assert_allclose(std, actions.std(0), atol=1e-5)
    folder = write_dataset(tmp_path, [12, 12])
    for shard in folder.glob("*.h5"):
        with h5py.File(shard, "r+") as file:
            file["action"][:, 6] = 1.0
            file["action"][:, 0] = 1e-4 * file["action"][:, 0]  # some small unit
    mean, std = ClipSource(RGBDDataset(folder), GAP).action_statistics()
    assert mean[6] == 1 and std[6] == 1  # never divides by zero
    assert 0 < std[0] < 1e-3


def test_joint_deltas_in_place_of_commands(tmp_path, write_dataset):
    folder = write_dataset(tmp_path, [12, 12])
    dataset = RGBDDataset(folder)
    with pytest.raises(UsageError, match="no column 'joint_delta'"):
        ClipSource(dataset, GAP, action_column="joint_delta")
    deltas = np.random.default_rng(0).normal(size=(12, 5)).astype(np.float32)
    for shard in folder.glob("*.h5"):
        with h5py.File(shard, "r+") as file:
            file["joint_delta"] = np.tile(deltas, (len(file["action"]) // 12, 1))
    commanded = ClipSource(RGBDDataset(folder), GAP)
    moved = commanded.with_actions("joint_delta")
    clips = moved.at(np.array([12]), 3)
    np.testing.assert_allclose(clips.actions[0, 1], deltas[3:6].sum(0), atol=1e-5)
    assert torch.equal(clips.rgb, commanded.at(np.array([12]), 3).rgb)
    assert moved.action_dim == 5 and commanded.action_dim == 7
    assert moved.with_actions("joint_delta") is moved


def test_changes_of_absolute_commands(tmp_path, write_dataset):
    relative = RGBDDataset(write_dataset(tmp_path / "relative", [12, 12]))
    with pytest.raises(UsageError, match="not all absolute"):
        ClipSource(relative, GAP, action_column="action_change")
    dataset = RGBDDataset(write_dataset(tmp_path / "absolute", [12, 12], action_aggregation=["last"] * 7))
    commands = dataset.load("action")
    changed = ClipSource(dataset, GAP, action_column="action_change")
    told = changed.at(np.array([12, 13]), 3).actions.numpy()
    assert changed.action_dim == 7 and changed.action_scale == ClipSource(dataset, GAP).action_scale
    np.testing.assert_allclose(told[0, 0], commands[14] - commands[12], atol=1e-6)  # an episode begins: from its first
    np.testing.assert_allclose(told[0, 1], commands[17] - commands[14], atol=1e-6)
    np.testing.assert_allclose(told[1, 0], commands[15] - commands[12], atol=1e-6)


def test_what_follows_absolute_commands_with_a_lag(tmp_path, write_dataset):
    relative = RGBDDataset(write_dataset(tmp_path / "relative", [12, 12]))
    with pytest.raises(UsageError, match="not all absolute"):
        ClipSource(relative, GAP, action_column="action_followed")
    assert usual_column(relative) == "action"
    dataset = RGBDDataset(write_dataset(tmp_path / "absolute", [12, 12], action_aggregation=["last"] * 7))
    assert usual_column(dataset) == "action"  # nothing is known of joints
    commands = dataset.load("action").astype(np.float64)
    share = 1 - np.exp(-1 / (dataset.attrs["control_rate"] * FOLLOWING_SECONDS))
    places = np.empty((25, 7))
    for episode in (0, 12):
        place = commands[episode]
        for step in range(episode, episode + 12):
            places[step] = place
            place = place + share * (commands[step] - place)
    told = ClipSource(dataset, GAP, action_column="action_followed").at(np.array([0, 12, 14]), 4).actions.numpy()
    for clip, start in enumerate((0, 12, 14)):
        np.testing.assert_allclose(told[clip], np.diff(places[start : start + 10 : GAP], axis=0), atol=1e-6)


def test_other_actions_are_of_the_same_episodes_and_joints_are_followed_if_they_are_known(tmp_path, write_dataset):
    folder = write_dataset(tmp_path, [12, 12, 12], action_aggregation=["last"] * 7)
    for shard in folder.glob("*.h5"):
        with h5py.File(shard, "r+") as file:
            file["joint_delta"] = np.zeros((len(file["action"]), 5), np.float32)
    dataset = RGBDDataset(folder)
    assert usual_column(dataset) == "action_followed"
    held_out = ClipSource(dataset, GAP, slice(2, None))
    assert held_out.with_actions("action_followed").starts(3).tolist() == held_out.starts(3).tolist()


def test_colour_jitter_changes_colours_only_and_whole_clips_alike(source, starts):
    clips = source.at(starts[:4], 2)
    still = torch.stack((clips.rgb[:, 0],) * 2, dim=1)
    jitter = ColourJitter.draw(4, 0.3, np.random.default_rng(0))
    changed = jitter.apply(Clips(still, clips.depth, clips.actions))
    assert changed.depth is clips.depth and changed.actions is clips.actions
    assert torch.equal(changed.rgb[:, 0], changed.rgb[:, 1])
    assert (changed.rgb - still).abs().flatten(1).mean(1).min() > 0.01
    assert changed.rgb.min() >= 0 and changed.rgb.max() <= 1
    of_two = jitter.share(slice(2, 4)).apply(Clips(still[2:], clips.depth[2:], clips.actions[2:]))
    assert torch.equal(of_two.rgb, changed.rgb[2:])


def test_clips_that_no_episode_can_hold_are_refused(source, dataset):
    with pytest.raises(UsageError, match=r"no episode is 22 frames long, as 8 frames at gap 3 need .* longest has 20"):
        source.starts(8)
    with pytest.raises(UsageError, match="frame-gap is 0; give 1"):
        ClipSource(dataset, 0)


def test_truth_needs_ground_truth(tmp_path, write_dataset):
    folder = write_dataset(tmp_path, [12])
    with h5py.File(folder / "shard-00000.h5", "r+") as file:
        del file["segmentation"]
    source = ClipSource(RGBDDataset(folder), GAP)
    with pytest.raises(UsageError, match="no column 'segmentation'"):
        source.truth_at(source.starts(2), 2)
