"""The 70 objects to be pushed: all that there can be, and splits that share none."""

from __future__ import annotations

import hashlib
import itertools

from envs.planar_push import PlanarPushEnv, objects


def test_the_objects_are_all_necklaces():
    assert len(objects.OBJECTS) == len(set(objects.OBJECTS)) == 70
    for digits in itertools.product("1234", repeat=4):
        name = "".join(digits)
        rotations = {name[i:] + name[:i] for i in range(4)}
        assert len(rotations & set(objects.OBJECTS)) == 1
        assert objects.canonical(name) in rotations & set(objects.OBJECTS)


def test_no_object_of_a_split_is_one_of_another():
    assert {split: len(names) for split, names in objects.SPLITS.items()} == {"train": 50, "validation": 10, "test": 10}
    for one, other in itertools.combinations(objects.SPLITS.values(), 2):
        turned = {name[i:] + name[:i] for name in one for i in range(4)}
        assert not turned & set(other)
    assert set().union(*objects.SPLITS.values()) == set(objects.OBJECTS)


def test_the_split_never_changes():
    digest = hashlib.sha256(repr(sorted(objects.SPLITS.items())).encode()).hexdigest()
    assert digest[:16] == "071ce2af48d436ae"


def test_names_of_omnipush():
    assert objects.from_omnipush("1a1a3a2a") == "1132"
    assert objects.from_omnipush("3a2b1a1a") == "1132"


def test_episodes_have_the_objects_of_their_split_only():
    for split in objects.SPLITS:
        env = PlanarPushEnv(split, images=False)
        seen = {env.reset(seed=seed)[1]["object"] for seed in range(40)}
        assert seen <= set(objects.SPLITS[split])
        assert len(seen) >= 8
        env.close()
    env = PlanarPushEnv(object="2311", images=False)
    assert {env.reset(seed=seed)[1]["object"] for seed in range(3)} == {"1123"}
    env.close()
