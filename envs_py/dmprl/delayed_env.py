"""Delays the actions and the observations of any environments, by steps drawn for each episode.

Stands between a worker and its environments. A delayed action of the first steps is zero, or the
nearest action in the environment's range. The first observations repeat that of the start. Rewards,
success and the end of an episode are not delayed: they are those of the true state.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmprl.env_options import Randomise
from dmprl.goal_rule import GoalRule
from dmprl.segment_env import EnvSpec, GoalRows, Goals, SegmentBuffers, SegmentEnv

STREAM = 2
"""Separates the stream of these draws from others of the same seed."""


class DelayedEnv(SegmentEnv):
    """E environments with delays; everything else, such as a recording, is that of ``env``."""

    def __init__(self, env: SegmentEnv, ranges: Randomise) -> None:
        self._env = env
        self.env_count, self.segment_steps = envs, steps = env.env_count, env.segment_steps
        self._ranges = ranges.action_delay_steps, ranges.observation_delay_steps
        self._most_action, self._most_observation = (high for _, high in self._ranges)
        spec = env.spec()
        self._idle = np.clip(0.0, spec["action_low"], spec["action_high"])
        # The earlier entries come first, then those of the segment.
        self._given = np.zeros((envs, self._most_action + steps, spec["action_len"]))
        rows = self._most_observation + steps + 1
        self._seen = np.zeros((envs, rows, spec["observation_len"]))
        self._sent = np.zeros((envs, steps, spec["action_len"]))
        self._delays = np.zeros((envs, 2), np.int64)
        self._generators = [np.random.default_rng() for _ in range(envs)]

    def reset(  # noqa: D102 - inherited
        self, mask: NDArray[np.uint8], seeds: NDArray[np.uint64], out: SegmentBuffers
    ) -> None:
        self._env.reset(mask, seeds, out)
        for index in np.flatnonzero(mask).tolist():
            self._generators[index] = np.random.default_rng([STREAM, int(seeds[index])])
            self._begin(index, out)

    def _begin(self, index: int, out: SegmentBuffers) -> None:
        """Draws the delays of an episode, whose first observation is in ``out``."""
        draw = self._generators[index].integers
        self._delays[index] = [draw(low, high, endpoint=True) for low, high in self._ranges]
        self._given[index, : self._most_action] = self._idle
        self._seen[index, : self._most_observation] = out.next_observations[index]

    def step_segment(  # noqa: D102 - inherited
        self, actions: NDArray[np.float64], out: SegmentBuffers
    ) -> None:
        past, steps = self._most_action, self.segment_steps
        self._given[:, past:] = actions
        for index, (delay, _) in enumerate(self._delays.tolist()):
            self._sent[index] = self._given[index, past - delay : past - delay + steps]
        self._env.step_segment(self._sent, out)
        # An episode that has not ended has run all steps of the segment.
        self._given[:, :past] = self._given[:, steps:].copy()
        self._seen[:, self._most_observation :] = out.observations
        ended = (out.terminated | out.truncated | out.failed).tolist()
        for index, (_, delay) in enumerate(self._delays.tolist()):
            self._delay_observations(index, delay, bool(ended[index]), out)

    def _delay_observations(self, index: int, delay: int, ended: bool, out: SegmentBuffers) -> None:
        past, rows = self._most_observation, int(out.steps[index]) + 1
        if not out.failed[index]:
            delayed = self._seen[index, past - delay : past - delay + rows]
            out.observations[index, :rows] = delayed
        if ended:
            self._begin(index, out)
        else:
            out.next_observations[index] = out.observations[index, rows - 1]
            self._seen[index, :past] = self._seen[index, self.segment_steps : -1].copy()

    def spec(self) -> EnvSpec:  # noqa: D102 - inherited
        return self._env.spec()

    def take_failures(self) -> list[str]:  # noqa: D102 - inherited
        return self._env.take_failures()

    def goals(self) -> Goals:  # noqa: D102 - inherited
        return self._env.goals()

    def relabel(self, rows: GoalRows) -> None:  # noqa: D102 - inherited
        self._env.relabel(rows)

    def goal_rule(self) -> GoalRule | None:  # noqa: D102 - inherited
        return self._env.goal_rule()

    def close(self) -> None:  # noqa: D102 - inherited
        self._env.close()

    def __getattr__(self, name: str) -> Any:
        """Returns what only some environments have, such as ``recording``."""
        return getattr(self._env, name)
