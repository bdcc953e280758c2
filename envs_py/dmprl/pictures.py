"""Draws pictures of a MuJoCo state, without a display.

MuJoCo's own ``Renderer`` uses the OpenGL implementation that the environment variable ``MUJOCO_GL``
named when ``mujoco`` was first imported; the default needs a display. This module uses the first
implementation that works.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

OFFSCREEN = ("egl", "osmesa")
"""OpenGL without a display: EGL, on a graphics card or Mesa's CPU driver, and OSMesa, in memory."""
MAX_GEOMS = 1000


class NoOpenGLError(RuntimeError):
    """Raised if no OpenGL implementation works on this machine."""


class PictureMaker:
    """Draws states of one model into arrays."""

    def __init__(
        self, model: mujoco.MjModel, width: int, height: int, camera: Mapping[str, Any]
    ) -> None:
        """Opens an OpenGL context; ``camera`` contains settings of MuJoCo's free camera."""
        self._model = model
        self._gl = _context(width, height)
        self._gl.make_current()
        # A setting of the model, never reduced, because another maker may need a larger buffer.
        scale = model.vis.global_
        scale.offwidth = max(scale.offwidth, width)
        scale.offheight = max(scale.offheight, height)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        self._scene = mujoco.MjvScene(model, MAX_GEOMS)
        self._options = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(model, self._camera)
        for name, value in camera.items():
            if name == "lookat":
                self._camera.lookat[:] = value
            else:
                setattr(self._camera, name, value)

    def _draw(self, data: mujoco.MjData) -> None:
        # Another maker's context may be current.
        self._gl.make_current()
        mujoco.mjv_updateScene(
            self._model,
            data,
            self._options,
            None,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL,
            self._scene,
        )
        mujoco.mjr_render(self._viewport, self._scene, self._context)

    def rgb(self, data: mujoco.MjData) -> NDArray[np.uint8]:
        """Draws the picture (height, width, 3)."""
        self._draw(data)
        picture = np.zeros((self._viewport.height, self._viewport.width, 3), np.uint8)
        mujoco.mjr_readPixels(picture, None, self._viewport, self._context)
        return np.ascontiguousarray(picture[::-1])

    def depth(self, data: mujoco.MjData) -> NDArray[np.float32]:
        """Draws OpenGL's depth of each pixel (height, width), from 0 (near) to 1 (far)."""
        self._draw(data)
        depth = np.zeros((self._viewport.height, self._viewport.width), np.float32)
        mujoco.mjr_readPixels(None, depth, self._viewport, self._context)
        return np.ascontiguousarray(depth[::-1])

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()


def name_opengl() -> None:
    """Sets ``MUJOCO_GL``, which Gymnasium's renderer reads, to the first OpenGL that works."""
    if os.environ.get("MUJOCO_GL"):
        return
    for name in OFFSCREEN:
        try:
            importlib.import_module(f"mujoco.{name}").GLContext(8, 8).free()
        # If none works, drawing reports it; not every environment needs OpenGL.
        except Exception:
            continue
        os.environ["MUJOCO_GL"] = name
        return


def _context(width: int, height: int) -> Any:
    """Opens the OpenGL that ``MUJOCO_GL`` names, or the first that works."""
    requested = os.environ.get("MUJOCO_GL", "").lower()
    failures = []
    for name in (requested,) if requested else OFFSCREEN:
        try:
            return importlib.import_module(f"mujoco.{name}").GLContext(width, height)
        # The exception differs: a missing library, no device, a missing function.
        except Exception as error:
            failures.append(f"{name}: {type(error).__name__}: {error}")
    raise NoOpenGLError(
        f"no OpenGL to draw with ({'; '.join(failures)}). On Debian and Ubuntu: apt install "
        "libegl1 libgl1-mesa-dri, or libosmesa6. If MUJOCO_GL is set, no other one is tried"
    )
