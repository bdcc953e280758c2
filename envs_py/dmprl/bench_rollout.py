"""What ``dmprl bench rollout`` compares a rollout worker with: one process of this for each worker.

``python -m dmprl.bench_rollout KIND --plan FILE --index I`` writes one JSON object a line. The
first is ``{"ready": "what it measures"}``, or ``{"absent": "why"}`` if it cannot; then each line
``run SECONDS`` on standard input is answered by ``{"steps": …, "seconds": …}``. It ends with its
input, so the death of the program that started it ends it too.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dmprl.numpy_policy import Noise, NumpyPolicy

SETTLE_S = 0.1
"""Stepped before the clock starts: caches and clock frequency then are those of a long run."""
CONTROLS_BYTES_MAX = 16 << 20
"""Of controls drawn beforehand; few enough to draw at once, many enough not to repeat soon."""


class AbsentError(Exception):
    """A comparison is not to be had here. The message says why."""


class BatchPeer:
    """``mujoco.batch.Batch`` with no policy and nothing recorded: physics alone."""

    def __init__(self, model, frame_skip: int, plan: dict, seed: int) -> None:
        from mujoco.batch import Batch

        self._env_count: int = plan["env_count"]
        self._steps: int = plan["decision_steps"]
        self._substeps = self._steps * frame_skip
        self._batch = Batch(model, self._env_count, 1)
        self._batch.reset()
        episode_steps = plan["spec"]["episode_steps"] or sys.maxsize
        self._segments_of_episode = max(1, episode_steps // self._steps)
        self._controls = controls(model, (self._env_count, self._steps), frame_skip, seed)
        self._segment = 0

    def segment(self) -> int:
        """Runs one segment; returns the environment steps in it."""
        # Without new episodes random controls would leave the states that a task really sees.
        if self._segment % self._segments_of_episode == 0:
            self._batch.reset()
        control = self._controls[self._segment % len(self._controls)]
        self._segment += 1
        self._batch.rollout(self._substeps, control, record=())
        return self._env_count * self._steps


def controls(model, shape: tuple[int, int], frame_skip: int, seed: int) -> np.ndarray:
    """Controls of some segments, (segments, E, K frame_skip, nu), uniform within their bounds."""
    bytes_of_segment = shape[0] * shape[1] * frame_skip * model.nu * 8
    segments = max(2, min(256, CONTROLS_BYTES_MAX // max(1, bytes_of_segment)))
    low, high = model.actuator_ctrlrange.T
    bounded = model.actuator_ctrllimited.astype(bool)
    low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
    drawn = np.random.default_rng(seed).uniform(low, high, (segments, *shape, model.nu))
    return np.repeat(drawn, frame_skip, axis=2)


class GymnasiumPeer:
    """Gymnasium environments, one after the other, under the policy in NumPy."""

    def __init__(self, plan: dict, seed: int) -> None:
        import gymnasium

        self._envs = [gymnasium.make(plan["task"]["id"]) for _ in range(plan["env_count"])]
        self._policy, self._noise = NumpyPolicy(plan), Noise(plan, seed)
        self._dtype = self._envs[0].action_space.dtype
        shape = (plan["env_count"], plan["decision_steps"])
        # What a learner would be sent is kept here too, as the worker keeps it.
        self._observations = np.zeros((*shape, plan["spec"]["observation_len"]))
        self._rewards = np.zeros(shape)
        self._current = np.zeros((plan["env_count"], plan["spec"]["observation_len"]))
        for index, env in enumerate(self._envs):
            self._current[index] = flat(env.reset(seed=seed + index)[0])

    def segment(self) -> int:
        """Runs one segment; returns the environment steps in it."""
        policy, steps = self._policy, 0
        actions = policy.scaled(policy.u(self._current, self._noise)).astype(self._dtype)
        ended = np.zeros(len(self._envs), np.bool_)
        for index, env in enumerate(self._envs):
            observations, rewards = self._observations[index], self._rewards[index]
            for k, action in enumerate(actions[index]):
                observation, rewards[k], terminated, truncated, _ = env.step(action)
                observations[k] = observation = flat(observation)
                steps += 1
                if terminated or truncated:
                    observation = flat(env.reset()[0])
                    ended[index] = True
                    break
            self._current[index] = observation
        policy.carry_on(ended)
        self._noise.episodes_ended(ended)
        return steps


def flat(observation) -> np.ndarray:
    """A dictionary's entries in the order of its sorted keys, as the worker sees them."""
    if isinstance(observation, dict):
        return np.concatenate([np.ravel(observation[key]) for key in sorted(observation)])
    return observation


class EnvPoolPeer:
    """EnvPool in its synchronous mode on one thread, under the policy in NumPy.

    EnvPool spends a step on each reset; that is no environment step and is not counted. An episode
    that ends inside a segment is followed by the rest of that segment in the next one.
    """

    def __init__(self, plan: dict, seed: int) -> None:
        envpool = import_envpool()
        self.task_id = envpool_id(plan["task"]["id"], envpool.list_all_envs())
        env_count = plan["env_count"]
        self._env = envpool.make(
            self.task_id, env_type="gymnasium", num_envs=env_count, num_threads=1, seed=seed
        )
        self.version = envpool.__version__
        self._policy, self._noise = NumpyPolicy(plan), Noise(plan, seed)
        self._current, _ = self._env.reset()
        expected = (env_count, plan["spec"]["observation_len"])
        if self._current.shape != expected:
            raise AbsentError(
                f"EnvPool's {self.task_id} observes {self._current.shape}, the worker {expected}"
            )
        self._dtype = self._env.action_space.dtype
        shape = (plan["decision_steps"], env_count)
        self._observations = np.zeros((*shape, expected[1]))
        self._rewards = np.zeros(shape)
        self._resets = np.zeros(env_count, np.bool_)

    def segment(self) -> int:
        """Runs one segment; returns the environment steps in it."""
        policy, steps = self._policy, 0
        actions = policy.scaled(policy.u(self._current, self._noise)).astype(self._dtype)
        ended = np.zeros(len(self._resets), np.bool_)
        for k in range(actions.shape[1]):
            observations, rewards, terminated, truncated, _ = self._env.step(
                np.ascontiguousarray(actions[:, k])
            )
            self._observations[k], self._rewards[k] = observations, rewards
            steps += len(self._resets) - int(np.count_nonzero(self._resets))
            self._resets = terminated | truncated
            ended |= self._resets
        self._current = observations
        policy.carry_on(ended)
        self._noise.episodes_ended(ended)
        return steps


def import_envpool():
    """The module, or :class:`AbsentError`."""
    try:
        return importlib.import_module("envpool")
    except ImportError as error:
        raise AbsentError(
            f"{sys.executable} cannot import envpool ({error}); install it there, or name an "
            "interpreter that has it with --peer-python"
        ) from None


def envpool_id(task_id: str, known: list[str]) -> str:
    """EnvPool's id of a Gymnasium task: the same, or its newest version there."""
    if task_id in known:
        return task_id
    name = task_id.rpartition("-v")[0]
    versions = [int(other.rpartition("-v")[2]) for other in known if other.startswith(f"{name}-v")]
    if not name or not versions:
        raise AbsentError(f"EnvPool has no {task_id}")
    return f"{name}-v{max(versions)}"


def stock_batch(plan: dict, seed: int) -> tuple[Callable[[], int], str]:
    """Batch on the model file that Gymnasium ships, in a process as MuJoCo leaves it."""
    import gymnasium

    task_id = plan["task"]["id"]
    if task_id.rpartition(":")[2] not in gymnasium.registry and ":" not in task_id:
        raise AbsentError(f"{task_id} is no environment of Gymnasium")
    env = gymnasium.make(task_id).unwrapped
    path = getattr(env, "fullpath", None)
    if path is None or not hasattr(env, "frame_skip"):
        raise AbsentError(f"{task_id} is no MuJoCo environment of Gymnasium")
    import mujoco

    if importlib.util.find_spec("mujoco.batch") is None:
        raise AbsentError(f"MuJoCo {mujoco.__version__} has no mujoco.batch, 4.0 has")
    model = mujoco.MjModel.from_xml_path(path)
    about = f"mujoco.batch {mujoco.__version__} on {Path(path).name} as Gymnasium ships it"
    return BatchPeer(model, env.frame_skip, plan, seed).segment, about


def ceiling(plan: dict, seed: int) -> tuple[Callable[[], int], str]:
    """Batch on the model and the process settings of the worker."""
    raise AbsentError(f"{plan['task']['id']} is not on the Batch back end")


def gymnasium_loop(plan: dict, seed: int) -> tuple[Callable[[], int], str]:
    """A plain Gymnasium loop."""
    import gymnasium

    peer = GymnasiumPeer(plan, seed)
    return peer.segment, f"gymnasium {gymnasium.__version__}, numpy {np.__version__}"


def envpool_loop(plan: dict, seed: int) -> tuple[Callable[[], int], str]:
    """EnvPool."""
    peer = EnvPoolPeer(plan, seed)
    about = f"envpool {peer.version} ({peer.task_id}), numpy {np.__version__}"
    return peer.segment, about


KINDS = {
    "batch": stock_batch,
    "ceiling": ceiling,
    "gymnasium": gymnasium_loop,
    "envpool": envpool_loop,
}


def run_for(segment: Callable[[], int], seconds: float) -> dict:
    """Runs segments for so long; whole segments, and the time that they really took."""
    clock = time.perf_counter
    end = clock() + SETTLE_S
    while clock() < end:
        segment()
    steps, start = 0, clock()
    end = start + seconds
    now = start
    while now < end:
        steps += segment()
        now = clock()
    return {"steps": steps, "seconds": now - start}


def main() -> None:
    """Speaks the protocol of the module's first lines."""
    parser = argparse.ArgumentParser(prog="dmprl.bench_rollout")
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("--plan", type=Path, required=True)
    parser.add_argument("--index", type=int, required=True)
    arguments = parser.parse_args()
    # Ctrl-C reaches the whole process group; the program that reads our lines decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # What an environment prints must not become a line of the protocol.
    lines = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    plan = json.loads(arguments.plan.read_text())
    sys.path.extend(plan["task"]["python_path"])
    try:
        segment, about = KINDS[arguments.kind](plan, plan["seed"] + 1000 * arguments.index)
    except AbsentError as error:
        print(json.dumps({"absent": str(error)}), file=lines)
        return
    print(json.dumps({"ready": about}), file=lines)
    for line in sys.stdin:
        command, _, seconds = line.partition(" ")
        if command != "run":
            raise SystemExit(f"expected `run SECONDS`, got {line!r}")
        print(json.dumps(run_for(segment, float(seconds))), file=lines)


if __name__ == "__main__":
    main()
