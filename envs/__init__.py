"""RGB-D environments on MuJoCo; importing this registers them with Gymnasium under `t3vip/...`."""

import gymnasium

from envs.gl import leaving_mujoco_gl_alone

with leaving_mujoco_gl_alone():  # a bad MUJOCO_GL is reported when something is to be drawn, not by `import mujoco`
    import mujoco as mujoco

TABLETOP_STEPS = 240  # 8 s at 30 Hz

for _scene in "ABCD":
    gymnasium.register(
        id=f"t3vip/Tabletop{_scene}-v0",
        entry_point="envs.tabletop:TabletopEnv",
        max_episode_steps=TABLETOP_STEPS,
        kwargs={"scene": _scene},
    )
