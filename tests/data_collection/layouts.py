"""The public layouts, written as their publishers describe them and with nothing of the importers: small pictures of a
bright square that moves before a wall."""

import numpy as np
from PIL import Image

CALVIN_CONFIG = """\
recording: true
seed: 42
env:
  _target_: calvin_env.envs.play_table_env.PlayTableSimEnv
  bullet_time_step: 240.0
  control_freq: {rate}
scene:
  _target_: calvin_env.scene.play_table_scene.PlayTableScene
  name: {scene}
  data_path: ${{env.data_path}}
cameras:
  static:
    _target_: calvin_env.camera.static_camera.StaticCamera
    name: static
    fov: 10
    aspect: 1
    nearval: 0.01
    farval: 10
    width: {size}
    height: {size}
    look_at: [-0.026242351159453392, -0.0302329882979393, 0.3920000493526459]
    look_from: [2.871459009488717, -2.166602199425597, 2.555159848480571]
    up_vector: [0.4041403970338857, 0.22629790978217404, 0.8862616969685161]
  gripper:
    _target_: calvin_env.camera.gripper_camera.GripperCamera
    name: gripper
    fov: 75
    aspect: 1
"""


def square(size, place, far, near):
    """(rgb uint8 (size, size, 3), depth float64 (size, size) metres): a grainy square at column `place` of a wall."""
    depth = np.full((size, size), far)
    rgb = np.random.default_rng(7).integers(40, 90, (size, size, 3))
    rows = slice(size // 4, size // 2)
    depth[rows, place : place + size // 4] = near
    rgb[rows, place : place + size // 4] += 150
    return rgb.astype(np.uint8), depth


def calvin_frame(number, rng, size=40):
    """The arrays of a frame, as CALVIN's recorder names and types them."""
    rgb, depth = square(size, 3 + number % (size // 2), 4.6, 4.1)
    tcp = np.array([0.02 + 0.004 * number, -0.2, 0.5])
    gripper = 1.0 if number // 5 % 2 else -1.0
    return {
        "rgb_static": rgb,
        "rgb_gripper": rng.integers(0, 255, (21, 21, 3), dtype=np.uint8),
        "rgb_tactile": np.zeros((40, 30, 6), np.uint8),
        "depth_static": depth.astype(np.float32),
        "depth_gripper": np.full((21, 21), 0.3, np.float32),
        "depth_tactile": np.zeros((40, 30, 2), np.float32),
        "actions": np.r_[tcp + np.array([0.004, 0, 0]), 0, 0, 0, gripper],
        "rel_actions": np.r_[0.2, 0, 0, rng.uniform(-0.5, 0.5, 3), gripper],
        "robot_obs": np.r_[tcp, 0.1, 0.2, 0.3, 0.04, rng.uniform(-2, 2, 7), gripper],
        "scene_obs": np.r_[rng.uniform(0, 0.2, 24)],
    }


def write_calvin(root, episodes=((0, 24), (30, 44)), split="training", size=40, rate=30, scene="calvin_scene_D"):
    """`root/split` with one npz a frame; returns that folder."""
    folder = root / split
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "merged_config.yaml").write_text(CALVIN_CONFIG.format(size=size, rate=rate, scene=scene))
    np.save(folder / "ep_start_end_ids.npy", np.array(episodes))
    np.save(folder / "ep_lens.npy", np.array([last - first + 1 for first, last in episodes]))
    rng = np.random.default_rng(0)
    for first, last in episodes:
        for number in range(first, last + 1):
            np.savez_compressed(folder / f"episode_{number:07d}.npz", **calvin_frame(number, rng, size))
    return folder


def change_frame(folder, number, **changed):
    """Replace arrays of a CALVIN frame; None drops one."""
    path = folder / f"episode_{number:07d}.npz"
    with np.load(path) as file:
        arrays = {**dict(file), **changed}
    np.savez_compressed(path, **{name: values for name, values in arrays.items() if values is not None})


def write_png(path, values):
    """A colour picture, or a 16 bit one."""
    Image.fromarray(values).save(path)


def write_intrinsics(root, size):
    root.mkdir(parents=True, exist_ok=True)
    values = [1.2 * size, 1.1 * size, size / 2 - 1, size / 2 + 1, 0, 0, 1, 1]
    names = "fx fy cx cy offx offy sx sy"
    (root / "intrinsics.txt").write_text(f"{names}\n{' '.join(map(str, values))}\n")


def write_pictures(folder, frames, size, far, near, png_far):
    folder.mkdir(parents=True)
    for i in range(frames):
        rgb, depth = square(size, 2 + i % (size // 2), far, near)
        write_png(folder / f"rgbsub{i}.png", rgb)
        write_png(folder / f"depthsub{i}.png", np.round(depth / png_far * 65535).astype(np.uint16))


def write_dexhand(root, episodes=3, frames=25, split="training", size=40):
    """Folders `root/split/0`, `1`, ... ; returns the root."""
    write_intrinsics(root, size)
    for number in range(episodes):
        folder = root / split / str(number)
        write_pictures(folder, frames, size, 1.2, 1.0, 10.0)
        for i in range(frames):
            joints = np.linspace(-1, 1, 24) + 0.01 * i + number
            (folder / f"joints{i}.txt").write_text(" ".join(f"{joint:.8f}" for joint in joints))
    return root


def write_omnipush(
    root, objects=("1a1a2a3a", "1a2a3a4a"), pushes=2, frames=12, split="train", size=48, intrinsics=True
):
    """Folders `root/split/<object>/<push>`; returns the root."""
    if intrinsics:
        write_intrinsics(root, size)
    for name in objects:
        for push in range(pushes):
            folder = root / split / name / str(push)
            write_pictures(folder, frames, size, 1.1, 1.0, 1.2)
            tip = np.stack([np.linspace(0.3, 0.4, frames), np.full(frames, -0.1), np.full(frames, 0.5)], axis=1)
            np.save(folder / "actions.npy", tip)
    return root
