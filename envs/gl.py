"""OpenGL without a display: an EGL context where that works, else OSMesa; `MUJOCO_GL` decides where it is set.

The contexts are made through ctypes. MuJoCo's own come through PyOpenGL, which binds one platform for the life of the
process, so that a failing EGL could no longer fall back on OSMesa.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import os
import threading
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

from envs.errors import UsageError

REMEDY = "install software OpenGL: apt-get install libegl1 libgl1-mesa-dri (EGL) or apt-get install libosmesa6 (OSMesa)"

_CHOOSES_ITSELF = ("", "enable", "enabled", "on", "true", "1")
_SWITCHED_OFF = ("disable", "disabled", "off", "false", "0")
_GL_RENDERER = 0x1F01
_mujoco_gl_borrowed = threading.RLock()  # held by the thread that has set `MUJOCO_GL` to what the user did not


def import_mujoco() -> None:
    """`import mujoco`, even where `MUJOCO_GL` names something unknown or not installed.

    MuJoCo raises at import then. A user who draws nothing need not care, and one who does is told by `create_context`.
    """
    try:
        importlib.import_module("mujoco")
    except (RuntimeError, AttributeError, ImportError):
        if "MUJOCO_GL" not in os.environ:
            raise
        with mujoco_gl(None):
            importlib.import_module("mujoco")


@contextlib.contextmanager
def mujoco_gl(value: str | None) -> Iterator[None]:
    """`MUJOCO_GL` as some library is to find it in the block (None: not set); no context is created meanwhile."""
    with _mujoco_gl_borrowed:
        wish = os.environ.pop("MUJOCO_GL", None)
        if value is not None:
            os.environ["MUJOCO_GL"] = value
        try:
            yield
        finally:
            os.environ.pop("MUJOCO_GL", None)
            if wish is not None:
                os.environ["MUJOCO_GL"] = wish


class OffscreenContext(ABC):
    """An OpenGL context that no window belongs to."""

    backend: ClassVar[str]
    """How it is made, as `MUJOCO_GL` names it."""
    _context: int | None = None
    _alive: ClassVar[weakref.WeakValueDictionary[int, OffscreenContext]] = weakref.WeakValueDictionary()

    @abstractmethod
    def make_current(self) -> None:
        """Send this thread's OpenGL calls here."""

    @abstractmethod
    def gl_renderer(self) -> str:
        """GL_RENDERER: what draws, e.g. `llvmpipe (LLVM 15.0.6, 256 bits)`."""

    @abstractmethod
    def free(self) -> None:
        """Give the context back; it cannot be used afterwards."""

    @abstractmethod
    def _current(self) -> int | None:
        """The context that this thread's OpenGL calls go to."""

    @contextlib.contextmanager
    def in_passing(self) -> Iterator[None]:
        """Send this thread's OpenGL calls here in the block, and afterwards to where they went before."""
        before = self._alive.get(self._current() or 0)
        self.make_current()
        try:
            yield
        finally:
            if before is not None and before._context:  # the block may have freed it
                before.make_current()


class EGLContext(OffscreenContext):
    """A context on the first EGL device that works, or on the one that `MUJOCO_EGL_DEVICE_ID` names."""

    backend = "egl"

    def __init__(self) -> None:
        self._egl = _load("libEGL.so.1")
        self._display = self._initialised_display()
        wanted = (0x3024, 8, 0x3023, 8, 0x3022, 8, 0x3021, 8, 0x3025, 24, 0x3033, 1, 0x3040, 8, 0x3038)
        # RGBA8, 24 bits of depth, pbuffer surfaces, desktop OpenGL, end of list
        attributes = (ctypes.c_int * len(wanted))(*wanted)
        config, count = ctypes.c_void_p(), ctypes.c_int()
        display = ctypes.c_void_p(self._display)
        self._egl.eglChooseConfig(display, attributes, ctypes.byref(config), 1, ctypes.byref(count))
        if count.value < 1:
            raise RuntimeError("EGL offers no framebuffer with colour, depth and desktop OpenGL")
        self._egl.eglBindAPI(0x30A2)  # EGL_OPENGL_API
        self._egl.eglCreateContext.restype = ctypes.c_void_p
        self._context = self._egl.eglCreateContext(display, config, None, None)
        if not self._context:
            raise RuntimeError("EGL makes no OpenGL context")
        self._egl.eglGetCurrentContext.restype = ctypes.c_void_p
        self._alive[self._context] = self
        _show_to_mujoco(self._egl)

    def _initialised_display(self) -> int:
        count = ctypes.c_int()
        query = self._extension("eglQueryDevicesEXT", ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
        query(0, None, ctypes.byref(count))
        devices = (ctypes.c_void_p * max(count.value, 1))()
        query(count.value, devices, ctypes.byref(count))
        candidates = list(devices[: count.value])
        wish = os.environ.get("MUJOCO_EGL_DEVICE_ID")
        if wish is not None:
            if not wish.isdigit() or int(wish) >= len(candidates):
                raise UsageError(
                    f"MUJOCO_EGL_DEVICE_ID is {wish!r} but EGL has {len(candidates)} devices; unset it, or give a"
                    " number from 0 below that"
                )
            candidates = [candidates[int(wish)]]
        get_display = self._extension(
            "eglGetPlatformDisplayEXT", ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p
        )
        for device in candidates:
            display = get_display(0x313F, device, None)  # EGL_PLATFORM_DEVICE_EXT
            if display and self._egl.eglInitialize(ctypes.c_void_p(display), None, None):
                return display
        raise RuntimeError(f"none of {len(candidates)} EGL devices can be initialised")

    def _extension(self, name: str, result: type, *arguments: type) -> Callable[..., Any]:
        self._egl.eglGetProcAddress.restype = ctypes.c_void_p
        address = self._egl.eglGetProcAddress(name.encode())
        if not address:
            raise RuntimeError(f"EGL has no {name}")
        return ctypes.CFUNCTYPE(result, *arguments)(address)

    def make_current(self) -> None:
        if self._current() == self._context:
            return
        display, context = ctypes.c_void_p(self._display), ctypes.c_void_p(self._context)
        self._egl.eglBindAPI(0x30A2)
        if not self._egl.eglMakeCurrent(display, None, None, context):
            raise RuntimeError("this EGL context cannot be made current; is it in use in another thread?")

    def gl_renderer(self) -> str:
        self.make_current()
        return _text(self._extension("glGetString", ctypes.c_char_p, ctypes.c_uint)(_GL_RENDERER))

    def free(self) -> None:
        if self._context:
            display = ctypes.c_void_p(self._display)
            if self._current() == self._context:
                self._egl.eglMakeCurrent(display, None, None, None)
            self._alive.pop(self._context, None)
            self._egl.eglDestroyContext(display, ctypes.c_void_p(self._context))
        self._context = None

    def _current(self) -> int | None:
        return self._egl.eglGetCurrentContext()


class OSMesaContext(OffscreenContext):
    """A context that draws in memory, in software, without any device."""

    backend = "osmesa"

    def __init__(self) -> None:
        self._osmesa = _load("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")
        self._osmesa.OSMesaCreateContextExt.restype = ctypes.c_void_p
        self._osmesa.OSMesaGetCurrentContext.restype = ctypes.c_void_p
        self._context = self._osmesa.OSMesaCreateContextExt(0x1908, 24, 8, 0, None)  # GL_RGBA, depth, stencil bits
        if not self._context:
            raise RuntimeError("OSMesa makes no context")
        self._buffer = (ctypes.c_ubyte * 4)()  # the default framebuffer, never drawn to: MuJoCo makes its own
        self._alive[self._context] = self
        _show_to_mujoco(self._osmesa)

    def make_current(self) -> None:
        if self._current() == self._context:
            return
        if not self._osmesa.OSMesaMakeCurrent(ctypes.c_void_p(self._context), self._buffer, 0x1401, 1, 1):
            raise RuntimeError("this OSMesa context cannot be made current")

    def gl_renderer(self) -> str:
        self.make_current()
        self._osmesa.OSMesaGetProcAddress.restype = ctypes.c_void_p
        address = self._osmesa.OSMesaGetProcAddress(b"glGetString")
        return _text(ctypes.CFUNCTYPE(ctypes.c_char_p, ctypes.c_uint)(address)(_GL_RENDERER))

    def free(self) -> None:
        if self._context:
            if self._current() == self._context:
                self._osmesa.OSMesaMakeCurrent(None, None, 0, 0, 0)
            self._alive.pop(self._context, None)
            self._osmesa.OSMesaDestroyContext(ctypes.c_void_p(self._context))
        self._context = None

    def _current(self) -> int | None:
        return self._osmesa.OSMesaGetCurrentContext()


def create_context() -> OffscreenContext:
    """The context to draw in: EGL, else OSMesa; only the one that `MUJOCO_GL` names where it names one.

    Raises:
        UsageError: `MUJOCO_GL` is nonsense, or no OpenGL works; says what to install.
    """
    with _mujoco_gl_borrowed:
        wish = os.environ.get("MUJOCO_GL", "")
    name = wish.lower().strip()
    if name in _SWITCHED_OFF:
        raise UsageError(f"rendering is switched off by MUJOCO_GL={wish!r}; unset it, or set it to egl or osmesa")
    if name not in _CHOOSES_ITSELF and name not in ("egl", "osmesa"):
        raise UsageError(f"MUJOCO_GL is {wish!r}; unset it, or set it to egl or osmesa: nothing else draws off screen")
    # Mesa starts a thread per core by itself; then workers fight for the cores, and "frames/s per core" means nothing.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    failures = []
    for kind in (EGLContext, OSMesaContext):
        if name in ("egl", "osmesa") and kind.backend != name:
            continue
        try:
            return kind()
        except (OSError, AttributeError, RuntimeError) as error:
            failures.append(f"{kind.backend}: {error}")
    asked = f" (MUJOCO_GL={wish})" if name in ("egl", "osmesa") else ""
    raise UsageError(f"no OpenGL works{asked} [{'; '.join(failures)}]; {REMEDY}")


def _load(*names: str) -> ctypes.CDLL:
    """The first of these libraries that is there."""
    for name in names:
        with contextlib.suppress(OSError):
            return ctypes.CDLL(name)
    raise OSError(f"{names[0]} is not installed")


def _show_to_mujoco(library: ctypes.CDLL) -> None:
    """Let MuJoCo's loader of OpenGL functions see a library that works.

    Not before it has shown to work: the loader would ask a lifeless EGL rather than the OSMesa that stands in for it.
    """
    ctypes.CDLL(library._name, mode=ctypes.RTLD_GLOBAL)


def _text(value: bytes | None) -> str:
    return (value or b"unknown").decode()


def gl_renderer() -> str:
    """What draws in this process and how, for a dataset's attributes: e.g. `egl: llvmpipe (LLVM 15.0.6, 256 bits)`.

    Raises:
        UsageError: no OpenGL works.
    """
    context = create_context()
    try:
        return f"{context.backend}: {context.gl_renderer()}"
    finally:
        context.free()
