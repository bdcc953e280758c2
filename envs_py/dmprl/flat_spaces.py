"""Makes observations and actions of Gymnasium environments one-dimensional."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dmprl.segment_env import UnsupportedSpaceError

SUPPORTED = (
    "supported are Box observations except images, alone or in a Dict or Tuple, and a bounded Box "
    "action with a floating-point type; dmprl flattens both"
)


def flattened(env: gymnasium.Env, task_id: str) -> gymnasium.Env:
    """Wraps ``env`` so that each of its spaces is a Box with one dimension.

    :raises UnsupportedSpaceError: for an image or another space that is not supported, with its
        name.
    """
    observation, action = env.observation_space, env.action_space
    check_spaces(observation, action, task_id)
    if not isinstance(observation, spaces.Box) or len(observation.shape) != 1:
        # The entries of a Dict are in the order of its space, which Gymnasium sorts by key.
        env = gymnasium.wrappers.FlattenObservation(env)
    if len(action.shape) != 1:
        flat = spaces.Box(action.low.ravel(), action.high.ravel(), dtype=action.dtype)
        env = gymnasium.wrappers.TransformAction(env, lambda u: u.reshape(action.shape), flat)
    return env


def check_spaces(observation: spaces.Space, action: spaces.Space, task_id: str) -> None:
    """Checks the spaces of one environment.

    :raises UnsupportedSpaceError: as :func:`flattened` does.
    """
    image = image_in(observation)
    if image is not None:
        raise UnsupportedSpaceError(f"{task_id}: {image} is an image; {SUPPORTED}")
    supported = isinstance(observation, spaces.Box | spaces.Dict | spaces.Tuple)
    if not supported or not observation.is_np_flattenable:
        raise UnsupportedSpaceError(f"{task_id}: observation space {observation}; {SUPPORTED}")
    if (
        not isinstance(action, spaces.Box)
        or not np.issubdtype(action.dtype, np.floating)
        or not action.is_bounded("both")
    ):
        raise UnsupportedSpaceError(f"{task_id}: action space {action}; {SUPPORTED}")


def flat_rows(space: spaces.Space, batch: Any) -> NDArray[np.float64]:
    """Flattens the observations of E environments to (E, O), as ``spaces.flatten`` does for one.

    - ``space``: the space of one environment.
    - ``batch``: a sample of ``gymnasium.vector.utils.batch_space(space, E)``.
    - The result is always a copy.
    """
    if isinstance(space, spaces.Dict):
        parts = [flat_rows(part, batch[key]) for key, part in space.items()]
        return np.concatenate(parts, axis=1)
    if isinstance(space, spaces.Tuple):
        parts = [flat_rows(part, entry) for part, entry in zip(space, batch, strict=True)]
        return np.concatenate(parts, axis=1)
    if isinstance(space, spaces.Box):
        rows = np.array(batch, np.float64)
        return rows.reshape(len(rows), -1)
    return np.stack([spaces.flatten(space, entry) for entry in batch]).astype(np.float64)


def image_in(space: spaces.Space, name: str = "the observation") -> str | None:
    """Returns the name and the space of the first image in ``space``, if there is one."""
    if isinstance(space, spaces.Dict):
        entries = [(f"observation[{key!r}]", entry) for key, entry in space.items()]
    elif isinstance(space, spaces.Tuple):
        entries = [(f"observation[{index}]", entry) for index, entry in enumerate(space)]
    else:
        is_image = isinstance(space, spaces.Box) and space.dtype == np.uint8
        return f"{name}, {space}," if is_image and len(space.shape) in (2, 3) else None
    return next(filter(None, (image_in(entry, name) for name, entry in entries)), None)
