"""A Shadow Hand with a cube as a goal-conditioned Gymnasium environment, seen by one RGB-D camera that stands still."""

from __future__ import annotations

from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs.base import RENDER_MODES, RGBDEnv
from envs.dexhand import control, goals, placement
from envs.dexhand.scene import CONTROL_RATE, DEPTH_RANGES, FOR_PEOPLE, SUBSTEPS, build_model
from envs.errors import UsageError
from envs.rendering import VISIBLE_GROUPS

REWARDS = ("sparse", "dense")
SHOWN_GOAL_OFFSET = (0.0, 0.0, 0.11)  # m, from the goal to where people see it, above the hand


class DexHandEnv(RGBDEnv):
    """A Shadow Hand, palm up, turns a cube towards a goal pose. A dropped cube terminates the episode.

    Observation: `rgb` (H, W, 3) uint8, `depth` (H, W) float32 metres, `proprio` (24,) float32 joint angles, rad;
    `observation` (61,) float32: joint angles (24) and velocities (24), the cube's velocity (6) and pose (7);
    `achieved_goal` and `desired_goal` (7,) float32: the cube's pose, position (m) and unit quaternion wxyz, as it is
    and as it shall be. Action: (20,) in [-1, 1], targets of the actuated joints, -1 and 1 the ends of their ranges.

    `info`: `is_success`, `is_dropped`, `rotation_error` (rad), `position_error` (m), `joint_delta` (24,) how far each
    joint went in this step (rad), `goals_reached`, and `scene_obs` (14,): the pose of the cube, then of the goal. Where
    a new goal follows one that is reached, `info` is about the old one, the observation and the state have the new one.

    Args:
        goal_angle: the largest angle between the cube at the start and its goal, degrees; 180 for any goal.
        new_goals: whether a goal that is reached is followed by another.
        reward_type: "sparse" (0 where the goal is reached, -1 elsewhere) or "dense"; see `goals.reward`.
        image_size: height and width of the pictures, pixels.
        supersample: an odd number; pictures are drawn that many times wider and higher, then averaged.
        render_mode: what `render()` returns: "rgb_array", "depth_array" (metres) or "rgbd_tuple".
        images: whether observations hold `rgb` and `depth`; without them no OpenGL is needed.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": CONTROL_RATE}  # noqa: RUF012
    DEPTH_RANGES = DEPTH_RANGES
    RESET_OPTIONS = ("hand", "cube", "goal")
    OWN_STATE = 2  # seed of the goals, goals so far
    ACTION_AGGREGATION = control.ACTION_AGGREGATION
    control_rate = CONTROL_RATE

    def __init__(
        self,
        goal_angle: float = 180.0,
        new_goals: bool = False,
        reward_type: str = "sparse",
        image_size: int = 64,
        supersample: int = 3,
        render_mode: str | None = "rgb_array",
        images: bool = True,
    ) -> None:
        if reward_type not in REWARDS:
            raise UsageError(f"reward_type is {reward_type!r}; choose one of {', '.join(REWARDS)}")
        if not 0 < goal_angle <= 180:
            raise UsageError(f"goal_angle is {goal_angle!r}; give degrees above 0, up to 180")
        self.goal_angle, self.new_goals, self.reward_type = float(goal_angle), bool(new_goals), reward_type
        lengths = {"proprio": control.JOINTS, "observation": 2 * control.JOINTS + 6 + 7}
        lengths |= {"achieved_goal": 7, "desired_goal": 7}
        spaces = {name: gymnasium.spaces.Box(-np.inf, np.inf, (n,), np.float32) for name, n in lengths.items()}
        super().__init__(build_model(), control.ACTUATORS, spaces, image_size, supersample, render_mode, images)
        self.ACTION_SCALE = control.action_scale(self.mj_model)
        self._scratch: mujoco.MjData | None = None
        self._index_model()
        self._goal_seed, self._goals_reached = 0, 0

    # --- Gymnasium -------------------------------------------------------------------------------------------------

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Start an episode: a hand that is a bowl, more or less, a cube that lies in it somehow, and a random goal.

        Args:
            seed: makes everything that follows repeatable.
            options: any of `hand` (20,), the action that the hand has taken; `cube` (4,), the orientation that the cube
                is let go with, before it settles; `goal` (4,), an orientation. What is given is not drawn.

        Raises:
            UsageError: an unknown option, or a value that does not fit.
        """
        super().reset(seed=seed)
        options = self._check_options(options)
        placement.start(self.mj_model, self.mj_data, self.cube_qpos, options, self.np_random)
        self._goal_seed, self._goals_reached = int(self.np_random.integers(2**31)), 0
        if "goal" in options:
            self._set_goal(np.concatenate([goals.HOME, placement.unit_quaternion("goal", options["goal"])]))
        else:
            self._draw_goal()
        self._after_physics()
        return self.observation(), self._info(np.zeros(control.JOINTS))

    def step(self, action: ArrayLike):
        """Send the joints to their targets, simulate one control step of 1/25 s.

        Raises:
            UsageError: the action does not have 20 finite numbers.
        """
        self.mj_data.ctrl[:] = control.joint_targets(self.mj_model, control.check_action(action))
        before = self.joint_angles
        mujoco.mj_step(self.mj_model, self.mj_data, nstep=SUBSTEPS)
        self._after_physics()
        info = self._info(self.joint_angles - before)
        reward = float(self.compute_reward(self.cube_pose.astype(np.float32), self.goal.astype(np.float32), info))
        if info["is_success"] and self.new_goals:  # the reward is for the old one, the observation shows the new one
            self._goals_reached += 1
            info["goals_reached"] = self._goals_reached
            self._draw_goal()
            self._after_physics()  # the goal is a body, too
        return self.observation(), reward, info["is_dropped"], False, info

    def compute_reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any) -> NDArray[np.float32]:
        """The reward for cube poses (..., 7) under goals (..., 7), as hindsight relabelling asks for it: (...,).

        `info` is not looked at.
        """
        return goals.reward(achieved_goal, desired_goal, self.reward_type == "dense")

    # --- What others build on --------------------------------------------------------------------------------------

    @property
    def joint_angles(self) -> NDArray[np.float64]:
        """(24,) rad."""
        return self.mj_data.qpos[self.hand_qpos].copy()

    @property
    def cube_pose(self) -> NDArray[np.float64]:
        """Position, metres, and unit quaternion wxyz: (7,)."""
        return self.mj_data.qpos[self.cube_qpos].copy()

    @property
    def goal(self) -> NDArray[np.float64]:
        """The pose (7,) that the cube shall have."""
        return np.concatenate([self.mj_data.mocap_pos[0], self.mj_data.mocap_quat[0]])

    @property
    def last_action(self) -> NDArray[np.float64]:
        """The action (20,) that the joints are being sent by."""
        return control.actions_of(self.mj_model, self.mj_data.ctrl)

    @property
    def hand_body_ids(self) -> tuple[int, ...]:
        """Bodies of the hand, from the wrist to the fingertips."""
        parts = range(1, self.mj_model.nbody)
        robot = [i for i in parts if self.mj_model.body(i).name.startswith("robot0:")]
        return tuple(i for i in robot if self.mj_model.body(i).name not in ("robot0:hand mount", "robot0:forearm"))

    def scene_obs(self) -> NDArray[np.float64]:
        """The pose of the cube, then of the goal: (14,)."""
        return np.concatenate([self.cube_pose, self.goal])

    # --- Inside ----------------------------------------------------------------------------------------------------

    def _index_model(self) -> None:
        model = self.mj_model
        joint = model.joint("object:joint")
        place, velocity = int(joint.qposadr[0]), int(joint.dofadr[0])
        self.cube_qpos, self.cube_qvel = slice(place, place + 7), slice(velocity, velocity + 6)
        self.hand_qpos = self.hand_qvel = slice(0, control.JOINTS)
        assert (model.jnt_type[: control.JOINTS] == mujoco.mjtJoint.mjJNT_HINGE).all()

    def _draw_goal(self) -> None:
        """The next goal follows from the episode's seed and its number: a restored state goes on to the same."""
        rng = np.random.default_rng((self._goal_seed, self._goals_reached))
        self._set_goal(goals.draw_goal(self.cube_pose[3:], np.radians(self.goal_angle), rng))

    def _set_goal(self, pose: NDArray[np.float64]) -> None:
        self.mj_data.mocap_pos[0], self.mj_data.mocap_quat[0] = pose[:3], pose[3:]

    def _measurements(self) -> dict[str, NDArray]:
        data = self.mj_data
        joints, pose = data.qpos[self.hand_qpos], data.qpos[self.cube_qpos]
        state = np.concatenate([joints, data.qvel[self.hand_qvel], data.qvel[self.cube_qvel], pose])
        return {
            "proprio": joints.astype(np.float32),
            "observation": state.astype(np.float32),
            "achieved_goal": pose.astype(np.float32),
            "desired_goal": self.goal.astype(np.float32),
        }

    def _own_state(self) -> ArrayLike:
        return [self._goal_seed, self._goals_reached]

    def _set_own_state(self, own: NDArray[np.float64]) -> None:
        self._goal_seed, self._goals_reached = int(own[0]), int(own[1])

    def _visible_groups(self, camera: str) -> tuple[int, ...]:
        return VISIBLE_GROUPS if camera == "static" else (*VISIBLE_GROUPS, FOR_PEOPLE)

    def _shown_in(self, view: str) -> mujoco.MjData:
        """What a model sees in `static`; in `side`, also the goal as a second cube that hovers above the hand."""
        if view == "static":
            return self.mj_data
        data = self._scratch = mujoco.MjData(self.mj_model) if self._scratch is None else self._scratch
        data.qpos[:] = self.mj_data.qpos
        data.mocap_pos[:] = self.mj_data.mocap_pos + SHOWN_GOAL_OFFSET
        data.mocap_quat[:] = self.mj_data.mocap_quat
        mujoco.mj_kinematics(self.mj_model, data)
        mujoco.mj_camlight(self.mj_model, data)
        return data

    def _info(self, joint_delta: NDArray[np.float64]) -> dict[str, Any]:
        pose, goal = self.cube_pose, self.goal
        position, rotation = goals.distances(pose, goal)
        return {
            "is_success": bool(goals.is_reached(pose, goal)),
            "is_dropped": bool(goals.is_dropped(pose)),
            "rotation_error": float(rotation),
            "position_error": float(position),
            "joint_delta": joint_delta,
            "goals_reached": self._goals_reached,
            "scene_obs": self.scene_obs(),
        }
