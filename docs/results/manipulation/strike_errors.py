"""Prints how well a network predicts where a struck object ends, from the replay of a run.

    python strike_errors.py RUN      with NumPy and PyTorch

A strike is a segment that begins with the object at rest and moves it by more than 15 mm. The
network sees the observation without the goal, and the segment's actions, and predicts the way to
the object's place at the end of the episode. A tenth of the strikes are for the test.
"""

import struct
import sys
from pathlib import Path

import numpy as np
import torch

NONE = 2**32 - 1
SLOT = np.dtype([("next", "<u4"), ("steps", "u1"), ("flags", "u1", 3)])
GOAL = slice(0, 2)
"""The object's x and y in an observation; the achieved goal comes first."""

torch.set_num_threads(1)
torch.manual_seed(0)
random = np.random.default_rng(0)


def read_replay(run: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns the next slot, whether a time limit ends it, observations and actions of slots."""
    data = (Path(run) / "checkpoints/latest/replay.bin").read_bytes()
    steps, width, actions, _, filled, *_ = struct.unpack("<9Q", data[8:80])
    slots = np.frombuffer(data, SLOT, filled, 80)
    block = (steps + 1) * width + steps * actions + steps
    blocks = np.frombuffer(data[-filled * block * 4 :], "<f4").reshape(filled, block)
    observations = blocks[:, : (steps + 1) * width].reshape(filled, steps + 1, width)
    rest = blocks[:, (steps + 1) * width :][:, : steps * actions]
    return slots["next"], slots["flags"][:, 1] == 1, observations, rest


def print_errors(name: str, inputs: np.ndarray, ways: np.ndarray) -> None:
    """Trains a network on nine tenths of the rows and prints its errors on the others."""
    order = random.permutation(len(inputs))
    test, train = order[: len(order) // 10], order[len(order) // 10 :]
    scale = inputs[train].std(0) + 1e-6
    x = torch.tensor((inputs - inputs[train].mean(0)) / scale).float()
    y = torch.tensor(ways).float()
    layers = [torch.nn.Linear(x.shape[1], 256), torch.nn.ReLU(), torch.nn.Linear(256, 256)]
    network = torch.nn.Sequential(*layers, torch.nn.ReLU(), torch.nn.Linear(256, 2))
    adam = torch.optim.Adam(network.parameters(), 1e-3)
    for _ in range(3000):
        batch = random.choice(train, 256)
        loss = (network(x[batch]) - y[batch]).norm(dim=1).mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
    with torch.no_grad():
        error = (network(x[test]) - y[test]).norm(dim=1).numpy()
    spread = np.linalg.norm(ways.std(0))
    within = (error < 0.05).mean()
    print(f"{name},{len(train)},{np.median(error):.3f},{within:.2f},{spread:.3f}")


following, at_limit, observations, actions = read_replay(sys.argv[1])
count = len(following)
previous, last = np.full(count, -1), np.arange(count)
for slot in range(count):
    if following[slot] != NONE:
        previous[following[slot]] = slot
for slot in range(count - 1, -1, -1):
    if following[slot] != NONE:
        last[slot] = last[following[slot]]
start, end, final = (
    observations[:, 0, GOAL],
    observations[:, -1, GOAL],
    observations[last, -1, GOAL],
)
before = observations[previous, 0, GOAL]
rests = (previous < 0) | (np.linalg.norm(start - before, axis=1) < 1e-3)
moves = np.linalg.norm(end - start, axis=1) > 0.015
strikes = np.flatnonzero(rests & moves & at_limit[last] & (following != NONE))
ways, goals = final - start, observations[:, 0, 3:5] - start
ratio = np.linalg.norm(ways, axis=1) / np.linalg.norm(goals, axis=1).clip(1e-6)
late = strikes[strikes > count // 2]
print(f"# {(previous < 0).sum()} episodes, {len(strikes)} strikes; those of the later half go")
print(
    "# {:.2f}, {:.2f}, {:.2f} of the way to the goal".format(
        *np.quantile(ratio[late], [0.25, 0.5, 0.75])
    )
)
print("prediction,strikes,median_error_m,within_5_cm,spread_m")
seen = observations[:, :, 6:]
known = np.concatenate([start, seen[:, 0], actions], axis=1)
print_errors("from state and actions of the strike", known[strikes], ways[strikes])
after = np.concatenate([end, seen[:, -1]], axis=1)
print_errors("from the state after it", after[strikes], (final - end)[strikes])
