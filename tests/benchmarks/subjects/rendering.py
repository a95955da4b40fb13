"""Control steps and RGB-D frames a second, ours and the usual ways."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import mujoco
import numpy as np

import envs  # noqa: F401  (registers the environments)
from envs.gl import gl_renderer
from envs.rendering import StaticCamera, block_average
from tests.benchmarks.timing import median_seconds

SIZE = 64
CONTROL_RATE = 30  # Hz


def opengl() -> str:
    """What draws here, e.g. `egl: llvmpipe (...)`."""
    return gl_renderer()


def tabletop_steps(steps: int, repeats: int) -> float:
    """Control steps a second of the tabletop with supersampled RGB-D."""
    env = gymnasium.make("t3vip/TabletopC-v0", image_size=SIZE, max_episode_steps=-1, disable_env_checker=True)
    observation, _ = env.reset(seed=0)
    assert observation["rgb"].shape == (SIZE, SIZE, 3) and observation["depth"].shape == (SIZE, SIZE)
    assert env.unwrapped.control_rate == CONTROL_RATE  # type: ignore[attr-defined]
    return _steps_a_second(env.step, 7, steps, repeats)


def dexhand_steps(steps: int, repeats: int) -> float:
    """Control steps a second of the hand with supersampled RGB-D, under random commands."""
    return _env_steps("t3vip/DexHand-v0", 20, steps, repeats)


def planar_push_steps(steps: int, repeats: int) -> float:
    """Control steps a second of the pusher with supersampled RGB-D, under random moves."""
    return _env_steps("t3vip/PlanarPush-v0", 3, steps, repeats)


def manipulate_block_steps(steps: int, repeats: int) -> float:
    """Control steps a second of the hand as gymnasium-robotics has it: 25 Hz, too, picture and depth each time."""
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make(
        "HandManipulateBlock-v1",
        render_mode="rgb_array",
        width=SIZE,
        height=SIZE,
        max_episode_steps=-1,
        disable_env_checker=True,
    )
    env.reset(seed=0)
    renderer = env.unwrapped.mujoco_renderer  # type: ignore[attr-defined]

    def step(action: np.ndarray) -> None:
        env.step(action)
        picture, depth = renderer.render("rgb_array"), renderer.render("depth_array")
        assert picture.shape == (SIZE, SIZE, 3) and depth.shape == (SIZE, SIZE)

    return _steps_a_second(step, 20, steps, repeats)


def robosuite_steps(steps: int, repeats: int) -> float:
    """Control steps a second of robosuite as it comes: a Panda, operational space control, one camera with depth.

    It samples the camera by a clock of its own, at this rate in 24 of 25 steps; only many steps give its true rate.
    """
    import robosuite  # sets MUJOCO_GL, hence not at the top

    env = robosuite.make(
        "Lift",
        robots="Panda",
        controller_configs=robosuite.load_composite_controller_config(controller="BASIC"),  # OSC_POSE
        has_renderer=False,
        has_offscreen_renderer=True,
        use_camera_obs=True,
        camera_names="agentview",
        camera_heights=SIZE,
        camera_widths=SIZE,
        camera_depths=True,
        control_freq=CONTROL_RATE,
        ignore_done=True,
        seed=0,
    )
    observation = env.reset()
    assert observation["agentview_image"].shape == (SIZE, SIZE, 3)
    assert observation["agentview_depth"].shape[:2] == (SIZE, SIZE)
    pictures = set()

    def step(action: np.ndarray) -> None:
        pictures.add(env.step(action)[0]["agentview_image"].tobytes())

    speed = _steps_a_second(step, env.action_dim, steps, repeats)
    if len(pictures) < 0.8 * steps * (repeats + 1):
        raise RuntimeError(f"robosuite drew {len(pictures)} different pictures in {steps * (repeats + 1)} steps")
    return speed


def tabletop_frames(frames: int, repeats: int) -> float:
    """Supersampled RGB-D frames a second of the tabletop, drawn in one pass."""
    tabletop = _tabletop()
    near, far = tabletop.camera.near, tabletop.camera.far
    camera = StaticCamera(tabletop.mj_model, "static", SIZE, SIZE, near, far)
    return frames / median_seconds(_repeated(lambda: camera.render(tabletop.mj_data), frames), repeats)


def two_pass_frames(frames: int, repeats: int, supersample: int = 3) -> float:
    """The same pictures by `mujoco.Renderer`: a pass for colour, another for depth, then averaged."""
    tabletop = _tabletop()
    large = SIZE * supersample
    near, far = tabletop.camera.near, tabletop.camera.far
    middle = slice(supersample // 2, None, supersample)
    with mujoco.Renderer(tabletop.mj_model, large, large) as renderer:

        def draw() -> tuple[np.ndarray, np.ndarray]:
            renderer.update_scene(tabletop.mj_data, camera="static")
            rgb = renderer.render()
            renderer.enable_depth_rendering()
            renderer.update_scene(tabletop.mj_data, camera="static")
            depth = renderer.render()
            renderer.disable_depth_rendering()
            return block_average(rgb, supersample), np.clip(depth[middle, middle], near, far)

        return frames / median_seconds(_repeated(draw, frames), repeats)


def _tabletop() -> Any:
    env = gymnasium.make("t3vip/TabletopC-v0", image_size=SIZE, disable_env_checker=True)
    env.reset(seed=0)
    return env.unwrapped


def _env_steps(env_id: str, action_dim: int, steps: int, repeats: int) -> float:
    env = gymnasium.make(env_id, image_size=SIZE, max_episode_steps=-1, disable_env_checker=True)
    env.reset(seed=0)
    return _steps_a_second(env.step, action_dim, steps, repeats)


def _steps_a_second(step: Callable[[np.ndarray], Any], action_dim: int, steps: int, repeats: int) -> float:
    """The rate of a control loop under random actions, the median over `repeats` stretches of `steps`."""
    rng = np.random.default_rng(0)

    def stretch() -> None:
        for action in rng.uniform(-0.5, 0.5, (steps, action_dim)).astype(np.float32):
            step(action)

    return steps / median_seconds(stretch, repeats)


def _repeated(work: Callable[[], Any], times: int) -> Callable[[], None]:
    def all_of_it() -> None:
        for _ in range(times):
            work()

    return all_of_it
