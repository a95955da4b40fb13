"""Gymnasium environments, the static RGB-D camera, and ground truth from the simulator."""

from envs.gl import leaving_mujoco_gl_alone

with leaving_mujoco_gl_alone():  # a bad MUJOCO_GL is reported when something is to be drawn, not here
    import mujoco as mujoco
