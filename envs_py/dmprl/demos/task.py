"""The task for which demonstrations are read, and the parts of a data set that it needs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmprl.demos.source import Columns, DemosError, Episode, Source
from dmprl.env_options import NO_OPTIONS, EnvOptions
from dmprl.segment_env import EnvSpec, GoalRows, Goals, NotGoalConditionedError, make

ROUNDING = 1e-5
"""Tolerance of actions beyond their bounds, as a share of their range; as in the learner."""


class Task:
    """Sizes, bounds, control rate and goals of a task.

    Its bounds are those of policies that use the share ``action_range`` of its actions.
    """

    def __init__(
        self, task_id: str, options: EnvOptions = NO_OPTIONS, action_range: float = 1.0
    ) -> None:
        try:
            self._env = make(task_id, 1, 1, options)
            self.spec: EnvSpec = self._env.spec()
        except Exception as error:
            raise DemosError(
                f"task {task_id} cannot be created: {type(error).__name__}: {error}"
            ) from error
        self.id = self.spec["id"]
        low, high = np.array(self.spec["action_low"]), np.array(self.spec["action_high"])
        middle, half = 0.5 * (low + high), 0.5 * action_range * (high - low)
        self.action_low, self.action_high = middle - half, middle + half
        self.bounds_name = f"the bounds of {self.id}"
        if action_range < 1.0:
            self.bounds_name = f"{action_range:g} of {self.bounds_name} (policy.action_range)"
        control_dt_s = self.spec["control_dt_s"]
        self.rate_hz = 1.0 / control_dt_s if control_dt_s > 0.0 else 0.0
        try:
            self.goals: Goals | None = self._env.goals()
        except NotGoalConditionedError:
            self.goals = None

    def rewards(self, observations: NDArray[np.float64]) -> NDArray[np.float64]:
        """Computes the rewards of steps from the goals that follow them, (T,)."""
        at, length = self.goals, self.goals["length"]
        rows = GoalRows(len(observations), length)
        rows.count[0] = len(observations)
        rows.achieved[:] = observations[:, at["achieved"] :][:, :length]
        rows.desired[:] = observations[:, at["desired"] :][:, :length]
        self._env.relabel(rows)
        return rows.rewards.copy()

    def close(self) -> None:
        """Releases the environment."""
        self._env.close()


class ColumnMapping(NamedTuple):
    """How observation and action are made of a source's columns."""

    columns: Columns
    order: NDArray[np.intp]
    """Index of each entry of an observation among the entries of the columns, (O,)."""
    names: list[str]
    """Name of each entry of an observation in the source, (O)."""
    action_names: list[str]

    def apply(self, episode: Episode) -> Episode:
        """Puts the entries of the observations in order."""
        return episode._replace(observations=episode.observations[:, self.order])


def columns_of(
    source: Source, observation: tuple[str, ...], action: str | None, reward: str | None
) -> Columns:
    """Chooses columns: those that are named, else those that the format's conventions name.

    :raises DemosError: if a column does not exist, or none is named or known.
    """
    chosen = Columns(
        observation or source.observation,
        action or source.action,
        reward or source.reward,
    )
    for part, columns in (("observation", chosen.observation), ("action", (chosen.action,))):
        there_are = f"there are: {source.listing(part)}"
        if not any(columns):
            raise DemosError(f"{source.name}: choose a column with --{part}; {there_are}")
        for column in columns:
            if column not in source.choices(part):
                raise DemosError(f"{source.name}: --{part}: no column {column}; {there_are}")
    if reward and reward != source.reward and len(source.columns.get(reward, [])) != 1:
        raise DemosError(
            f"{source.name}: --reward {reward}: expected a number or a column of length 1; there "
            f"are: {source.listing()}"
        )
    return chosen


def mapped(source: Source, columns: Columns, task: Task | None) -> ColumnMapping:
    """Orders the columns' entries as the task's observation.

    If the names of all entries of the task's observation are among those of the columns, as for a
    Dict with the same keys, the names decide. Otherwise the order is that of the columns.

    :raises DemosError: if observation or action have another length than the task's.
    """
    names = [name for column in columns.observation for name in source.columns[column]]
    actions = source.columns[columns.action]
    order = np.arange(len(names), dtype=np.intp)
    if task is not None:
        by_name = order_by_name(source, columns, task.spec.get("observation_names", []))
        order = order if by_name is None else by_name
        problems = wrong_length(source, "observation", columns.observation, len(order), task)
        problems += wrong_length(source, "action", (columns.action,), len(actions), task)
        if problems:
            raise DemosError("\n".join(problems))
    return ColumnMapping(columns, order, [names[index] for index in order], actions)


def order_by_name(source: Source, columns: Columns, wanted: list[str]) -> NDArray[np.intp] | None:
    """Returns the index of each wanted entry; None if the names do not decide."""
    entries = [(column, name) for column in columns.observation for name in source.columns[column]]
    places = {name: index for index, (_, name) in enumerate(entries)}
    if not wanted or not set(wanted) <= places.keys():
        return None
    used = {entries[places[name]][0] for name in wanted}
    # A column of which only some entries are wanted has another meaning in the task.
    whole = sum(len(source.columns[column]) for column in used)
    return np.array([places[name] for name in wanted], np.intp) if whole == len(wanted) else None


def wrong_length(
    source: Source, part: str, columns: tuple[str, ...], length: int, task: Task
) -> list[str]:
    """Returns a message if observation or action are not as long as the task's."""
    expected = task.spec[f"{part}_len"]  # type: ignore[literal-required]
    if length == expected:
        return []
    return [
        f"{source.name}: {part}: {task.id} expects {expected} entries, got {length} from "
        f"{', '.join(columns)}; choose columns with --{part}; there are: {source.listing(part)}"
    ]


def check(
    source: Source, number: int, episode: Episode, mapping: ColumnMapping, task: Task | None
) -> None:
    """Checks that all numbers of an episode are finite, and its actions within the task's bounds.

    :raises DemosError: for the first number that is not.
    """
    parts = [("observation", episode.observations, mapping.names)]
    parts.append(("action", episode.actions, mapping.action_names))
    if episode.rewards is not None:
        parts.append(("reward", episode.rewards[:, None], ["reward"]))
    for what, rows, names in parts:
        with np.errstate(over="ignore"):
            wrong = np.argwhere(~np.isfinite(rows.astype(np.float32)))
        if len(wrong):
            step, entry = wrong[0].tolist()
            raise DemosError(
                f"{source.name}: episode {number}, step {step}: {what} {names[entry]}: expected a "
                f"finite 32-bit number, got {rows[step, entry]}"
            )
    if task is None:
        return
    low, high = task.action_low, task.action_high
    slack = ROUNDING * (high - low)
    outside = (episode.actions < low - slack) | (episode.actions > high + slack)
    if outside.any():
        step, entry = np.argwhere(outside)[0].tolist()
        raise DemosError(
            f"{source.name}: episode {number}, step {step}: action {mapping.action_names[entry]}: "
            f"expected {low[entry]:g} to {high[entry]:g}, {task.bounds_name}, got "
            f"{episode.actions[step, entry]:g}"
        )
