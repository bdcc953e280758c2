"""Ways to execute a policy: ``python execution.py LABEL POLICY TASK EPISODES [FIRST_SEED]``.

POLICY is a run directory or ``zoo:TASK``. It prints a line of CSV for each way: ``segment`` is
whole segments, ``first`` decides at every step and executes the first action, ``mean`` executes the
mean of all segments that plan an action for the step, and ``ensemble`` is dmprl's. An ``mlp`` has
``segment`` and ``filter``, the mean of its action and of the filtered one before. ``return_change``
is the mean difference from ``segment`` over the same episodes, with its standard error. Actions are
scaled to [-1, 1], and jerk is in rad/s³.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import dmprl
from dmprl.plan import Plan
from dmprl.robot_joints import robot_joints
from dmprl.robotics_repair import repair
from dmprl.task_env import TaskEnv

FIRST_SEED = 7000
WAYS = ("segment", "first", "mean", "ensemble")
COLUMNS = (
    "return",
    "return_change",
    "return_change_stderr",
    "success",
    "du",
    "d2u",
    "joint_jerk",
)
WAYS_OF_MLP = ("segment", "filter")


def state(env):
    """Returns the model and the velocities of an environment's simulation."""
    env = env.unwrapped
    if isinstance(env, TaskEnv):
        return env.task.model, env.positions_and_velocities[1]
    return env.model, env.data.qvel


class Executed:
    """A policy that acts in one of the ways."""

    def __init__(self, policy: dmprl.Policy, way: str) -> None:
        self.policy, self.way = policy, way
        self.low, self.high = policy.low, policy.high
        self.plan = Plan(policy.segment_steps, policy.low.size)
        self.segments: list[np.ndarray] = []
        self.filtered: np.ndarray | None = None

    def reset(self) -> None:
        """Starts an episode."""
        self.policy.reset()
        self.plan.clear()
        self.segments.clear()
        self.filtered = None

    def action(self, observation: np.ndarray) -> np.ndarray:
        """Returns the next action u, (A,)."""
        if self.way == "segment" and not self.plan.is_empty:
            return self.plan.take()
        actions = self.policy.segment(observation)
        u = ((2.0 * actions - self.low - self.high) / (self.high - self.low)).astype(np.float32)
        if self.way == "filter":
            self.filtered = u[0] if self.filtered is None else 0.5 * (u[0] + self.filtered)
            return self.filtered
        if self.way == "mean":
            self.segments = [u, *self.segments[: len(u) - 1]]
            return np.mean([segment[age] for age, segment in enumerate(self.segments)], axis=0)
        if self.way == "first":
            self.plan.clear()
        self.plan.add(u)
        return self.plan.take()


def episode(env, executed: Executed, seed: int, joints: list[int]) -> tuple[float, ...]:
    """Returns return, success, and the means of |Δu|, |Δ²u| and |Δ²qd| of an episode."""
    observation, _ = env.reset(seed=seed)
    executed.reset()
    middle, half = (executed.high + executed.low) / 2, (executed.high - executed.low) / 2
    total, ended, us, velocities = 0.0, False, [], [state(env)[1][joints].copy()]
    while not ended:
        if isinstance(observation, dict):
            parts = [np.ravel(observation[key]) for key in sorted(observation)]
            observation = np.concatenate(parts)
        us.append(executed.action(observation))
        observation, reward, terminated, truncated, info = env.step(middle + half * us[-1])
        total, ended = total + reward, terminated or truncated
        velocities.append(state(env)[1][joints].copy())
    changes = [
        np.abs(np.diff(rows, order, axis=0)).mean()
        for rows, order in ((us, 1), (us, 2), (velocities, 2))
    ]
    return total, float(info.get("is_success", np.nan)), *changes


def lines(label: str, name: str, task: str, seeds: range) -> Iterator[str]:
    """Yields the lines of a policy, for episodes with these seeds."""
    policy = (
        dmprl.Policy.load(name)
        if name.startswith("zoo:")
        else dmprl.Run(Path(name)).policy("latest")
    )
    env = dmprl.make(task)
    env.reset(seed=seeds[0])
    joints, step_s = robot_joints(state(env)[0]).qvel, policy.spec["control_dt_s"]
    first = None
    for way in WAYS if policy.segment_steps > 1 else WAYS_OF_MLP:
        executed = Executed(policy, way)
        rows = np.array([episode(env, executed, seed, joints) for seed in seeds])
        first = rows if first is None else first
        change = rows[:, 0] - first[:, 0]
        mean = rows.mean(axis=0)
        values = (mean[0], change.mean(), change.std() / np.sqrt(len(seeds)), *mean[1:4])
        numbers = ",".join(f"{value:.4f}" for value in values)
        yield f"{label},{task},{way},{len(seeds)},{numbers},{mean[4] / step_s**2:.1f}"


def main() -> None:
    """Prints the lines of the command line's policy."""
    repair()
    label, name, task, episodes, *first = sys.argv[1:]
    first_seed = int(first[0]) if first else FIRST_SEED
    print(",".join(["policy", "task", "execution", "episodes", *COLUMNS]))
    for line in lines(label, name, task, range(first_seed, first_seed + int(episodes))):
        print(line, flush=True)


if __name__ == "__main__":
    main()
