"""Starts, rewards and successes of panda-gym 3.0.7, for the tasks in ``dmprl.tasks.panda_objects``.

python -m pip install panda-gym==3.0.7
python tests/golden/panda_gym/make_golden.py > tests/golden/panda_gym/golden.json
"""

import json

import gymnasium
import numpy as np
import panda_gym  # noqa: F401 - registers its tasks

TASKS = ("PandaPush", "PandaSlide", "PandaPickAndPlace", "PandaStack")
SEEDS, PAIRS = 10, 20


def starts(env):
    """Goals and the objects' positions at the start of the episode of each seed."""
    rows = [env.reset(seed=seed)[0] for seed in range(SEEDS)]
    keys = {"goal": "desired_goal", "objects": "achieved_goal"}
    return {name: rounded([row[key] for row in rows], 7) for name, key in keys.items()}


def rewards(name, length):
    """Rewards of random pairs of goals; the distance of about half of them is a success."""
    rng = np.random.default_rng(0)
    achieved = rng.uniform(-0.2, 0.2, (PAIRS, length))
    direction = rng.normal(size=(PAIRS, length))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    threshold = 0.1 if name == "PandaStack" else 0.05
    desired = achieved + direction * rng.uniform(0.0, 2.0 * threshold, (PAIRS, 1))
    achieved, desired = np.round(achieved, 4), np.round(desired, 4)
    values = {"achieved": achieved.tolist(), "desired": desired.tolist()}
    for kind, suffix in (("sparse", ""), ("dense", "Dense")):
        env = gymnasium.make(f"{name}{suffix}-v3").unwrapped
        values[kind] = rounded(env.compute_reward(achieved, desired, {}), 7)
        values["success"] = env.task.is_success(achieved, desired).tolist()
        env.close()
    return values


def rounded(values, digits):
    """A list of numbers, which are in float32."""
    return np.round(np.asarray(values, np.float64), digits).tolist()


def golden(name):
    env = gymnasium.make(f"{name}-v3")
    values = starts(env.unwrapped)
    env.close()
    return values | {"rewards": rewards(name, len(values["goal"][0]))}


print(json.dumps({name: golden(name) for name in TASKS}))
