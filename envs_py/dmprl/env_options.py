"""Arguments of an environment and wrappers around it (``task.kwargs``, ``task.wrappers``)."""

from __future__ import annotations

import contextlib
import tomllib
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple


class OptionsError(TypeError):
    """Raised if an environment cannot be created with its arguments and wrappers."""


class RandomiseError(ValueError):
    """Raised if ``task.randomise`` cannot be applied to an environment."""

    @classmethod
    def of(cls, key: str, name: str, reason: str) -> RandomiseError:
        """Creates the error of a key and an environment."""
        return cls(f"task.randomise.{key} cannot be applied to {name}: {reason}; remove the key")


class Randomise(NamedTuple):
    """Ranges from which each episode draws, as in ``RandomiseConfig`` in Rust."""

    mass: tuple[float, float] = (1.0, 1.0)
    friction: tuple[float, float] = (1.0, 1.0)
    damping: tuple[float, float] = (1.0, 1.0)
    object_size: tuple[float, float] = (1.0, 1.0)
    start_pose: tuple[float, float] = (0.0, 0.0)
    action_delay_steps: tuple[int, int] = (0, 0)
    observation_delay_steps: tuple[int, int] = (0, 0)

    def changes(self, key: str) -> bool:
        """Returns whether a key has another value than its default."""
        return tuple(getattr(self, key)) != self._field_defaults[key]

    def of_model(self) -> str | None:
        """Returns the first key that changes the model or its start; None without such a key."""
        keys = (key for key in self._fields if not key.endswith("_delay_steps"))
        return next(filter(self.changes, keys), None)

    def delays(self) -> bool:
        """Returns whether actions or observations are delayed."""
        return self.changes("action_delay_steps") or self.changes("observation_delay_steps")


class EnvOptions(NamedTuple):
    """How to create an environment, apart from its id."""

    kwargs: Mapping[str, Any] = MappingProxyType({})
    """Arguments of ``gymnasium.make`` and of the environment."""
    wrappers: tuple[str, ...] = ()
    """Names ``module:name`` of classes or functions, the innermost wrapper first."""
    randomise: Randomise = Randomise()
    """Physics and delays that each episode draws anew."""

    @classmethod
    def parse(cls, text: str) -> EnvOptions:
        """Reads the TOML text of the program (``TaskConfig::options_toml`` in Rust)."""
        table = tomllib.loads(text)
        randomise = Randomise(**table.get("randomise", {}))
        return cls(table["kwargs"], tuple(table["wrappers"]), randomise)

    def __bool__(self) -> bool:
        """Returns whether there are arguments or wrappers."""
        return bool(self.kwargs or self.wrappers)

    def split_time_limit(self, default: int | None) -> tuple[dict[str, Any], int | None]:
        """Returns the arguments without ``max_episode_steps``, and the time limit.

        For tasks that are not created by ``gymnasium.make``, which has this argument too. As there,
        -1 is no limit.
        """
        kwargs = dict(self.kwargs)
        limit = kwargs.pop("max_episode_steps", default)
        if limit is None or limit == -1:
            return kwargs, None
        if not isinstance(limit, int) or isinstance(limit, bool) or limit < 1:
            raise ValueError(f"max_episode_steps is {limit!r}; expected 1 or more, or -1 for none")
        return kwargs, limit

    @contextlib.contextmanager
    def explained(self, task_id: str) -> Iterator[None]:
        """Adds the arguments, the wrappers and a remedy to the message of any exception."""
        try:
            yield
        except RandomiseError:
            raise
        except Exception as error:
            if not self:
                raise
            parts, keys = [], []
            if self.kwargs:
                parts.append(", ".join(f"{name}={it!r}" for name, it in self.kwargs.items()))
                keys.append("task.kwargs (--env-kwargs)")
            if self.wrappers:
                parts.append(f"wrapped by {', '.join(self.wrappers)}")
                keys.append("task.wrappers")
            raise OptionsError(
                f"{task_id} cannot be created with {' and '.join(parts)}: "
                f"{type(error).__name__}: {error}; change {' or '.join(keys)}"
            ) from error


NO_OPTIONS = EnvOptions()
