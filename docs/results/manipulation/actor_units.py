"""Shows how far an actor is saturated: ``python actor_units.py RUN TASK [EPISODES]``.

It runs a run's latest policy without noise and prints a line of CSV: the size of the network's
outputs before their tanh, and how many units of the last hidden layer are active.
"""

from __future__ import annotations

import json
import sys

import numpy as np

import dmprl
from dmprl.policy_file import read
from dmprl.robotics_repair import repair

FIRST_SEED = 7000
HEADER = (
    "task,env_steps,episodes,decisions,output_p50,output_p99,units,units_never_active,"
    "active_units_mean,decisions_without_active_unit"
)


def measure(run: dmprl.Run, task: str, episodes: int) -> str:
    """Runs the episodes and returns the line."""
    if task.startswith("gymnasium_robotics:"):
        repair()
    policy, env = run.policy("latest"), dmprl.make(task)
    lines = (run.path / "evaluations.jsonl").read_text().splitlines()
    version = json.loads(lines[-1])["policy_version"]
    file = read(run.path / "policies" / f"{version}.safetensors")
    outputs, active = [], []
    for seed in range(FIRST_SEED, FIRST_SEED + episodes):
        observation, _ = env.reset(seed=seed)
        ended = False
        while not ended:
            if isinstance(observation, dict):
                observation = np.concatenate([observation[key] for key in sorted(observation)])
            x = observation
            for weights, bias in file.layers[:-1]:
                x = np.maximum(weights @ x + bias, 0.0)
            active.append(x > 0.0)
            outputs.append(np.abs(file.layers[-1][0] @ x + file.layers[-1][1]))
            for action in policy.segment(observation):
                observation, _, terminated, truncated, _ = env.step(action)
                ended = terminated or truncated
                if ended:
                    break
    is_active, sizes = np.array(active), np.array(outputs)
    per_decision = is_active.sum(axis=1)
    fields = [
        task,
        file.env_steps,
        episodes,
        len(per_decision),
        f"{np.percentile(sizes, 50):.2f}",
        f"{np.percentile(sizes, 99):.2f}",
        is_active.shape[1],
        int((~is_active.any(axis=0)).sum()),
        f"{per_decision.mean():.1f}",
        int((per_decision == 0).sum()),
    ]
    return ",".join(map(str, fields))


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    count = int(sys.argv[3]) if len(sys.argv) == 4 else 60
    print(HEADER)
    print(measure(dmprl.Run(sys.argv[1]), sys.argv[2], count))
