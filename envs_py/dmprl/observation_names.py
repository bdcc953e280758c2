"""Names the entries of a flattened observation."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces


def names_of(space: spaces.Space, path: str = "") -> list[str]:
    """Returns the name of each entry of ``gymnasium.spaces.flatten`` for ``space``, in order.

    Examples: ``achieved_goal[0]`` in a Dict, ``arm.position[0]`` in a Dict of Dicts,
    ``observation.0[2]`` in a Tuple, ``observation[0]`` elsewhere. A Discrete has one entry per
    value.
    """
    if isinstance(space, spaces.Dict):
        parts = [
            (f"{path}.{key}" if path else str(key), part) for key, part in space.spaces.items()
        ]
    elif isinstance(space, spaces.Tuple):
        parts = [(f"{path or 'observation'}.{i}", part) for i, part in enumerate(space.spaces)]
    else:
        path = path or "observation"
        if space.shape == () and isinstance(space, spaces.Box):
            return [path]
        if isinstance(space, spaces.Box | spaces.MultiBinary) and len(space.shape) > 1:
            return [f"{path}[{','.join(map(str, at))}]" for at in np.ndindex(space.shape)]
        return [f"{path}[{i}]" for i in range(spaces.flatdim(space))]
    return [name for path, part in parts for name in names_of(part, path)]
