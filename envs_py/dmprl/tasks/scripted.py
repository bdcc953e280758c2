"""Scripted controllers that solve the Panda's tasks with objects, for demonstrations and tests.

``python -m dmprl.tasks.scripted panda-push demos.npz --episodes 50`` writes a file for
``dmprl train panda-push --demos demos.npz``.

A controller sees the same observations as a policy. Lengths are in metres.
"""

from __future__ import annotations

import argparse
from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmprl import SHORT_NAMES
from dmprl.segment_env import SUCCESS_YES, SegmentBuffers, make
from dmprl.tasks import make_task
from dmprl.tasks.panda import DISPLACEMENT
from dmprl.tasks.panda_objects import OBJECT_ENTRIES, PandaObjects, PandaSlide

STEP_S = 0.04
"""Duration of a step [s]."""
ACTION_MAX = 0.6
"""Largest action, because policies of these tasks use this share of the action range."""
SLOW_ACTION_MAX = 0.4
"""The same for `panda-push` and `panda-pick-and-place`."""
TRAVEL_HEIGHT = 0.09
"""Height of the end effector at which it passes over an object."""
PUSH_HEIGHT = 0.02
BEHIND = 0.055
"""Distance behind a cube where a push starts."""
PUSHED_DISTANCE = 0.03
"""Distance from the goal at which a pushed cube may stay."""
CUBE_DECELERATION = 2.45
"""Deceleration of a cube that slides over the table [m/s²]."""

GRIP_HEIGHT = 0.07
"""Height of the end effector over an object before it descends to grip it."""
OPEN_WIDTH, GRIPPED_WIDTH = 0.06, (0.036, 0.058)
"""Width of the fingers above which they fit around a cube, and range in which they hold it."""
CARRY_GAIN, CARRY_MAX = 0.4, 0.025
"""Share of the way to the goal in one step, and its maximum along each axis. A faster start would
pull the fingers off the cube."""
OPEN, CLOSE = ACTION_MAX, -ACTION_MAX
"""Actions of the fingers."""
RELEASE = np.array([0.0, 0.0, 0.0, OPEN])
CLEAR_HEIGHT = 0.1
"""Height at which a cube is carried over another one."""


class State(NamedTuple):
    """An observation of a task with N objects, split into its parts."""

    hand: NDArray[np.float64]
    """Position of the end effector (3,)."""
    width: float
    """Distance of the fingers; 0 if they do not move."""
    objects: NDArray[np.float64]
    """Positions (N, 3)."""
    velocities: NDArray[np.float64]
    """Velocities of the objects (N, 3) [m/s]."""
    goals: NDArray[np.float64]
    """Positions of the goals (N, 3)."""


class Controller(ABC):
    """Acts in one episode, with displacements of the end effector."""

    action_max = ACTION_MAX
    """Larger actions are clipped."""

    @abstractmethod
    def act(self, state: State) -> NDArray[np.float64]:
        """Chooses the action (A,) for a state."""


class Push(Controller):
    """Pushes the cube to the goal."""

    action_max = SLOW_ACTION_MAX

    def act(self, state: State) -> NDArray[np.float64]:  # noqa: D102 - inherited
        return push(state, 0, state.goals[0])


class Slide(Controller):
    """Strikes the puck once, so that it is at the goal at the end of the episode.

    The puck leaves along the normal of the contact. So a corner of the closed fingers, which are a
    box, strikes it on the line to the goal. The stroke takes one step and starts at rest and at a
    small gap, for which the puck's speed was measured.
    """

    radius = 0.03
    """Radius of the puck."""
    corner = (0.009, 0.016)
    """Position of the fingers' corner, from the end effector."""
    gap = 0.004
    """Distance of corner and puck before the stroke."""
    height = 0.018
    """Height of the end effector at the stroke."""
    precision = 0.0008
    """Maximum distance from the start of the stroke, and motion in one step, to strike."""
    strokes = (0.004, 0.008, 0.012, 0.016, 0.020, 0.025, 0.035)
    """Displacements in one step [m]."""
    speeds = (0.0, 0.115, 0.25, 0.38, 0.53, 0.70, 1.05)
    """Speed of the puck after each [m/s]."""
    deceleration = 0.216
    """Deceleration of the puck [m/s²]."""
    flight_steps = PandaSlide.episode_steps + 0.7
    """Steps from the start of the episode to its end; the stroke itself takes some of a step."""

    def __init__(self) -> None:
        self.steps = 0
        self.is_struck = False
        self.hand = np.zeros(3)

    def act(self, state: State) -> NDArray[np.float64]:  # noqa: D102 - inherited
        self.steps += 1
        if self.is_struck:
            return np.zeros(3)
        hand, puck = state.hand, state.objects[0]
        to_goal = state.goals[0, :2] - puck[:2]
        # A slanted stroke turns the puck a little further aside than the normal.
        angle = 0.94 * float(np.arctan2(to_goal[1], to_goal[0]))
        ahead = np.array([np.cos(angle), np.sin(angle)])
        corner = np.copysign(self.corner, ahead)
        offset = puck[:2] - (self.radius + self.gap) * ahead - corner - hand[:2]
        down = self.height - hand[2]
        moved, self.hand = float(np.linalg.norm(hand - self.hand)), hand.copy()
        if abs(down) < 0.012 and max(np.linalg.norm(offset), moved) < self.precision:
            self.is_struck = True
            seconds = STEP_S * (self.flight_steps - self.steps)
            speed = self.speed(float(np.linalg.norm(to_goal)), seconds)
            # Measured: the puck is faster after a slanted stroke and towards three of the edges.
            place = 3.5 * puck[0] ** 2 - 0.25 * puck[1]
            speed /= 1.06 + 0.11 * abs(angle) - 0.15 * speed + place
            stroke = np.interp(speed, self.speeds, self.strokes)
            return towards(np.append(stroke * ahead, down))
        if hand[2] < 0.05:
            return towards(np.append(offset, down))
        start = offset - 0.02 * ahead
        if np.linalg.norm(start) < (0.02 if hand[2] > TRAVEL_HEIGHT - 0.005 else 0.045):
            return towards(0.7 * np.append(start, down))
        return towards(np.append(start, TRAVEL_HEIGHT - hand[2]))

    def speed(self, distance: float, seconds: float) -> float:
        """Computes the speed at which the puck covers a distance in a time, or stops before."""
        moving = distance / seconds + self.deceleration * seconds / 2.0
        if moving > self.deceleration * seconds:
            return moving
        return float(np.sqrt(2.0 * self.deceleration * distance))


class PickAndPlace(Controller):
    """Grips the cube from above, brings it to the goal and holds it there."""

    action_max = SLOW_ACTION_MAX

    def act(self, state: State) -> NDArray[np.float64]:  # noqa: D102 - inherited
        return carry(state, 0, state.goals[0])


class Stack(Controller):
    """Brings the lower cube to its goal, then the upper one on top of it.

    An upper cube that is in the way is first brought aside.
    """

    settle_steps = 4
    """Steps until the upper cube has fallen to the table at the start."""
    spots = np.array([[x, y, 0.02] for x in (-0.12, 0.0, 0.12) for y in (-0.12, 0.0, 0.12)])
    """Places for a cube that is in the way (N, 3)."""
    clearance = 0.07
    """Distance of two cubes along some axis at which both can be gripped and put down."""

    def __init__(self) -> None:
        self.spot: NDArray[np.float64] | None = None
        self.has_looked = False
        self.steps = 0

    def act(self, state: State) -> NDArray[np.float64]:  # noqa: D102 - inherited
        lower, upper = state.objects
        self.steps += 1
        if self.steps <= self.settle_steps:
            return RELEASE
        if not self.has_looked:
            apart = np.abs(lower - upper)
            if apart[0] < 0.035 and apart[1] < 0.085 and apart[2] < 0.01:
                # A finger does not fit between them.
                away = np.array([np.copysign(0.05, upper[0] - lower[0]), 0.0, 0.0])
                return np.append(push(state, 1, upper + away), CLOSE)
            self.has_looked = True
            self.spot = self.spot_aside(upper, lower, state.goals[0])
        if self.spot is not None:
            if not is_put(state, 1, self.spot):
                return carry_over(state, 1, self.spot)
            if state.width < OPEN_WIDTH:
                return RELEASE
            self.spot = None
        on_top = np.append(lower[:2], state.goals[1, 2])
        for index, goal in enumerate((state.goals[0], on_top)):
            if not is_put(state, index, goal):
                return carry_over(state, index, goal)
            if state.width < OPEN_WIDTH and is_near(state, index):
                return RELEASE
        return np.append(towards(np.array([0.0, 0.0, CLEAR_HEIGHT - state.hand[2]])), OPEN)

    def spot_aside(
        self, cube: NDArray[np.float64], *others: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        """Returns the nearest spot clear of other cubes, or None if the cube is already clear."""
        places = np.vstack([cube, self.spots])
        distances = [np.abs(places[:, :2] - other[:2]).max(axis=1) for other in others]
        clear = places[np.min(distances, axis=0) > self.clearance]
        nearest = clear[np.linalg.norm(clear - cube, axis=1).argmin()]
        return None if (nearest == cube).all() else nearest


CONTROLLERS: dict[str, type[Controller]] = {
    "dmprl/PandaPush-v0": Push,
    "dmprl/PandaSlide-v0": Slide,
    "dmprl/PandaPickAndPlace-v0": PickAndPlace,
    "dmprl/PandaStack-v0": Stack,
}
"""Controllers by Gymnasium id; they also solve the task with a dense reward."""


def towards(displacement: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the action (3,) that moves the end effector by this, or as far as one action can."""
    return np.clip(displacement / DISPLACEMENT, -ACTION_MAX, ACTION_MAX)


def push(state: State, index: int, goal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Goes behind a cube, as seen from a goal, and pushes it ahead in short strokes.

    A cube that was pushed slides on, so each stroke waits for the end of the last one.
    """
    hand, velocity = state.hand, state.velocities[index, :2]
    speed = float(np.linalg.norm(velocity))
    rest = state.objects[index, :2] + velocity * speed / (2.0 * CUBE_DECELERATION)
    to_goal = goal[:2] - rest
    distance = float(np.linalg.norm(to_goal))
    if distance < PUSHED_DISTANCE or speed > 0.15:
        return np.zeros(3)
    ahead = to_goal / distance
    offset = hand[:2] - rest
    along = float(offset @ ahead)
    aside = offset - along * ahead
    from_line = float(np.linalg.norm(aside))
    down = PUSH_HEIGHT - hand[2]
    if hand[2] < 0.045 and -0.09 < along < 0.0 and from_line < 0.012:
        stroke = min(0.015, 0.006 + 0.15 * distance)
        return towards(np.append(stroke * ahead - aside, down))
    start = -offset - BEHIND * ahead
    if -0.12 < along < -0.035 and from_line < 0.05 and hand[2] < TRAVEL_HEIGHT + 0.01:
        return towards(0.7 * np.append(start, down))
    up = TRAVEL_HEIGHT - hand[2]
    if up > 0.02 and np.linalg.norm(offset) < 0.1:
        start = np.zeros(2)
    return towards(np.append(start, up))


def carry(state: State, index: int, goal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Grips a cube from above and brings it straight to a goal; returns the action (4,)."""
    cube, hand = state.objects[index], state.hand
    offset = cube - hand
    if is_held(state, index):
        step = CARRY_GAIN * (goal - cube)
        return np.append(towards(np.clip(step, -CARRY_MAX, CARRY_MAX)), CLOSE)
    sideways = float(np.linalg.norm(offset[:2]))
    if sideways < 0.015 and abs(offset[2]) < (0.02 if state.width < OPEN_WIDTH else 0.008):
        return np.array([0.0, 0.0, 0.0, CLOSE])
    if sideways < 0.03 and state.width > OPEN_WIDTH and hand[2] < cube[2] + GRIP_HEIGHT + 0.02:
        down = offset[2] if sideways < 0.01 or hand[2] < cube[2] + 0.5 * GRIP_HEIGHT else 0.0
        return np.append(towards(0.6 * np.append(offset[:2], down)), OPEN)
    up = cube[2] + GRIP_HEIGHT - hand[2]
    side = offset[:2] if up < 0.02 else np.zeros(2)
    return np.append(towards(np.append(side, up)), OPEN)


def carry_over(state: State, index: int, goal: NDArray[np.float64]) -> NDArray[np.float64]:
    """As :func:`carry`, but above other cubes, and down onto the goal at the end."""
    cube = state.objects[index]
    if np.linalg.norm(goal[:2] - cube[:2]) < 0.015:
        return carry(state, index, goal)
    side = goal[:2] if cube[2] > CLEAR_HEIGHT - 0.035 else cube[:2]
    return carry(state, index, np.append(side, CLEAR_HEIGHT))


def is_near(state: State, index: int) -> bool:
    """Returns whether a cube is between the fingers, or close to them."""
    return bool(np.linalg.norm(state.objects[index] - state.hand) < 0.04)


def is_held(state: State, index: int) -> bool:
    """Returns whether the fingers are closed around a cube."""
    low, high = GRIPPED_WIDTH
    return low < state.width < high and is_near(state, index)


def is_put(state: State, index: int, goal: NDArray[np.float64]) -> bool:
    """Returns whether a cube is at a goal, precisely enough to release it, or to leave it."""
    offset = state.objects[index] - goal
    precision = 0.015 if is_held(state, index) else 0.045
    return bool(np.linalg.norm(offset[:2]) < precision and abs(offset[2]) < 0.015)


def split(task: PandaObjects, row: NDArray[np.float64]) -> State:
    """Splits an observation of a task with displacements of the end effector."""
    count, width = len(task.scene.objects), task.scene.has_gripper
    hand = row[6 * count :]
    objects = hand[8 if width else 6 :][: OBJECT_ENTRIES * count].reshape(count, OBJECT_ENTRIES)
    return State(
        hand=hand[:3],
        width=float(hand[6]) if width else 0.0,
        objects=objects[:, :3],
        velocities=objects[:, 6:9],
        goals=row[3 * count : 6 * count].reshape(count, 3),
    )


class Recording(NamedTuple):
    """Episodes of a scripted controller."""

    steps: dict[str, NDArray]
    """The arrays that ``--demos`` reads, one episode after the other."""
    success: NDArray[np.bool_]
    """Whether each episode ended at the goal."""

    def successful(self) -> dict[str, NDArray]:
        """Returns the steps of the successful episodes."""
        count = len(self.success)
        return {
            name: rows.reshape(count, -1, *rows.shape[1:])[self.success].reshape(
                -1, *rows.shape[1:]
            )
            for name, rows in self.steps.items()
        }


def record(task_id: str, episodes: int, seed: int) -> Recording:
    """Runs episodes, the first with this seed and each other with the next one."""
    task, env = make_task(task_id, 1), make(task_id, episodes, 1)
    controllers = [CONTROLLERS[task_id.replace("Dense", "")]() for _ in range(episodes)]
    out = SegmentBuffers(episodes, 1, env.spec()["observation_len"], len(task.action_low))
    env.reset(np.ones(episodes, np.uint8), np.arange(seed, seed + episodes, dtype=np.uint64), out)
    kept: dict[str, list[NDArray]] = {}
    while not out.truncated.any():
        for index, controller in enumerate(controllers):
            state, most = split(task, out.next_observations[index]), controller.action_max
            out.actions[index, 0] = np.clip(controller.act(state), -most, most)
        env.step_segment(out.actions, out)
        step = {
            "observations": out.observations[:, 0],
            "actions": out.actions[:, 0],
            "rewards": out.rewards[:, 0],
            "next_observations": out.observations[:, 1],
            "terminated": out.terminated,
            "truncated": out.truncated,
        }
        for name, values in step.items():
            kept.setdefault(name, []).append(values.copy())
    steps = {name: np.concatenate(np.swapaxes(rows, 0, 1)) for name, rows in kept.items()}
    return Recording(steps, out.success == SUCCESS_YES)


def main() -> None:
    """Writes the successful ones of a number of episodes."""
    parser = argparse.ArgumentParser(prog="dmprl.tasks.scripted", description=main.__doc__)
    names = {
        name: id_ for name, id_ in SHORT_NAMES.items() if id_.replace("Dense", "") in CONTROLLERS
    }
    parser.add_argument("task", choices=names)
    parser.add_argument("output", help="the file, NAME.npz")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0, help="seed of the first episode")
    arguments = parser.parse_args()
    recording = record(names[arguments.task], arguments.episodes, arguments.seed)
    steps = recording.successful()
    np.savez(arguments.output, **steps)
    count, written = recording.success.sum(), len(steps["rewards"])
    print(f"{count} of {arguments.episodes} episodes succeeded; {written} steps written")


if __name__ == "__main__":
    main()
