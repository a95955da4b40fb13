"""The collector on the real table: pictures and physics do not depend on who collects, or on what came before."""

import numpy as np
from commands import call, options

from data_collection.dataset import RGBDDataset
from envs.ground_truth import scene_flow


def test_table_is_the_same_with_one_and_two_workers(tmp_path):
    hashes = []
    for workers in (1, 2):
        given = {"env": "tabletop", "scene": "C", "episodes": 2, "steps": 6, "policy": "play", "image-size": 32}
        code, _, err = call(
            "collect-rollouts", options(tmp_path / str(workers), workers=workers, **given, **{"ground-truth": True})
        )
        assert code == 0, err
        hashes.append(RGBDDataset(tmp_path / str(workers)).content_hash)
    assert hashes[0] == hashes[1]

    dataset = RGBDDataset(tmp_path / "1")
    assert dataset.attrs["env_id"] == "t3vip/TabletopC-v0" and dataset.action_dim == 7
    assert dataset.camera.width == 32
    assert dataset.attrs["gl_renderer"] != "unknown"
    episode = dataset.episode(0)
    assert episode["proprio"].shape == (7, 15) and episode["scene_obs"].shape == (7, 24)
    depth, pose = dataset.depth_metres(episode["depth"]), episode["body_pose"]
    flow = scene_flow(dataset.camera, depth[0], episode["segmentation"][0], pose[0], pose[-1])
    moved = np.linalg.norm(flow, axis=-1)
    assert moved[episode["segmentation"][0] == 0].max() == 0
    assert set(np.unique(episode["segmentation"])) <= set(range(len(dataset.attrs["body_names"])))
