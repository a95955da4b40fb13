"""The static camera against known geometry, under every OpenGL that there is."""

import copy
import ctypes
import gc
import os
import pickle
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from envs import gl
from envs.errors import UsageError
from envs.rendering import StaticCamera, metric_depth

BALL, BOX, HIDDEN = 1, 2, 3
RADIUS, HALF_SIZES = 0.16, np.array([0.10, 0.13, 0.08])
SCENE = """
<mujoco>
  <visual>
    <map znear="0.01" zfar="50"/>
    <quality numslices="128" numstacks="64"/>
  </visual>
  <statistic extent="1"/>
  <asset><texture type="skybox" builtin="gradient" rgb1="0 .5 .9" rgb2=".9 .9 1" width="64" height="64"/></asset>
  <worldbody>
    <light pos="2 -2 3" dir="-.5 .5 -1"/>
    <!-- 4.2 m from the origin, looking at it -->
    <camera name="narrow" pos="2.897 -2.137 2.163" xyaxes="0.5936 0.8047 0 -0.4143 0.3056 0.8573" fovy="10"/>
    <camera name="wide" pos="0.26 -0.71 0.56" xyaxes="0.9487 0.3162 0 -0.2 0.6 0.7746" fovy="75"/>
    <camera name="above" pos="0 0 5" fovy="30"/>
    <body name="ball" pos="-.1 -.13 .05"><freejoint/><geom size="0.16" group="1" rgba=".9 .2 .1 1"/></body>
    <body name="box" pos=".13 .12 -.02" euler="20 -35 50">
      <freejoint/><geom type="box" size=".10 .13 .08" group="2" rgba=".2 .8 .3 1"/>
    </body>
    <body name="hidden" pos="0 0 .1">
      <geom size=".3" group="0"/><geom size=".3" group="3"/><site size=".4"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def world():
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.fixture
def make_camera(world):
    cameras = []

    def make(name="narrow", width=64, height=64, near=0.1, far=6.0, **options):
        cameras.append(StaticCamera(world[0], name, width, height, near, far, **options))
        return cameras[-1]

    yield make
    for camera in cameras:
        camera.close()


def distance_to_box(points, data):
    local = np.abs((points - data.xpos[BOX]) @ data.xmat[BOX].reshape(3, 3)) - HALF_SIZES
    return np.linalg.norm(np.maximum(local, 0), axis=-1) + np.minimum(local.max(-1), 0)


def distance_to_ball(points, data):
    return np.linalg.norm(points - data.xpos[BALL], axis=-1) - RADIUS


def fitted_centre(points):
    """The centre of the sphere that fits the points best."""
    equations = np.concatenate([2 * points, np.ones((len(points), 1))], axis=1)
    return np.linalg.lstsq(equations, np.square(points).sum(1), rcond=None)[0][:3]


@pytest.mark.parametrize("name", ["narrow", "wide"])
@pytest.mark.parametrize(("width", "height"), [(32, 32), (64, 64), (128, 128), (200, 200), (96, 40), (50, 81)])
def test_known_geometry_unprojects_to_a_millimetre(world, make_camera, name, width, height):
    _, data = world
    camera = make_camera(name, width, height)
    _, depth = camera.render(data)
    ids = camera.segment(data)
    points = camera.geometry.to_world(camera.geometry.unproject(depth))
    assert np.unique(ids).tolist() == [0, BALL, BOX]
    assert (ids == BALL).sum() > 20 and (ids == BOX).sum() > 20
    assert np.abs(distance_to_ball(points[ids == BALL], data)).max() < 1e-3
    assert np.abs(distance_to_box(points[ids == BOX], data)).max() < 1e-3
    assert np.linalg.norm(fitted_centre(points[ids == BALL]) - data.xpos[BALL]) < 1e-3
    assert (depth[ids == 0] == np.float32(6.0)).all()  # nothing there: the sky is not a surface


def test_every_pixel_shows_what_its_ray_hits(world, make_camera):
    model, data = world
    camera = make_camera("wide", 41, 30)
    _, depth = camera.render(data)
    ids = camera.segment(data)
    rays = (
        camera.geometry.to_world(camera.geometry.unproject(np.ones((30, 41)))) - camera.geometry.world_T_camera[:3, 3]
    )
    group, hit = np.array([0, 1, 1, 0, 0, 0], np.uint8), np.zeros(1, np.int32)
    disagree = 0
    for row, column in np.ndindex(30, 41):
        along = mujoco.mj_ray(
            model, data, camera.geometry.world_T_camera[:3, 3], rays[row, column], group, 1, -1, hit, None
        )
        body = 0 if along < 0 else model.geom_bodyid[hit[0]]
        if body != ids[row, column]:
            disagree += 1  # a ray that grazes an edge
        elif body:
            assert depth[row, column] == pytest.approx(along, abs=1e-3)
    assert disagree <= 2


def run_known_geometry(backend):
    environment = os.environ | {"MUJOCO_GL": backend}
    command = [sys.executable, "-m", "pytest", "-o", "addopts=--import-mode=importlib", "-p", "no:cacheprovider"]
    command += ["-k", "known_geometry or renderer_is or garbage", __file__]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=200)


@pytest.mark.parametrize(("backend", "library"), [("egl", "libEGL.so.1"), ("osmesa", "libOSMesa.so.8")])
def test_both_backends_agree_with_geometry(backend, library):
    try:
        ctypes.CDLL(library)
    except OSError:
        pytest.skip(f"{library} is not installed, so {backend} cannot be tested; {gl.REMEDY}")
    result = run_known_geometry(backend)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "14 passed" in result.stdout


def test_renderer_is_the_one_asked_for(world, make_camera):
    wish = os.environ.get("MUJOCO_GL", "")
    renderer = make_camera().gl_renderer()
    assert renderer.split(":")[0] in ((wish,) if wish else ("egl", "osmesa"))
    assert len(renderer.split(":")[1]) > 3
    assert gl.gl_renderer() == renderer


def test_colour_is_the_average_of_each_block(world, make_camera):
    _, data = world
    fine, _ = make_camera("wide", 120, 90, supersample=1).render(data)
    rgb, _ = make_camera("wide", 40, 30, supersample=3).render(data)
    average = fine.reshape(30, 3, 40, 3, 3).mean((1, 3))
    assert np.abs(rgb - average).max() <= 0.5 + 1e-6
    assert rgb.dtype == np.uint8 and rgb.flags.c_contiguous


def test_depth_and_ids_are_the_centre_sample_of_each_block(world, make_camera):
    _, data = world
    fine, coarse = make_camera("wide", 120, 90, supersample=1), make_camera("wide", 40, 30, supersample=3)
    assert np.array_equal(coarse.render(data)[1], fine.render(data)[1][1::3, 1::3])
    assert np.array_equal(coarse.segment(data), fine.segment(data)[1::3, 1::3])


def test_depth_on_an_edge_is_one_of_both_surfaces():
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><worldbody><camera name="c" pos="0 0 4" fovy="30"/><light pos="0 0 5"/>
        <geom type="plane" size="5 5 .1" group="1" rgba="1 1 1 1"/>
        <geom type="box" size=".4 .4 .5" pos="0 0 .5" euler="0 0 30" group="1" rgba="0 0 0 1"/></worldbody></mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with StaticCamera(model, "c", 64, 64, 1.0, 5.0, supersample=5) as camera:
        rgb, depth = camera.render(data)
    lid, floor = np.abs(depth - 3.0) < 1e-3, np.abs(depth - 4.0) < 1e-3
    # seen from above near the axis, the box shows no sides but for a sliver of perspective
    assert (lid | floor).mean() > 0.99 and lid.sum() > 300
    between = (rgb[..., 0] > 40) & (rgb[..., 0] < rgb[..., 0].max() - 40)
    assert between.sum() > 30 and (lid | floor)[between].mean() > 0.9


def test_first_row_is_the_top_and_first_column_the_left(world, make_camera):
    _, data = world
    camera = make_camera("narrow")
    ids = camera.segment(data)
    for body in (BALL, BOX):
        seen = np.argwhere(ids == body).mean(0)[::-1]
        expected = camera.geometry.project(camera.geometry.to_camera(data.xpos[body]))
        assert np.abs(seen - expected).max() < 1.0
    red, green, blue = make_camera("narrow", supersample=1).render(data)[0].astype(int).transpose(2, 0, 1)
    assert ((red > green) & (red > blue) == (ids == BALL)).mean() > 0.995
    assert ((green > red) & (green > blue) == (ids == BOX)).mean() > 0.995


def test_collision_shapes_sites_and_aids_are_hidden(world, make_camera):
    _, data = world
    assert (make_camera().segment(data) != HIDDEN).all()
    assert (make_camera(visible_groups=(0,)).segment(data) == HIDDEN).any()
    bare = mujoco.MjModel.from_xml_string(
        SCENE.replace('<geom size=".3" group="0"/><geom size=".3" group="3"/><site size=".4"/>', "")
    )
    bare_data = mujoco.MjData(bare)
    mujoco.mj_forward(bare, bare_data)
    with StaticCamera(bare, "narrow", 64, 64, 0.1, 6.0) as camera:
        for with_hidden, without in zip(make_camera().render(data), camera.render(bare_data), strict=True):
            assert np.array_equal(with_hidden, without)


def test_depth_is_clipped_to_the_working_range(world, make_camera):
    _, data = world
    _, depth = make_camera(near=4.1, far=4.3).render(data)
    assert depth.min() == np.float32(4.1) and depth.max() == np.float32(4.3) and depth.dtype == np.float32
    assert ((depth > 4.1) & (depth < 4.3)).any()


def test_pictures_are_repeatable_independent_and_survive_close(world, make_camera):
    _, data = world
    camera, other = make_camera(), make_camera("wide", 33, 21)
    first = camera.render(data)
    kept = [image.copy() for image in first]
    other.render(data)
    camera.segment(data)
    second = camera.render(data)
    other.close()
    third = camera.render(data)
    camera.close()
    fourth = camera.render(data)
    for pictures in (first, second, third, fourth):
        assert all(np.array_equal(image, copy) for image, copy in zip(pictures, kept, strict=True))


def test_a_camera_that_becomes_garbage_while_another_draws_leaves_its_picture_alone(world, make_camera, monkeypatch):
    model, data = world
    camera, update = make_camera(), mujoco.mjv_updateScene
    expected = camera.render(data)
    moved = copy.copy(data)
    moved.qpos[2] += 0.2
    mujoco.mj_forward(model, moved)
    assert not np.array_equal(camera.render(moved)[0], expected[0])

    def collect_first(*arguments):
        gc.collect()
        update(*arguments)

    dropped = StaticCamera(model, "wide", 16, 16, 0.1, 6.0)
    dropped.render(data)
    dropped.itself = dropped  # only the garbage collector frees it
    del dropped
    monkeypatch.setattr(mujoco, "mjv_updateScene", collect_first)
    for picture, wanted in zip(camera.render(data), expected, strict=True):
        np.testing.assert_array_equal(picture, wanted)


def test_a_camera_that_has_drawn_can_be_copied_and_pickled(world, make_camera):
    _, data = world
    camera = make_camera("wide", 33, 21)
    expected = camera.render(data)
    for other in (copy.deepcopy(camera), pickle.loads(pickle.dumps(camera))):
        with other:
            assert all(map(np.array_equal, other.render(data), expected))
    assert all(map(np.array_equal, camera.render(data), expected))


def test_a_picture_beyond_what_opengl_draws_is_named_and_another_camera_goes_on(world, make_camera):
    _, data = world
    with pytest.raises(UsageError, match=r"120000 x 120000 samples.*smaller image size"):
        make_camera(width=40_000, height=40_000).render(data)
    make_camera().render(data)


def test_the_model_is_left_as_it_was_whatever_the_picture_size(world, make_camera):
    model, data = world
    camera = make_camera(width=900, height=700, supersample=1)  # beyond MuJoCo's default framebuffer of 640x480
    rgb, _ = camera.render(data)
    assert rgb.shape == (700, 900, 3) and rgb[-1, -1].any()
    assert (model.vis.global_.offwidth, model.vis.quality.offsamples) == (640, 4)


def test_geometry_needs_no_opengl(world, make_camera, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "bogus")
    camera = make_camera("above", 40, 30)
    np.testing.assert_allclose(camera.geometry.to_world([0, 0, 1]), [0, 0, 4])
    np.testing.assert_allclose(camera.geometry.to_world([0, 1, 0]), [0, -1, 5])  # down in the image
    with pytest.raises(UsageError, match=r"MUJOCO_GL is 'bogus'.*egl or osmesa"):
        camera.render(world[1])


def test_the_working_range_may_be_all_of_the_clipped_one(make_camera):
    make_camera(near=0.01, far=50.0)


def test_metric_depth_at_the_planes():
    zbuffer = np.array([1.0, 0.0], np.float32)
    np.testing.assert_allclose(metric_depth(zbuffer, 0.5, 8.0), [0.5, 8.0], rtol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"supersample": 2}, "supersample is 2"),
        ({"supersample": 1.5}, "supersample is 1.5; give an odd number"),
        ({"name": "nowhere"}, "no camera 'nowhere'.*narrow"),
        ({"near": 0.001}, "clipped to 0.01 .. 50 m"),
        ({"far": 60.0}, "clipped to 0.01 .. 50 m"),
        ({"width": 0}, "width is 0"),
        ({"visible_groups": (1, 6)}, r"visible_groups is \(1, 6\)"),
    ],
)
def test_bad_arguments_are_named(make_camera, arguments, message):
    with pytest.raises(UsageError, match=message):
        make_camera(**arguments)


@pytest.mark.parametrize(
    "body",
    ['<body mocap="true"><camera name="c"/></body>', '<body><freejoint/><geom size=".1"/><camera name="c"/></body>'],
)
def test_cameras_that_move_are_refused(body):
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    with pytest.raises(UsageError, match="'c' moves"):
        StaticCamera(model, "c", 8, 8, 0.5, 1.0)
