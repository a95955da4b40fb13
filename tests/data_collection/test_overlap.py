"""Episodes that two datasets share are found, whatever else was recorded with them and however they are cut up."""

import numpy as np
import pytest
from shards import ATTRS, make_episode

from data_collection.dataset import RGBDDataset
from data_collection.overlap import shared_episodes
from data_collection.schema import GROUND_TRUTH
from data_collection.writer import write_shard


@pytest.fixture
def episodes():
    rng = np.random.default_rng(0)
    return [make_episode(rng, rows, ground_truth=True) for rows in (5, 6, 7, 5)]


@pytest.fixture
def write(tmp_path):
    def dataset(name, episodes, **attrs):
        (tmp_path / name).mkdir()
        write_shard(tmp_path / name / "shard-00000.h5", episodes, ATTRS | attrs, range(len(episodes)))
        return RGBDDataset(tmp_path / name)

    return dataset


def blind(episode):
    return {name: values for name, values in episode.items() if name not in GROUND_TRUTH}


def test_a_part_of_a_dataset_is_known_without_its_ground_truth_and_in_any_order(write, episodes):
    whole = write("whole", [blind(episode) for episode in episodes[:3]], seed=1)
    part = write("part", [episodes[3], episodes[2], episodes[0]], seed=2)
    assert shared_episodes(whole, part) == [1, 2]
    assert shared_episodes(part, whole) == [0, 2]
    assert shared_episodes(whole, whole) == [0, 1, 2]
    assert shared_episodes(whole, write("other", episodes[3:])) == []


def test_the_same_moves_among_other_things_are_another_episode(write, episodes):
    moved = dict(episodes[0], depth=episodes[0]["depth"].copy())
    moved["depth"][-1, 0, 0] ^= 1
    assert shared_episodes(write("here", episodes[:2]), write("there", [moved, episodes[1]])) == [1]


def test_an_episode_is_found_among_several_of_the_same_moves(write, episodes):
    moved = dict(episodes[0], depth=episodes[0]["depth"].copy())
    moved["depth"][-1, 0, 0] ^= 1
    ours = write("ours", [episodes[0], moved, episodes[1]])
    assert shared_episodes(ours, write("first", [episodes[0]])) == [0]
    assert shared_episodes(ours, write("second", [moved])) == [0]
