"""Observations as Stable-Baselines3 passes them to ``predict``."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray


def observation_rows(
    observation: ArrayLike | Mapping[str, ArrayLike], length: int
) -> tuple[NDArray[np.float64], bool]:
    """Returns observations (E, O), and whether there is a dimension of environments.

    :param observation: (O,), (E, O), or a mapping with such entries, which are joined in the order
        of their names.
    :param length: O.
    :raises ValueError: if the shapes differ from these.
    """
    parts = [observation]
    if isinstance(observation, Mapping):
        parts = [observation[name] for name in sorted(observation)]
    arrays = [np.asarray(part, np.float64) for part in parts]
    counts = {len(array) if array.ndim > 1 else None for array in arrays}
    is_batch = counts != {None}
    if not is_batch:
        arrays = [array.reshape(1, -1) for array in arrays]
    if len(counts) == 1 and all(array.ndim == 2 and len(array) > 0 for array in arrays):
        rows = np.concatenate(arrays, axis=1)
        if rows.shape[1] == length:
            return rows, is_batch
    shapes = " and ".join(str(np.shape(part)) for part in parts)
    raise ValueError(
        f"observation has shape {shapes}, expected ({length},) or (environments, {length}) in all"
    )


def start_flags(episode_start: ArrayLike | None, count: int) -> NDArray[np.bool_]:
    """Returns for each of ``count`` environments whether an episode starts.

    :raises ValueError: if there are more or fewer flags.
    """
    if episode_start is None:
        return np.zeros(count, bool)
    flags = np.atleast_1d(np.asarray(episode_start, bool))
    if flags.shape != (count,):
        raise ValueError(f"episode_start has shape {flags.shape}, expected ({count},)")
    return flags
