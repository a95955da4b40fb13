"""Which OpenGL draws, and what is said where none does."""

import ctypes
import os
import subprocess
import sys

import pytest

from envs import gl
from envs.errors import UsageError


def test_no_opengl_names_the_packages(monkeypatch):
    def missing(*names):
        raise OSError(f"{names[0]} is not installed")

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(gl, "_load", missing)
    with pytest.raises(
        UsageError, match=r"libEGL.so.1.*libOSMesa.*apt-get install libegl1 libgl1-mesa-dri.*libosmesa6"
    ):
        gl.create_context()


def test_osmesa_stands_in_for_an_egl_without_devices():
    try:
        ctypes.CDLL("libOSMesa.so.8")
    except OSError:
        pytest.skip(f"libOSMesa.so.8 is not installed, so nothing can stand in for EGL; {gl.REMEDY}")
    program = """
from envs import check_rendering, gl
def fail(self):
    raise RuntimeError("no devices")
gl.EGLContext._initialised_display = fail
print(check_rendering.check(64, 1, 0.1).renderer)
"""
    environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    result = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=60
    )
    assert result.stdout.startswith("osmesa: "), result.stdout + result.stderr


@pytest.mark.parametrize("value", ["bogus", "glfw", "off"])
def test_command_refuses_a_bad_mujoco_gl_in_one_line(value):
    result = subprocess.run(
        [sys.executable, "-m", "envs.check_rendering"],
        env=os.environ | {"MUJOCO_GL": value},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert result.returncode == 2 and result.stdout == ""
    assert result.stderr.count("\n") == 1 and repr(value) in result.stderr and "egl or osmesa" in result.stderr


@pytest.mark.parametrize("value", ["bogus", "egl"])
def test_what_draws_nothing_imports_whatever_mujoco_gl_says(value):
    program = """
import sys
sys.modules["mujoco.egl"] = None  # as where EGL is not installed
import envs.rendering, mujoco, os
print(os.environ["MUJOCO_GL"], mujoco.MjModel.from_xml_string("<mujoco/>").nbody)
"""
    environment = os.environ | {"MUJOCO_GL": value}
    result = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=60
    )
    assert result.stdout.split() == [value, "1"], result.stderr


def test_environments_made_in_several_threads_at_once_leave_mujoco_gl_alone():
    program = """
import os
from concurrent.futures import ThreadPoolExecutor
import gymnasium as gym
import envs
def brightness(_):
    with gym.make("t3vip/PlanarPush-v0") as env:
        return int(env.reset(seed=3)[0]["rgb"].sum())
before = os.environ.get("MUJOCO_GL")
with ThreadPoolExecutor(4) as threads:
    print(len(set(threads.map(brightness, range(4)))), os.environ.get("MUJOCO_GL") == before)
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert result.stdout.split() == ["1", "True"], result.stderr
