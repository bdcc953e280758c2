"""Loads the models of the tasks."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import mujoco


def own_model(name: str) -> mujoco.MjModel:
    """Compiles a model in this folder."""
    return mujoco.MjModel.from_xml_path(str(Path(__file__).parent / name))


def own_model_without_decoration(name: str) -> mujoco.MjModel:
    """Compiles a model in this folder without its visual geoms.

    A simulation moves every geom in every step, but visual geoms do not affect its state.
    """
    specification = mujoco.MjSpec.from_file(str(Path(__file__).parent / name))
    specification.compiler.discardvisual = True
    return specification.compile()


def gymnasium_model(name: str) -> mujoco.MjModel:
    """Compiles a model from Gymnasium's package."""
    return mujoco.MjModel.from_xml_path(str(_gymnasium_file(name)))


def gymnasium_picture_model(name: str) -> mujoco.MjModel:
    """Compiles a model from Gymnasium's package for pictures, with a sky and more light."""
    spec = mujoco.MjSpec.from_file(str(_gymnasium_file(name)))
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.headlight.diffuse = [0.5, 0.5, 0.5]
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[1.0, 1.0, 1.0],
        rgb2=[0.80, 0.85, 0.92],
        width=64,
        height=64 * 6,
    )
    return spec.compile()


def _gymnasium_file(name: str) -> Path:
    """Finds a file without importing Gymnasium, which a worker does not need."""
    package = importlib.util.find_spec("gymnasium")
    if package is None or package.origin is None:
        raise ModuleNotFoundError(f"the model {name} is in the package gymnasium; install it")
    return Path(package.origin).parent / "envs" / "mujoco" / "assets" / name
