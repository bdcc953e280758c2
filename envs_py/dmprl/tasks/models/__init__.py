"""The models of the tasks."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import mujoco


def own_model(name: str) -> mujoco.MjModel:
    """Compiles a model of this folder."""
    return mujoco.MjModel.from_xml_path(str(Path(__file__).parent / name))


def own_model_without_decoration(name: str) -> mujoco.MjModel:
    """Compiles a model of this folder without the geoms that only pictures show.

    A simulation moves every geom in every step. The state is the same as with them.
    """
    specification = mujoco.MjSpec.from_file(str(Path(__file__).parent / name))
    specification.compiler.discardvisual = True
    return specification.compile()


def gymnasium_model(name: str) -> mujoco.MjModel:
    """Compiles a model that Gymnasium brings.

    Found without importing Gymnasium, which a worker can do without.
    """
    package = importlib.util.find_spec("gymnasium")
    if package is None or package.origin is None:
        raise ModuleNotFoundError(f"the model {name} belongs to the package gymnasium")
    return mujoco.MjModel.from_xml_path(
        str(Path(package.origin).parent / "envs" / "mujoco" / "assets" / name)
    )
