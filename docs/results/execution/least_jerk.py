"""Least jerk of any motion with a good return: ``python least_jerk.py TASK POLICY EPISODES COST…``.

For each cost it minimises, over the actions of each episode, ``-return + COST * joint jerk``, from
the actions of the policy on. So it knows the whole episode, which no policy does. It prints a line
of CSV for the policy and for each cost: means of the episodes with seeds 7000 on. POLICY is a run
directory or ``zoo:TASK``; an ensemble if it decides several steps. It knows the observations of
``reacher-v1``, ``panda-reach`` and ``panda-reach-joints``. Jerk is in rad/s³.

Return and jerk are sums of absolute values, so each iteration minimises a weighted sum of squares
with derivatives by finite differences, and tries several step lengths and dampings.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from execution import FIRST_SEED, Executed

import dmprl
from dmprl.robotics_repair import repair
from dmprl.segment_env import SegmentBuffers
from dmprl.tasks import make_task

IDS = {
    "reacher-v1": "dmprl/Reacher-v1",
    "panda-reach": "dmprl/PandaReach-v0",
    "panda-reach-joints": "dmprl/PandaReachJoints-v0",
}
ITERATIONS_MAX = 60
CHANGE = 1e-3
"""Change of an action for finite differences."""
DAMPINGS = 10.0 ** np.arange(-2, 4)
LENGTHS = (1.0, 0.5, 0.2, 0.05)


class Motion(NamedTuple):
    """Velocities (N, T + 1, D), differences from the target (N, T, 2 or 3) and returns (N,)."""

    velocities: np.ndarray
    differences: np.ndarray
    returns: np.ndarray

    def take(self, index: int) -> Motion:
        """Returns one of the N motions."""
        return Motion(*(part[index] for part in self))


class Simulations:
    """N simulations of a task, for whole episodes."""

    def __init__(self, task: str, count: int) -> None:
        made = make_task(IDS[task], count, {})
        self.count, self.steps = count, made.episode_steps
        self.env = made.batch(self.steps, None)
        spec = self.env.spec()
        names = spec["observation_names"]
        self.action_len, self.step_s = spec["action_len"], spec["control_dt_s"]
        self.out = SegmentBuffers(count, self.steps, spec["observation_len"], self.action_len)
        self.velocity = [i for i, name in enumerate(names) if name.startswith("velocity_joint")]
        self.difference = [i for i, name in enumerate(names) if "_to_" in name]
        # Reacher-v1 rewards the state before a step, and subtracts the squares of the actions.
        self.is_reacher = task == "reacher-v1"

    def run(self, actions: np.ndarray, seed: int) -> Motion:
        """Runs actions (n, T, A) from the start with this seed, n at most N."""
        everything = np.zeros((self.count, self.steps, self.action_len))
        everything[: len(actions)] = actions
        seeds = np.full(self.count, seed, np.uint64)
        self.env.reset(np.ones(self.count, np.uint8), seeds, self.out)
        self.env.step_segment(everything, self.out)
        rows = self.out.observations[: len(actions)]
        rewarded = rows[:, :-1] if self.is_reacher else rows[:, 1:]
        returns = self.out.rewards[: len(actions)].sum(axis=1)
        return Motion(rows[:, :, self.velocity], rewarded[:, :, self.difference], returns)

    def jerk(self, velocities: np.ndarray) -> np.ndarray:
        """Returns the mean absolute jerk of each motion (N,)."""
        return np.abs(np.diff(velocities, 2, axis=-2)).mean(axis=(-2, -1)) / self.step_s**2


def quadratic(
    many: Simulations, seed: int, u: np.ndarray, motion: Motion, weights: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the matrix and the gradient of the weighted squares at the actions (T, A).

    ``weights`` are that of jerk, and how far from zero an absolute value is smooth.
    """
    weight, smooth = weights
    x = u.ravel()
    step = np.where(x + CHANGE > 1.0, -CHANGE, CHANGE)
    changed = (x + np.diag(step)).reshape(-1, *u.shape)
    moved = many.run(changed, seed)
    # Actions are rounded to float32.
    step = np.float32(x + step).astype(float) - np.float32(x)
    jerks = np.diff(motion.velocities, 2, axis=0).ravel()
    jacobian = np.diff(moved.velocities - motion.velocities, 2, axis=1).reshape(len(x), -1)
    jacobian /= step[:, None]
    jerk_weights = weight / (jerks.size * many.step_s**2)
    jerk_weights = jerk_weights / (np.abs(jerks) + smooth * np.abs(jerks).mean())
    matrix, gradient = (jacobian * jerk_weights) @ jacobian.T, jacobian @ (jerk_weights * jerks)
    differences = motion.differences.ravel()
    jacobian = (moved.differences - motion.differences).reshape(len(x), -1) / step[:, None]
    distances = np.linalg.norm(motion.differences, axis=1)
    distance_weights = np.repeat(1.0 / (distances + 0.02 * smooth), motion.differences.shape[1])
    matrix += (jacobian * distance_weights) @ jacobian.T
    gradient += jacobian @ (distance_weights * differences)
    if many.is_reacher:
        matrix += 2.0 * np.eye(len(x))
        gradient += 2.0 * x
    return matrix, gradient


def candidates(
    u: np.ndarray, matrix: np.ndarray, gradient: np.ndarray, damping: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns actions (n, T, A) that might be better, and the damping of each (n,)."""
    x = u.ravel()
    free = ~(((x >= 1.0) & (gradient < 0.0)) | ((x <= -1.0) & (gradient > 0.0)))
    inner = matrix[np.ix_(free, free)]
    tried, dampings = [], []
    for factor in damping * DAMPINGS:
        damped = inner + np.diag(factor * np.diag(inner) + 1e-12)
        change = np.zeros_like(x)
        change[free] = -np.linalg.solve(damped, gradient[free])
        tried += [np.clip(x + length * change, -1.0, 1.0) for length in LENGTHS]
        dampings += [factor] * len(LENGTHS)
    return np.array(tried).reshape(-1, *u.shape), np.array(dampings)


def optimise(many: Simulations, seed: int, u: np.ndarray, cost: float) -> np.ndarray:
    """Returns better actions (T, A) than ``u`` for the cost of an episode."""

    def losses(motion: Motion) -> np.ndarray:
        return cost * many.jerk(motion.velocities) - motion.returns

    motion = many.run(u[None], seed)
    history, motion, damping = [losses(motion)[0]], motion.take(0), 1e-3
    for iteration in range(ITERATIONS_MAX):
        smooth = 0.3 * 0.85**iteration + 0.003
        matrix, gradient = quadratic(many, seed, u, motion, (cost, smooth))
        tried, dampings = candidates(u, matrix, gradient, damping)
        motions = many.run(tried, seed)
        best = int(losses(motions).argmin())
        if losses(motions)[best] < history[-1]:
            u, motion, damping = tried[best], motions.take(best), max(dampings[best], 1e-9)
        else:
            damping = min(30.0 * damping, 1e3)
        history.append(float(losses(motion)))
        if iteration > 12 and history[-8] - history[-1] < 3e-4 * abs(history[-1]):
            break
    return u


def actions_of(policy: dmprl.Policy, task: str, seed: int) -> np.ndarray:
    """Returns the policy's actions in an episode, (T, A)."""
    executed = Executed(policy, "ensemble" if policy.segment_steps > 1 else "segment")
    env = dmprl.make(task)
    observation, _ = env.reset(seed=seed)
    executed.reset()
    us, ended = [], False
    while not ended:
        us.append(executed.action(observation))
        observation, _, terminated, truncated, _ = env.step(us[-1])
        ended = terminated or truncated
    return np.array(us, float)


def main() -> None:
    """Prints the lines of the command line's policy."""
    repair()
    task, name, episodes, *costs = sys.argv[1:]
    zoo = name.startswith("zoo:")
    policy = dmprl.Policy.load(name) if zoo else dmprl.Run(Path(name)).policy("latest")
    seeds = range(FIRST_SEED, FIRST_SEED + int(episodes))
    motions = [actions_of(policy, task, seed) for seed in seeds]
    many = Simulations(task, motions[0].size)
    print("task,cost,episodes,return,joint_jerk")
    for cost in ["", *costs]:
        if cost:
            pairs = zip(seeds, motions, strict=True)
            motions = [optimise(many, seed, u, float(cost)) for seed, u in pairs]
        ends = [many.run(u[None], seed) for seed, u in zip(seeds, motions, strict=True)]
        total = np.mean([end.returns[0] for end in ends])
        jerk = np.mean([many.jerk(end.velocities)[0] for end in ends])
        print(f"{task},{cost},{episodes},{total:.4f},{jerk:.2f}", flush=True)


if __name__ == "__main__":
    main()
