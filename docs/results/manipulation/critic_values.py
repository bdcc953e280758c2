"""Compares critics with their policy's returns: ``python critic_values.py RUN TASK [EPISODES]``.

It runs the newest evaluated policy without noise, with the critics of the latest checkpoint. For
the decisions from one before the object first moves to seven after, it prints a line of CSV: the
mean value of the critics, the mean return, their correlation, and the mean value in episodes that
succeed and fail. The last line has the success rate of the policy, and of the best of 64 segments
near its own by these values.

Rewards after the last step are those of the object that stays where it is.
"""

from __future__ import annotations

import itertools
import json
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

import dmprl
from dmprl.robotics_repair import repair

FIRST_SEED = 6000
CANDIDATES = 64


class Critics:
    """The mean of both critics, which see the outcome model's features."""

    def __init__(self, run: Path, policy: dmprl.Policy) -> None:
        checkpoint = run / "checkpoints" / "latest"
        state = json.loads((checkpoint / "state.json").read_text())
        config = dmprl.Run(run).config
        self.discount = config["algorithm"]["discount"]
        self.normaliser = state["normaliser"]
        self.rule = json.loads((run / "spec.json").read_text())["goal_rule"]
        self.threshold = self.rule["reward"]["sparse"]["threshold"]
        self.steps = policy.segment_steps
        goal = self.rule["goal_len"]
        model_inputs = policy.spec["observation_len"] + self.steps * policy.low.size
        features = self.steps * (2 * goal + 1)
        networks = _read(checkpoint / "networks.safetensors")
        hidden = config["algorithm"]["critic_hidden"]

        def layers(name: str, inputs: int, outputs: int) -> list:
            return _layers(networks(f"{name}.network"), [inputs, *hidden, outputs])

        self.model = layers("outcome_model", model_inputs, self.steps * goal)
        inputs = model_inputs + features
        self.critics = [layers(f"critic_{index}", inputs, 1) for index in (1, 2)]

    def values(self, observation: np.ndarray, segments: np.ndarray) -> np.ndarray:
        """Returns the values, (N,), of segments, (N, K, A), from an observation, (O,)."""
        first, goal = self.rule["achieved"], self.rule["goal_len"]
        achieved = observation[first : first + goal]
        desired = slice(self.rule["desired"], self.rule["desired"] + goal)
        start = observation[desired] - achieved
        state = observation.copy()
        state[desired] = start
        state = (state - self.normaliser["mean"]) / self.normaliser["scale"]
        count = len(segments)
        inputs = np.hstack([np.tile(state, (count, 1)), segments.reshape(count, -1)])
        motion = _forward(self.model, inputs).reshape(count, self.steps, goal)
        d = start / self.threshold - motion
        size = np.linalg.norm(d, axis=2, keepdims=True)
        features = np.concatenate([d / 4, np.tanh(d / 2), np.tanh(size - 1)], axis=2)
        inputs = np.hstack([inputs, features.reshape(count, -1)])
        return np.mean([_forward(critic, inputs)[:, 0] for critic in self.critics], axis=0)


def _read(path: Path) -> Callable[[str], np.ndarray]:
    """Returns a function from a tensor's name to its numbers in a safetensors file."""
    data = path.read_bytes()
    (header_len,) = struct.unpack_from("<Q", data)
    header, first = json.loads(data[8 : 8 + header_len]), 8 + header_len

    def tensor(name: str) -> np.ndarray:
        begin, end = header[name]["data_offsets"]
        return np.frombuffer(data[first + begin : first + end], np.float32)

    return tensor


def _layers(flat: np.ndarray, widths: list[int]) -> list:
    """Returns weights and biases of all layers, and gain and shift of the hidden ones if any."""
    layers, at = [], 0
    for inputs, outputs in itertools.pairwise(widths):
        weights = flat[at : at + inputs * outputs].reshape(outputs, inputs)
        at += inputs * outputs
        layers.append((weights, flat[at : at + outputs], None))
        at += outputs
    if at < len(flat):
        for index, width in enumerate(widths[1:-1]):
            gain_shift = flat[at : at + 2 * width].reshape(2, width)
            layers[index] = (*layers[index][:2], gain_shift)
            at += 2 * width
    return layers


def _forward(layers: list, x: np.ndarray) -> np.ndarray:
    for weights, bias, gain_shift in layers[:-1]:
        x = x @ weights.T + bias
        if gain_shift is not None:
            x = (x - x.mean(1, keepdims=True)) / np.sqrt(x.var(1, keepdims=True) + 1e-5)
            x = x * gain_shift[0] + gain_shift[1]
        x = np.maximum(x, 0.0)
    weights, bias, _ = layers[-1]
    return x @ weights.T + bias


def _flat(observation: dict) -> np.ndarray:
    return np.concatenate([observation[key] for key in sorted(observation)]).astype(np.float64)


def _nearby(policy: dmprl.Policy, segment: np.ndarray, random: np.random.Generator) -> np.ndarray:
    shift = random.normal(0.0, 0.3, (CANDIDATES, 1, segment.shape[1]))
    shift *= random.choice([0.1, 0.3, 1.0], (CANDIDATES, 1, 1))
    shift[0] = 0.0
    return np.clip(segment + shift, policy.low, policy.high)


def episode(env, policy, critics, seed: int, random: np.random.Generator | None) -> tuple:
    """Runs an episode.

    Returns values and returns of its decisions, the first one that moves the object, and whether
    the goal is reached at the end.
    """
    observation, _ = env.reset(seed=seed)
    policy.reset()
    values, rewards, places, ended = [], [], [], False
    while not ended:
        state = _flat(observation)
        segment = np.array(policy.segment(state)).reshape(critics.steps, -1)
        segments = segment[None] if random is None else _nearby(policy, segment, random)
        judged = critics.values(state, segments)
        values.append(judged[0])
        places.append(observation["achieved_goal"].copy())
        for action in segments[judged.argmax()]:
            observation, reward, terminated, truncated, _ = env.step(action)
            rewards.append(float(reward))
            ended = terminated or truncated
            if ended:
                break
    places.append(observation["achieved_goal"].copy())
    total, returns = rewards[-1] / (1.0 - critics.discount), []
    for reward in reversed(rewards):
        total = reward + critics.discount * total
        returns.append(total)
    moved = np.linalg.norm(np.diff(places, axis=0), axis=1) > critics.threshold / 10
    first = int(moved.argmax()) if moved.any() else len(values)
    return values, returns[::-1][:: critics.steps], first, rewards[-1] == 0.0


def main() -> None:
    """Prints the lines."""
    run, task = Path(sys.argv[1]), sys.argv[2]
    episodes = int(sys.argv[3]) if len(sys.argv) > 3 else 200
    if task.startswith("gymnasium_robotics:"):
        repair()
    newest = max((run / "policies").glob("*.safetensors"), key=lambda path: int(path.stem))
    policy = dmprl.Policy.load(newest)
    env, critics, rows, rates = dmprl.make(task), Critics(run, policy), [], []
    for random in (None, np.random.default_rng(0)):
        reached = []
        for seed in range(FIRST_SEED, FIRST_SEED + episodes):
            values, returns, first, is_reached = episode(env, policy, critics, seed, random)
            reached.append(is_reached)
            if random is None:
                pairs = zip(values, returns, strict=True)
                rows += [(i - first, v, r, is_reached) for i, (v, r) in enumerate(pairs)]
        rates.append(np.mean(reached))
    rows = np.array(rows)
    print("decision,episodes,value,return,correlation,value_of_successes,value_of_failures")
    for decision in range(-1, 8):
        own = rows[rows[:, 0] == decision]
        value, total, is_reached = own[:, 1], own[:, 2], own[:, 3] == 1.0
        means = [value.mean(), total.mean()]
        by_outcome = [value[is_reached].mean(), value[~is_reached].mean()]
        correlation = np.corrcoef(value, total)[0, 1]
        numbers = [f"{x:.1f}" for x in means] + [f"{correlation:.2f}"]
        numbers += [f"{x:.1f}" for x in by_outcome]
        print(f"{decision},{len(own)},{','.join(numbers)}")
    print(f"# success rate: policy {rates[0]}, best of {CANDIDATES} {rates[1]}")


if __name__ == "__main__":
    main()
