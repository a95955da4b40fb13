"""The Panda's kinematics: forward for whole batches, inverse for one pose."""

from __future__ import annotations

import mujoco
import numpy as np
import scipy  # its parts load when they are used
from numpy.typing import NDArray

from envs import rotations
from envs.tabletop.control import Pose
from envs.tabletop.robot import ARM_JOINTS, REST_ARM

Array = NDArray[np.float64]


class ArmKinematics:
    """Kinematics of the site `tcp` as a function of the seven arm joints."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._data = mujoco.MjData(model)  # scratch
        joints = [model.joint(name).id for name in ARM_JOINTS]
        self.qpos_index = model.jnt_qposadr[joints]
        self._dof_index = model.jnt_dofadr[joints]
        self._range = model.jnt_range[joints]
        self._site = model.site("tcp").id
        chain, body = [], int(model.site_bodyid[self._site])
        while body:
            chain.append(body)
            body = int(model.body_parentid[body])
        self._chain = chain[::-1]
        self._joint_of_body = {int(model.jnt_bodyid[joint]): i for i, joint in enumerate(joints)}
        self._axes = model.jnt_axis[joints]

    def tcp(self, joints: Array) -> Pose:
        """Pose of the tool centre point for joint angles (..., 7), radians."""
        model = self._model
        position = np.zeros((*joints.shape[:-1], 3))
        quaternion = np.broadcast_to([1.0, 0, 0, 0], (*joints.shape[:-1], 4))
        for body in self._chain:
            position = position + rotations.rotate(quaternion, model.body_pos[body])
            quaternion = rotations.multiply(quaternion, model.body_quat[body])
            joint = self._joint_of_body.get(body)
            if joint is not None:
                turn = rotations.from_rotvec(joints[..., joint : joint + 1] * self._axes[joint])
                quaternion = rotations.multiply(quaternion, turn)
        position = position + rotations.rotate(quaternion, model.site_pos[self._site])
        quaternion = rotations.multiply(quaternion, model.site_quat[self._site])
        return Pose(position, quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True))

    def solve(self, pose: Pose, start: Array | None = None, tolerance: float = 5e-4) -> Array | None:
        """Joint angles (7,) that put the tool centre point there, the posture as near to rest as it can be.

        Args:
            pose: where, one pose.
            start: where the search starts; the rest posture when None.
            tolerance: greatest error, metres and radians.

        Returns:
            None where the pose is out of reach, 0.05 rad kept from every joint limit.
        """
        rest = np.array(REST_ARM)
        low, high = self._range[:, 0] + 0.05, self._range[:, 1] - 0.05
        weights = np.repeat([10.0, 4.0, 0.02], [3, 3, 7])  # position, orientation, posture

        def residuals(joints: Array) -> Array:
            return weights * np.concatenate([self._error(joints, pose), joints - rest])

        def jacobian(joints: Array) -> Array:
            return weights[:, None] * np.concatenate([-self._jacobian(joints), np.eye(7)])

        found = scipy.optimize.least_squares(
            residuals, rest if start is None else start, jacobian, bounds=(low, high), max_nfev=60, xtol=1e-6, ftol=1e-7
        )
        return found.x if np.linalg.norm(self._error(found.x, pose)) < tolerance else None

    def _jacobian(self, joints: Array) -> Array:
        self._place(joints)
        mujoco.mj_comPos(self._model, self._data)
        jacobian = np.zeros((6, self._model.nv))
        mujoco.mj_jacSite(self._model, self._data, jacobian[:3], jacobian[3:], self._site)
        return jacobian[:, self._dof_index]

    def _error(self, joints: Array, pose: Pose) -> Array:
        self._place(joints)
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, self._data.site_xmat[self._site])
        turn = rotations.to_rotvec(rotations.multiply(pose.quaternion, rotations.conjugate(quaternion)))
        return np.concatenate([pose.position - self._data.site_xpos[self._site], turn])

    def _place(self, joints: Array) -> None:
        self._data.qpos[self.qpos_index] = joints
        mujoco.mj_kinematics(self._model, self._data)
