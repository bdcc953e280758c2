"""Prints how the gripper follows actions, and how fast it strikes the puck, as CSV.

    python panda_gym_strikes.py          our task, with .venv's Python
    python panda_gym_strikes.py pg       panda-gym's, with one that has panda-gym 3.0.7

The gripper is lowered behind the puck, with a gap, and moves along x for five steps.
"""

import sys

import gymnasium
import numpy as np

if "pg" in sys.argv:
    import panda_gym  # noqa: F401 - registers the environments

    name, env = "panda-gym", gymnasium.make("PandaSlide-v3").unwrapped
else:
    name, env = "ours", gymnasium.make("dmprl.tasks:dmprl/PandaSlide-v0").unwrapped

HAND, SPEED, PUCK, PUCK_SPEED = slice(0, 3), slice(3, 6), slice(6, 9), slice(12, 14)
BEHIND = 0.042
"""Distance of the puck's and the closed fingers' centres when they touch [m]."""


def step(action: list[float]) -> np.ndarray:
    """Makes a step, and returns the observation without goals."""
    return env.step(np.array(action, np.float32))[0]["observation"]


def follow(axis: int, action: float) -> float:
    """Returns the gripper's mean displacement in four of five steps, of what was asked for."""
    start = env.reset(seed=1)[0]["observation"]
    actions = [action if index == axis else 0.0 for index in range(3)]
    for _ in range(4):
        end = step(actions)
    return float((end[HAND] - start[HAND])[axis] / (4 * 0.05 * action))


def reach() -> float:
    """Returns the part of 3 cm along x that panda-gym's inverse kinematics makes."""
    env.reset(seed=1)
    start = env.robot.get_ee_position().copy()
    target = start + np.array([0.03, 0.0, 0.0])
    down = np.array([1.0, 0.0, 0.0, 0.0])
    env.robot.set_joint_angles(env.robot.inverse_kinematics(env.robot.ee_link, target, down))
    return float((env.robot.get_ee_position() - start)[0] / 0.03)


def strike(action: float, gap: float, seed: int) -> float:
    """Returns the puck's greatest speed [m/s]."""
    state = env.reset(seed=seed)[0]["observation"]
    for index in range(26):
        height = 0.25 if index < 8 else 0.015
        target = np.array([state[PUCK][0] - BEHIND - gap, state[PUCK][1], height])
        way = np.clip((target - state[HAND]) / 0.05, -1.0, 1.0)
        if index < 8:
            way[2] = min(way[2], 0.3)
        state = step(way)
    return max(float(np.linalg.norm(step([action, 0.0, 0.0])[PUCK_SPEED])) for _ in range(5))


print("program,measure,action,gap_m,value")
if name == "panda-gym":
    print(f"{name},part of 3 cm along x by its inverse kinematics,,,{reach():.2f}")
for axis in range(3):
    for action in (0.2, 0.6):
        part = follow(axis, action)
        print(f"{name},part of the displacement along {'xyz'[axis]},{action},,{part:.2f}")
for action in (0.2, 0.4, 0.6, 1.0):
    for gap in (0.01, 0.02, 0.03, 0.04):
        speed = np.mean([strike(action, gap, seed) for seed in range(4)])
        print(f"{name},speed of the puck [m/s],{action},{gap},{speed:.2f}")
