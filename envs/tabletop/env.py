"""The play table as a Gymnasium environment with CALVIN's actions, observations and rates."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs import rotations
from envs.base import RENDER_MODES, RGBDEnv
from envs.errors import UsageError
from envs.tabletop import control, placement, table
from envs.tabletop.control import Pose
from envs.tabletop.kinematics import ArmKinematics
from envs.tabletop.layouts import layout
from envs.tabletop.robot import FINGER_JOINTS, FINGER_TRAVEL
from envs.tabletop.scene import CONTROL_RATE, SIDE_DEPTH_RANGE, STATIC_DEPTH_RANGE, SUBSTEPS, build_model

FIXTURES = ("door", "drawer", "button", "switch")  # CALVIN's order in scene_obs


class TabletopEnv(RGBDEnv):
    """A Panda arm at a play table; there is no task: the reward is 0 and nothing terminates.

    Observation: `rgb` (H, W, 3) uint8, `depth` (H, W) float32 metres, `proprio` (15,) float32: position of the tool
    centre point (m), its Euler angles xyz (rad), gripper width (m), seven joint angles (rad), last gripper action.
    Action: (7,) in [-1, 1]: 0.02 m along and 0.05 rad about the world's x, y, z, relative to the target pose, and the
    gripper: open from 0 upwards, else closed. `info["scene_obs"]` (24,): door, drawer, button, switch, bulb, LED, then
    position and Euler angles of the red, blue and pink block.

    Args:
        scene: "A", "B", "C" or "D".
        image_size: height and width of the pictures, pixels.
        supersample: an odd number; pictures are drawn that many times wider and higher, then averaged.
        render_mode: what `render()` returns: "rgb_array", "depth_array" (metres) or "rgbd_tuple".
        images: whether observations hold `rgb` and `depth`; without them no OpenGL is needed.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": CONTROL_RATE}  # noqa: RUF012
    DEPTH_RANGES: ClassVar[dict[str, tuple[float, float]]] = {"static": STATIC_DEPTH_RANGE, "side": SIDE_DEPTH_RANGE}
    RESET_OPTIONS = ("arm", "tcp")
    HAND_BODIES = ("right_gripper", "leftfinger", "rightfinger", "finger_joint1_tip", "finger_joint2_tip")
    OWN_STATE = 2  # LED, button
    ACTION_AGGREGATION = control.ACTION_AGGREGATION
    ACTION_SCALE = control.ACTION_SCALE
    SIGNS = control.SIGNS
    control_rate = CONTROL_RATE

    def __init__(
        self,
        scene: str = "C",
        image_size: int = 64,
        supersample: int = 3,
        render_mode: str | None = "rgb_array",
        images: bool = True,
    ) -> None:
        bound = np.repeat(np.array([2, 3.15, 0.1, 4, 1], np.float32), [3, 3, 1, 7, 1])  # m, rad, m, rad, sign
        proprio = gymnasium.spaces.Box(-bound, bound, dtype=np.float32)
        self.scene, self.layout = scene, layout(scene)
        super().__init__(build_model(scene), 7, {"proprio": proprio}, image_size, supersample, render_mode, images)
        self.kinematics = ArmKinematics(self.mj_model)
        self.led_on = False
        self._button_down = False
        self._index_model()

    # --- Gymnasium -------------------------------------------------------------------------------------------------

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Start an episode: random blocks, fixtures and LED, the hand anywhere over the table.

        Args:
            seed: makes everything that follows repeatable.
            options: `{"arm": "rest"}` starts in CALVIN's rest posture; `{"tcp": [x, y, z]}` at a place, gripper down.

        Raises:
            UsageError: an unknown option, or a place that the arm cannot take.
        """
        super().reset(seed=seed)
        options = self._check_options(options)
        mujoco.mj_resetData(self.mj_model, self.mj_data)
        rng = self.np_random
        self.led_on, self._button_down = bool(rng.integers(2)), False
        placement.place_fixtures(self.mj_data, self.layout, rng)
        placement.place_blocks(self.mj_data, self.layout, rng)
        self.mj_data.qpos[self._finger_qpos] = [FINGER_TRAVEL, -FINGER_TRAVEL]
        self._command_gripper(1.0)
        self._place_arm(options, rng)
        mujoco.mj_kinematics(self.mj_model, self.mj_data)
        self._set_target(self.tcp_pose, np.zeros(6))
        self._after_physics()
        return self.observation(), self._info()

    def step(self, action: ArrayLike):
        """Move the target pose, simulate one control step of 1/30 s.

        Raises:
            UsageError: the action does not have 7 finite numbers.
        """
        checked = control.check_action(action)
        start = self.target_pose
        end = control.advance(start, self.tcp_pose, checked)
        self._set_target(start, control.velocity(start, end))
        self._command_gripper(checked[6])
        mujoco.mj_step(self.mj_model, self.mj_data, nstep=SUBSTEPS)
        self._after_physics()
        return self.observation(), 0.0, False, False, self._info()

    # --- What others build on --------------------------------------------------------------------------------------

    @property
    def tcp_position(self) -> NDArray[np.float64]:
        """Measured position (3,) of the tool centre point between the finger pads, metres."""
        return self.tcp_pose.position

    @property
    def tcp_pose(self) -> Pose:
        """Measured pose of the tool centre point."""
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, self.mj_data.site_xmat[self._tcp_site])
        return Pose(self.mj_data.site_xpos[self._tcp_site].copy(), quaternion)

    @property
    def target_pose(self) -> Pose:
        """The pose that the hand is pulled to."""
        qpos = self.mj_data.qpos[self.target_qpos]
        return Pose(qpos[:3].copy(), qpos[3:].copy())

    @property
    def workspace(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest corner (3,) of the box that the target position is clipped to, metres."""
        return control.WORKSPACE_LOW.copy(), control.WORKSPACE_HIGH.copy()

    @property
    def bulb_on(self) -> bool:
        """Whether the switch is in its upper half."""
        return bool(self._fixture("switch") > table.SWITCH_TRAVEL / 2)

    def scene_obs(self) -> NDArray[np.float64]:
        """CALVIN's scene observation (24,): fixtures, lamps, then position (m) and Euler angles (rad) of the blocks."""
        blocks = self.mj_data.qpos[self._block_qpos]  # (3, 7)
        poses = np.concatenate([blocks[:, :3], rotations.to_euler(blocks[:, 3:])], axis=1)
        return np.concatenate([self.mj_data.qpos[self._fixture_qpos], [self.bulb_on, self.led_on], poses.ravel()])

    # --- Inside ----------------------------------------------------------------------------------------------------

    def _index_model(self) -> None:
        model = self.mj_model
        self._tcp_site = model.site("tcp").id
        target, fingers = model.joint("target"), [model.joint(name) for name in FINGER_JOINTS]
        self.target_qpos = slice(target.qposadr[0], target.qposadr[0] + 7)
        self.target_dofs = slice(target.dofadr[0], target.dofadr[0] + 6)
        self._finger_qpos = [int(finger.qposadr[0]) for finger in fingers]
        self.finger_ctrl = [model.actuator(f"gripper_{name}").id for name in FINGER_JOINTS]
        self._fixture_qpos = [int(model.joint(name).qposadr[0]) for name in FIXTURES]
        self._block_qpos = np.array([model.joint(name).qposadr[0] + np.arange(7) for name in table.BLOCKS])
        self._lamps = {name: model.geom(name).id for name in ("led", "bulb")}

    def _place_arm(self, options: dict[str, Any], rng: np.random.Generator) -> None:
        arm = options.get("arm", "random")
        if arm not in ("random", "rest"):
            raise UsageError(f"option arm is {arm!r}; choose random or rest")
        if "tcp" in options:
            placement.place_arm_at(self.mj_model, self.mj_data, self.kinematics, options["tcp"])
        elif arm == "rest":
            placement.place_arm_at_rest(self.mj_data, self.kinematics)
        else:
            placement.place_arm(self.mj_model, self.mj_data, self.kinematics, rng)

    def _set_target(self, pose: Pose, velocity: NDArray[np.float64]) -> None:
        self.mj_data.qpos[self.target_qpos] = np.concatenate([pose.position, pose.quaternion])
        self.mj_data.qvel[self.target_dofs] = velocity

    def _command_gripper(self, command: float) -> None:
        self.mj_data.ctrl[self.finger_ctrl] = control.finger_targets(command)

    def _after_physics(self) -> None:
        """As everywhere; then the lamps."""
        super()._after_physics()
        was_down, self._button_down = self._button_down, self._fixture("button") > table.BUTTON_TRAVEL / 2
        if self._button_down and not was_down:
            self.led_on = not self.led_on
        self.mj_model.geom_rgba[self._lamps["led"]] = table.LED_COLOURS[self.led_on]
        self.mj_model.geom_rgba[self._lamps["bulb"]] = table.BULB_COLOURS[self.bulb_on]

    def _fixture(self, name: str) -> float:
        return float(self.mj_data.qpos[self._fixture_qpos[FIXTURES.index(name)]])

    def _measurements(self) -> dict[str, NDArray]:
        tcp, fingers = self.tcp_pose, self.mj_data.qpos[self._finger_qpos]
        joints = self.mj_data.qpos[self.kinematics.qpos_index]
        last_gripper = 1.0 if self.mj_data.ctrl[self.finger_ctrl[0]] > 0 else -1.0
        width = fingers[0] - fingers[1]
        values = [tcp.position, rotations.to_euler(tcp.quaternion), [width], joints, [last_gripper]]
        return {"proprio": np.concatenate(values).astype(np.float32)}

    def _own_state(self) -> ArrayLike:
        return [self.led_on, self._button_down]

    def _set_own_state(self, own: NDArray[np.float64]) -> None:
        self.led_on, self._button_down = bool(own[0]), bool(own[1])

    def _info(self) -> dict[str, Any]:
        return {"scene_obs": self.scene_obs()}
