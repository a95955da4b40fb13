"""RGB-D environments on MuJoCo; importing this registers them with Gymnasium under `t3vip/...`."""

import gymnasium

from envs.gl import import_mujoco

import_mujoco()  # first of all: whatever MUJOCO_GL says is judged when something is to be drawn

TABLETOP_STEPS = 240  # 8 s at 30 Hz

for _scene in "ABCD":
    gymnasium.register(
        id=f"t3vip/Tabletop{_scene}-v0",
        entry_point="envs.tabletop:TabletopEnv",
        max_episode_steps=TABLETOP_STEPS,
        kwargs={"scene": _scene},
    )

PLANAR_PUSH_STEPS = 60  # 5 s at 12 Hz

gymnasium.register(
    id="t3vip/PlanarPush-v0", entry_point="envs.planar_push:PlanarPushEnv", max_episode_steps=PLANAR_PUSH_STEPS
)

DEXHAND_STEPS = 100  # 4 s at 25 Hz

gymnasium.register(id="t3vip/DexHand-v0", entry_point="envs.dexhand:DexHandEnv", max_episode_steps=DEXHAND_STEPS)
