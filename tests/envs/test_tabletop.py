"""The play table: Gymnasium's contract, CALVIN's conventions, exact restoring, fixtures that work."""

from __future__ import annotations

import gymnasium
import mujoco
import numpy as np
import pytest
import stable_baselines3.common.env_checker as sb3
from gymnasium.utils.env_checker import check_env

import envs  # noqa: F401  (registers)
from envs import rotations
from envs.errors import UsageError
from envs.tabletop import TabletopEnv, control, table
from envs.tabletop.placement import GRIPPER_DOWN

SCENES = "ABCD"
FREE_SPACE = [0.0, -0.25, 0.62]  # m


@pytest.fixture(scope="module", params=SCENES)
def blind(request):
    """One environment a scene, without pictures."""
    env = TabletopEnv(request.param, images=False)
    yield env
    env.close()


@pytest.fixture(scope="module")
def blind_c():
    env = TabletopEnv("C", images=False)
    yield env
    env.close()


def move_to(env: TabletopEnv, place, gripper: float = -1.0, speed: float = 1.0, steps: int = 80) -> bool:
    """Drive the target straight to `place`, gripper down; whether the hand arrives within 5 mm."""
    down = rotations.from_euler(GRIPPER_DOWN)
    for _ in range(steps):
        target = env.target_pose
        turn = rotations.to_rotvec(rotations.multiply(down, rotations.conjugate(target.quaternion)))
        move = np.clip((np.asarray(place) - target.position) / 0.02, -speed, speed)
        env.step(np.concatenate([move, np.clip(turn / 0.05, -1, 1), [gripper]]))
        if np.linalg.norm(env.tcp_position - place) < 0.005:
            return True
    return False


def by(x: float, y: float, z: float) -> np.ndarray:
    return np.array([x, y, z])


def put_blocks_away(env: TabletopEnv) -> None:
    for i, name in enumerate(table.BLOCKS):
        env.mj_data.joint(name).qpos[:3] = [2, 2 + i, 0.1]


def site(env: TabletopEnv, name: str) -> np.ndarray:
    return env.mj_data.site(name).xpos.copy()


def joint(env: TabletopEnv, name: str) -> float:
    return float(env.mj_data.joint(name).qpos[0])


@pytest.mark.parametrize("scene", SCENES)
def test_registered_and_passes_both_checkers(scene):
    env = gymnasium.make(f"envs:t3vip/Tabletop{scene}-v0")
    check_env(env.unwrapped, skip_render_check=scene != "A")
    sb3.check_env(env, warn=False)
    assert env.spec.max_episode_steps == 240
    assert env.unwrapped.camera.width == 64
    env.close()


def test_render_modes_and_sizes():
    for mode in ("rgb_array", "depth_array", "rgbd_tuple"):
        env = TabletopEnv("B", image_size=32, render_mode=mode)
        observation, _ = env.reset(seed=0)
        picture = env.render()
        rgb, depth = {"rgb_array": (picture, None), "depth_array": (None, picture)}.get(mode, picture)
        if rgb is not None:
            np.testing.assert_array_equal(rgb, observation["rgb"])
        if depth is not None:
            np.testing.assert_array_equal(depth, observation["depth"])
            assert depth.dtype == np.float32
            assert 3.4 < depth.min() < depth.max() < 6.3  # everything in view lies inside the working range
        assert env.segmentation().shape == (32, 32)
        env.close()


def test_the_contract_names_exist(blind):
    model = blind.mj_model
    for name in ("drawer", "door", "button", "switch", *table.BLOCKS):
        assert model.body(name).id > 0
        assert model.joint(name).id >= 0
    for name in ("drawer", "door", "button", "switch"):
        low, high = model.joint(name).range
        assert low == 0 < high
    for name in ("tcp", "drawer_handle", "door_handle", "button_top", "switch_tip"):
        assert model.site(name).id >= 0
    assert {model.camera(i).name for i in range(model.ncam)} == {"static", "side"}
    assert blind.body_poses().shape == (len(blind.body_names), 7)
    assert blind.body_names[blind.hand_body_ids[0]] == "right_gripper"


def test_seeds_are_exact_and_starts_are_varied_and_free(blind):
    first, again = blind.reset(seed=7), blind.reset(seed=7)
    np.testing.assert_array_equal(first[0]["proprio"], again[0]["proprio"])
    np.testing.assert_array_equal(first[1]["scene_obs"], again[1]["scene_obs"])
    places = []
    for seed in range(12):
        blind.reset(seed=seed)
        mujoco.mj_collision(blind.mj_model, blind.mj_data)
        touching = blind.mj_data.contact.geom[: blind.mj_data.ncon]
        assert not (blind.mj_model.geom_contype[touching] == table.ROBOT).any()
        assert all(contact.dist > -1e-3 for contact in blind.mj_data.contact)
        places.append(blind.tcp_position)
    assert (np.ptp(places, axis=0) > 0.1).all()


def test_a_restored_state_goes_on_to_the_last_bit(blind):
    blind.reset(seed=3, options={"tcp": [0.0, -0.1, 0.6]})
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (50, 7)) * [1, 1, 1, 0.2, 0.2, 0.2, 1] - [0, 0, 0.6, 0, 0, 0, 0]
    for action in actions[:25]:
        blind.step(action)
    state = blind.get_state()

    def onward():
        return [np.append(blind.step(action)[0]["proprio"], blind.scene_obs()) for action in actions[25:]]

    expected = onward()
    end = blind.get_state()
    blind.reset(seed=99)
    blind.set_state(state)
    np.testing.assert_array_equal(blind.get_state(), state)
    np.testing.assert_array_equal(onward(), expected)
    np.testing.assert_array_equal(blind.get_state(), end)


def test_a_restored_state_looks_the_same():
    env = TabletopEnv("C", image_size=32)
    env.reset(seed=1)
    state, before = env.get_state(), env.observation()
    env.reset(seed=2)
    env.set_state(state)
    for key, value in env.observation().items():
        np.testing.assert_array_equal(value, before[key])
    env.close()


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("sign", (-1, 1))
def test_actions_are_increments_in_the_world_frame(blind_c, axis, sign):
    blind_c.reset(seed=0, options={"tcp": FREE_SPACE})
    start = blind_c.tcp_pose
    for _ in range(5):
        blind_c.step(sign * np.eye(7)[axis])
    end = blind_c.tcp_pose
    expected = sign * 5 * np.eye(6)[axis] * control.ACTION_SCALE[:6]
    np.testing.assert_allclose(end.position - start.position, expected[:3], atol=2e-3)
    turn = rotations.to_rotvec(rotations.multiply(end.quaternion, rotations.conjugate(start.quaternion)))
    np.testing.assert_allclose(turn, expected[3:], atol=0.01)


def test_the_gripper_follows_the_sign(blind_c):
    blind_c.reset(seed=0, options={"tcp": FREE_SPACE})
    for command, width in ((-1.0, 0.0), (1.0, 0.08)):
        for _ in range(15):
            observation = blind_c.step([0, 0, 0, 0, 0, 0, command])[0]
        assert observation["proprio"][6] == pytest.approx(width, abs=4e-3)
        assert observation["proprio"][14] == command


def test_the_hand_lags_less_than_a_tenth_of_a_step(blind_c):
    rng, lags = np.random.default_rng(5), []
    for episode in range(4):
        blind_c.reset(seed=episode, options={"tcp": [0.0, -0.25, 0.70]})
        put_blocks_away(blind_c)
        action = np.zeros(7)
        for _ in range(15):
            action = 0.9 * action + 0.2 * rng.normal(size=7)
            blind_c.step(np.clip(action, -1, 1))
            tcp, target = blind_c.tcp_pose, blind_c.target_pose
            turn = rotations.to_rotvec(rotations.multiply(tcp.quaternion, rotations.conjugate(target.quaternion)))
            lags.append([np.linalg.norm(tcp.position - target.position), np.linalg.norm(turn)])
    assert (np.percentile(lags, 95, axis=0) < [2e-3, 0.02]).all()
    assert (np.max(lags, axis=0) < [4e-3, 0.03]).all()


def test_the_target_stays_near_the_hand_and_in_the_workspace(blind_c):
    blind_c.reset(seed=0, options={"tcp": [0.0, -0.15, 0.55]})
    for _ in range(30):
        blind_c.step([0, 0, -1, 0, 0, 0, -1])  # against the table
        assert np.linalg.norm(blind_c.target_pose.position - blind_c.tcp_position) < control.MAX_LEAD + 0.01
    assert blind_c.tcp_position[2] > table.TOP - 0.01  # the table holds
    low, high = blind_c.workspace
    for _ in range(30):
        blind_c.step([-1, 0, 1, 0, 0, 0, -1])
        position = blind_c.target_pose.position
        assert (position > low - 1e-6).all()
        assert (position < high + 1e-6).all()


def test_the_drawer_opens_and_shuts(blind):
    blind.reset(seed=5, options={"tcp": FREE_SPACE})
    blind.mj_data.joint("drawer").qpos = 0
    mujoco.mj_kinematics(blind.mj_model, blind.mj_data)
    hook = site(blind, "drawer_handle") + by(0, 0.037, 0.01)
    assert move_to(blind, [hook[0], hook[1], 0.55])
    assert move_to(blind, hook, speed=0.6)
    move_to(blind, hook - by(0, 0.15, 0), speed=0.6)
    assert joint(blind, "drawer") > 0.12
    move_to(blind, hook + by(0, 0.10, 0), speed=0.6)  # the hand pushes the front back
    assert joint(blind, "drawer") < 0.08


def test_the_door_slides(blind):
    blind.reset(seed=5, options={"tcp": FREE_SPACE})
    blind.mj_data.joint("door").qpos = blind.layout.door_travel / 2
    mujoco.mj_kinematics(blind.mj_model, blind.mj_data)
    handle = site(blind, "door_handle")
    assert move_to(blind, handle + by(0.05, -0.12, 0.10))
    move_to(blind, handle + by(0.05, 0, 0), steps=30)
    move_to(blind, handle - by(0.10, 0, 0), speed=0.5, steps=40)
    assert joint(blind, "door") > blind.layout.door_travel / 2 + 0.05


def test_the_button_toggles_the_led_once_a_press(blind):
    blind.reset(seed=5, options={"tcp": FREE_SPACE})
    put_blocks_away(blind)
    lit, top = blind.led_on, site(blind, "button_top")
    for _ in range(2):
        assert move_to(blind, top + by(0, 0, 0.08))
        move_to(blind, top - by(0, 0, 0.015), speed=0.4, steps=30)
        assert joint(blind, "button") > table.BUTTON_TRAVEL / 2
        assert blind.led_on is not lit
        assert blind.scene_obs()[5] == blind.led_on
        lit = blind.led_on
        move_to(blind, top + by(0, 0, 0.05), steps=30)
        assert joint(blind, "button") < 1e-3  # the spring brings it back
        assert blind.led_on is lit


def test_the_switch_lights_the_bulb(blind):
    blind.reset(seed=5, options={"tcp": FREE_SPACE})
    blind.mj_data.joint("switch").qpos = 0
    mujoco.mj_kinematics(blind.mj_model, blind.mj_data)
    tip = site(blind, "switch_tip")
    move_to(blind, [tip[0] * 0.9, -0.12, 0.50], steps=60)
    assert not blind.bulb_on
    move_to(blind, tip + by(0, 0, -0.03), speed=0.5, steps=50)
    move_to(blind, tip + by(0, 0.05, 0.09), speed=0.5, steps=50)
    assert blind.bulb_on
    assert blind.scene_obs()[4] == 1
    bulb = blind.mj_model.geom("bulb").rgba
    np.testing.assert_allclose(bulb, table.BULB_COLOURS[True], atol=1e-6)


@pytest.mark.parametrize("index", range(3))
def test_blocks_can_be_lifted_and_put_down(blind, index):
    blind.reset(seed=2, options={"tcp": FREE_SPACE})
    place = np.array([0.05, -0.06, table.TOP + table.BLOCK_SIDE / 2])
    put_blocks_away(blind)
    across = rotations.from_euler(np.array([0, 0, np.pi / 2]))  # the fingers close on its short side
    blind.mj_data.joint(table.BLOCKS[index]).qpos = [*place, *across]
    assert move_to(blind, place + by(0, 0, 0.1), gripper=1)
    assert move_to(blind, place, gripper=1, speed=0.5)
    for _ in range(12):
        blind.step([0, 0, 0, 0, 0, 0, -1])
    assert move_to(blind, place + by(0, 0, 0.12), speed=0.5)
    assert blind.scene_obs()[6 + 6 * index + 2] > place[2] + 0.1
    move_to(blind, place + by(0, 0, 0.01), speed=0.5)
    for _ in range(12):
        blind.step([0, 0, 0, 0, 0, 0, 1])
    assert move_to(blind, place + by(0, 0, 0.1), gripper=1)
    assert blind.scene_obs()[6 + 6 * index + 2] == pytest.approx(place[2], abs=3e-3)


def test_rest_is_calvins(blind_c):
    observation, _ = blind_c.reset(seed=0, options={"arm": "rest"})
    np.testing.assert_allclose(observation["proprio"][3:6], [3.090, -0.029, 1.501], atol=0.01)
    np.testing.assert_allclose(observation["proprio"][:2], [0.026, -0.232], atol=0.005)


def test_scenes_c_and_d_look_different():
    pictures = []
    for scene in "CD":
        env = TabletopEnv(scene, images=False)
        env.reset(seed=0)
        put_blocks_away(env)
        env.mj_data.qpos[env.kinematics.qpos_index] = [0.0, -1.5, 0, -2.5, 0, 1.5, 0]  # arm out of sight
        mujoco.mj_kinematics(env.mj_model, env.mj_data)
        wooden = np.isin(env.segmentation(), [env.mj_model.body(n).id for n in ("table", "drawer", "door")])
        pictures.append((env.view("static", 64).astype(float), wooden))
        env.close()
    both = pictures[0][1] & pictures[1][1]
    assert both.mean() > 0.5
    assert np.abs(pictures[0][0] - pictures[1][0])[both].mean() >= 20


def test_bad_input_is_named(blind_c):
    blind_c.reset(seed=0)
    cases = [
        (lambda: blind_c.step(np.full(7, np.nan)), "nan"),
        (lambda: blind_c.step(np.zeros(6)), r"\(6,\)"),
        (lambda: TabletopEnv("E"), "'E'"),
        (lambda: TabletopEnv("A", render_mode="human"), "human"),
        (lambda: TabletopEnv("A", image_size=0), "0"),
        (lambda: TabletopEnv("A", supersample=2), "2"),
        (lambda: blind_c.set_state(np.zeros(3)), r"\(3,\)"),
        (lambda: blind_c.reset(options={"hand": 1}), "hand"),
        (lambda: blind_c.reset(options={"arm": "up"}), "up"),
        (lambda: blind_c.reset(options={"tcp": [0, 0, 9]}), "9"),
        (lambda: blind_c.reset(options={"tcp": "x"}), "option tcp is 'x'; give 3 numbers"),
        (lambda: blind_c.reset(options={"tcp": [0.0, -0.1, 0.40]}), "inside"),
        (lambda: blind_c.reset(options={"tcp": [0.34, 0.10, 0.78]}), "reach"),
        (lambda: blind_c.view("top"), "top"),
    ]
    for act, named in cases:
        with pytest.raises(UsageError, match=named):
            act()


def test_actions_out_of_range_are_clipped(blind_c):
    ends = []
    for size in (1, 50):
        blind_c.reset(seed=0, options={"tcp": FREE_SPACE})
        blind_c.step(np.array([size, 0, 0, 0, 0, 0, size]))
        ends.append(blind_c.get_state())
    np.testing.assert_array_equal(*ends)
