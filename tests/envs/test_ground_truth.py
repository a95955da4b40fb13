"""Scene flow, optical flow and disocclusion against motions that are known."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from envs.camera import CameraModel
from envs.errors import UsageError
from envs.ground_truth import disocclusion, motion, optical_flow, scene_flow
from envs.rendering import StaticCamera

BALL, BOX, TABLE = 1, 2, 3
HALF_SIZES = np.array([0.15, 0.10, 0.12])
SCENE = """
<mujoco>
  <visual><map znear="0.1" zfar="20"/><quality numslices="128" numstacks="64"/></visual>
  <statistic extent="1"/>
  <worldbody>
    <camera name="static" pos="0.4 -1.2 0.9" xyaxes="0.9487 0.3162 0 -0.2 0.6 0.7746" fovy="45"/>
    <geom type="plane" size="3 3 .1" group="1"/>
    <body name="ball" pos="-.2 0 .2"><freejoint/><geom size=".12" group="1"/></body>
    <body name="box" pos=".15 .05 .2" euler="10 20 30">
      <freejoint/><geom type="box" size=".15 .10 .12" group="2"/>
    </body>
    <body name="table" pos="-.1 .6 .2"><geom type="box" size=".2 .1 .2" group="2"/></body>
  </worldbody>
</mujoco>
"""


def poses(data):
    return np.concatenate([data.xpos, data.xquat], axis=1)


def distance_to_box(points, data):
    local = np.abs((points - data.xpos[BOX]) @ data.xmat[BOX].reshape(3, 3)) - HALF_SIZES
    return np.linalg.norm(np.maximum(local, 0), axis=-1) + np.minimum(local.max(-1), 0)


class Frame:
    """All that is seen and known of one state."""

    def __init__(self, camera, data):
        self.depth, self.ids, self.poses = camera.render(data)[1], camera.segment(data), poses(data)


@pytest.fixture(scope="module")
def moved():
    """The ball slides, the box is shifted and turned about an oblique axis; table and floor stay."""
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with StaticCamera(model, "static", 160, 120, 0.3, 8.0) as camera:
        before = Frame(camera, data)
        turn = Rotation.from_rotvec([0.1, -0.15, 0.3])
        start = Rotation.from_quat(data.xquat[BOX][[1, 2, 3, 0]])
        data.qpos[:3] += [0.03, -0.05, 0.02]
        data.qpos[7:10] += [-0.02, 0.04, 0.03]
        data.qpos[10:14] = (turn * start).as_quat()[[3, 0, 1, 2]]
        mujoco.mj_forward(model, data)
        yield camera.geometry, before, Frame(camera, data), data, turn


def test_flow_of_a_turned_box_is_the_analytic_one(moved):
    camera, before, after, _, turn = moved
    flow = scene_flow(camera, before.depth, before.ids, before.poses, after.poses)
    on_box = before.ids == BOX
    world = camera.to_world(camera.unproject(before.depth))[on_box]
    centre = np.array([0.15, 0.05, 0.2])
    expected = turn.apply(world - centre) + centre + [-0.02, 0.04, 0.03] - world
    assert on_box.sum() > 1000 and flow.dtype == np.float32
    np.testing.assert_allclose(flow[on_box], expected @ camera.world_T_camera[:3, :3], atol=1e-6)
    ball = [0.03, -0.05, 0.02] @ camera.world_T_camera[:3, :3]
    np.testing.assert_allclose(flow[before.ids == BALL] - ball, 0.0, atol=1e-6)


def test_what_stands_still_has_exactly_no_flow(moved):
    camera, before, after, _, _ = moved
    truth = motion(camera, before.depth, before.ids, before.poses, after.poses)
    still = (before.ids == 0) | (before.ids == TABLE)
    assert (before.ids == TABLE).sum() > 100
    assert (truth.scene_flow[still] == 0).all() and (truth.optical_flow[still] == 0).all()
    assert (truth.scene_flow[~still] != 0).any(-1).all()
    nothing = motion(camera, before.depth, before.ids, before.poses, before.poses)
    assert not nothing.scene_flow.any() and not nothing.optical_flow.any() and not nothing.disocclusion.any()


def test_moved_points_lie_on_the_moved_surface_and_land_on_it_in_the_next_picture(moved):
    camera, before, after, data, _ = moved
    truth = motion(camera, before.depth, before.ids, before.poses, after.poses)
    arrived = camera.unproject(before.depth) + truth.scene_flow
    assert np.abs(distance_to_box(camera.to_world(arrived[before.ids == BOX]), data)).max() < 1e-3
    ball = camera.to_world(arrived[before.ids == BALL])
    assert np.abs(np.linalg.norm(ball - data.xpos[BALL], axis=1) - 0.12).max() < 1e-3

    landed = camera.pixels() + truth.optical_flow
    np.testing.assert_allclose(landed, camera.project(arrived), atol=1e-4)
    column, row = np.rint(landed).astype(int).transpose(2, 0, 1)
    inside = (column >= 0) & (column < 160) & (row >= 0) & (row < 120)
    for body in (BALL, BOX):
        of_body = (before.ids == body) & inside
        there = after.ids[row[of_body], column[of_body]] == body
        # all but those on the silhouette and on sides that turned away or are hidden by the other body
        assert there.mean() > 0.93
        seen = after.depth[row[of_body], column[of_body]][there]
        agree = np.abs(seen - arrived[of_body][there][:, 2]) < 0.01
        assert agree.mean() > 0.9


def test_disocclusion_is_what_the_next_picture_shows_anew(moved):
    camera, before, after, _, _ = moved
    truth = motion(camera, before.depth, before.ids, before.poses, after.poses)
    backward = motion(camera, after.depth, after.ids, after.poses, before.poses)
    # a pixel of the next frame was hidden before if its point, taken back, lies behind what was seen there
    column, row = np.rint(camera.pixels() + backward.optical_flow).astype(int).transpose(2, 0, 1)
    column, row = column.clip(0, 159), row.clip(0, 119)
    back = camera.unproject(after.depth) + backward.scene_flow
    hidden = back[..., 2] > before.depth[row, column] + 0.03
    floor = after.ids == 0  # moving surfaces also crack where they come nearer
    assert hidden[floor].sum() > 50
    overlap = (hidden & truth.disocclusion & floor).sum() / ((hidden | truth.disocclusion) & floor).sum()
    assert overlap > 0.7


def test_disocclusion_of_a_square_that_slides():
    camera = CameraModel.from_fovy(40, 30, 45.0, np.eye(4), 0.5, 10.0)
    depth = np.full((30, 40), 5.0)
    depth[10:20, 10:20] = 4.0
    flow = np.zeros((30, 40, 3))
    flow[10:20, 10:20, 0] = 3 * 4.0 / camera.K[0, 0]  # three pixels to the right
    shift = optical_flow(camera, depth, flow)
    np.testing.assert_allclose(shift[10:20, 10:20], np.broadcast_to([3.0, 0.0], (10, 10, 2)), atol=1e-5)
    expected = np.zeros((30, 40), bool)
    expected[10:20, 10:13] = True
    np.testing.assert_array_equal(disocclusion(camera, depth, flow), expected)


def test_points_that_leave_the_view_land_nowhere():
    camera = CameraModel.from_fovy(8, 6, 45.0, np.eye(4), 0.5, 10.0)
    depth = np.full((6, 8), 2.0)
    aside, behind = np.zeros((6, 8, 3)), np.zeros((6, 8, 3))
    aside[..., 0], behind[..., 2] = 100.0, -5.0
    assert disocclusion(camera, depth, aside).all() and disocclusion(camera, depth, behind).all()
    assert np.isnan(optical_flow(camera, depth, behind)).all()


def random_scene(rng, lead=()):
    """A camera anywhere, three bodies anywhere, each pixel on one of them."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    pose[:3, 3] = rng.uniform(-2, 2, 3)
    camera = CameraModel.from_fovy(9, 7, 40.0, pose, 0.1, 10.0)
    depth = rng.uniform(0.5, 4.0, (*lead, 7, 9))
    ids = rng.integers(0, 4, (*lead, 7, 9))
    before, after = rng.normal(size=(2, *lead, 4, 7))
    for some in (before, after):
        some[..., 3:] /= np.linalg.norm(some[..., 3:], axis=-1, keepdims=True)
    return camera, depth, ids, before, after


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_points_keep_their_place_on_the_body(seed):
    camera, depth, ids, before, after = random_scene(np.random.default_rng(seed))
    points = camera.unproject(depth)
    flow = scene_flow(camera, depth, ids, before, after)
    for body in (1, 2, 3):
        places = []
        for some, where in ((before, points), (after, points + flow)):
            turn = Rotation.from_quat(some[body, [4, 5, 6, 3]])
            places.append(turn.inv().apply(camera.to_world(where[ids == body]) - some[body, :3]))
        np.testing.assert_allclose(places[0], places[1], atol=1e-5)
    assert not flow[ids == 0].any()


def test_clips_give_what_their_frames_give():
    camera, depth, ids, before, after = random_scene(np.random.default_rng(5), lead=(2, 3))
    together = motion(camera, depth, ids, before, after)
    for index in np.ndindex(2, 3):
        alone = motion(camera, depth[index], ids[index], before[index], after[index])
        np.testing.assert_allclose(together.scene_flow[index], alone.scene_flow, atol=1e-6)
        np.testing.assert_array_equal(together.disocclusion[index], alone.disocclusion)
        np.testing.assert_allclose(together.optical_flow[index], alone.optical_flow, atol=1e-3)


def test_opposite_quaternions_are_the_same_turn():
    camera, depth, ids, before, after = random_scene(np.random.default_rng(6))
    flow = scene_flow(camera, depth, ids, before, after)
    after[:, 3:] *= -1
    np.testing.assert_allclose(scene_flow(camera, depth, ids, before, after), flow, atol=1e-6)


def test_bad_input_is_named():
    camera, depth, ids, before, after = random_scene(np.random.default_rng(7))
    with pytest.raises(UsageError, match=r"depth has shape \(9, 7\)"):
        scene_flow(camera, depth.T, ids, before, after)
    with pytest.raises(UsageError, match=r"body_id has shape \(9, 7\)"):
        scene_flow(camera, depth, ids.T, before, after)
    with pytest.raises(UsageError, match=r"ids range over 0\.\.3 .* 2 bodies"):
        scene_flow(camera, depth, ids, before[:2], after[:2])
    with pytest.raises(UsageError, match=r"\(4, 7\) and \(4, 6\)"):
        scene_flow(camera, depth, ids, before, after[:, :6])
    with pytest.raises(UsageError, match="norm 0"):
        scene_flow(camera, depth, ids, before, np.zeros((4, 7)))
    with pytest.raises(UsageError, match=r"scene flow has shape \(7, 9, 2\)"):
        optical_flow(camera, depth, np.zeros((7, 9, 2)))
