"""Environments small enough to compute by hand, registered when this module is imported.

The Rust tests use them too, as ``tiny_envs:Id`` with this folder on the Python path.
"""

import ctypes
import multiprocessing
import os
import pathlib
import signal
import site
import sys
import threading
import time

import gymnasium
import numpy as np
from gymnasium import spaces

from dmprl.segment_env import EnvSpec, SegmentBuffers, SegmentEnv

ACTION = spaces.Box(-2.0, 2.0, (1,), np.float64)


class Countdown(gymnasium.Env):
    """Observes (number of steps, a random number of the episode); ends after ``length`` steps.

    The reward is the action. An action of 2 causes the fault ``fault``.
    """

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = ACTION

    def __init__(self, length=3, fault=None, render_mode=None):
        if length < 1:
            raise ValueError(f"length is {length}; expected 1 or more")
        self.length, self.fault = length, fault

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.draw = 0, self.np_random.uniform()
        return np.array([0.0, self.draw]), {}

    def step(self, action):
        self.steps += 1
        observation, reward = np.array([self.steps, self.draw]), action[0]
        if action[0] == 2.0:
            if self.fault == "raise":
                raise ValueError("the joint broke")
            if self.fault == "observation":
                observation[1] = np.nan
            if self.fault == "reward":
                reward = np.inf
        ended = self.steps >= self.length
        return observation, reward, ended, False, {"is_success": ended and reward > 0}


class Forking(Countdown):
    """Forks a process at every reset."""

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        with multiprocessing.get_context("fork").Pool(1) as pool:
            self.draw = observation[1] = pool.apply(float, ("0.25",))
            pool.close()
            pool.join()
        return observation, info


class Faulty(Countdown):
    """Fails in step ``failing_step`` of this object, counted over all its episodes.

    With ``once``, only if no file in the working directory marks an earlier failure.
    """

    def __init__(self, fault, failing_step=23, once=False, render_mode=None):
        super().__init__(length=10**9)
        self.kind, self.failing_step, self.once = fault, failing_step, once
        self.steps_total = 0

    def step(self, action):
        self.steps_total += 1
        observation, reward, *rest = super().step(action)
        if self.steps_total == self.failing_step and (not self.once or mark("broken")):
            if self.kind == "raise":
                raise ValueError("the gripper fell off")
            if self.kind == "exit":
                sys.exit("the gripper went home")
            if self.kind == "observation":
                observation[1] = np.nan
            if self.kind == "reward":
                reward = np.inf
            if self.kind == "hang":
                threading.Event().wait()
            if self.kind == "hang-with-lock":
                ctypes.PyDLL(None).pause()  # PyDLL does not release the GIL
            if self.kind == "segfault":
                ctypes.string_at(0)
        return observation, reward, *rest


def mark(name):
    """Creates a file; returns whether it did not exist before."""
    try:
        pathlib.Path(name).touch(exist_ok=False)
    except FileExistsError:
        return False
    return True


class FaultyReset(Countdown):
    """Raises an exception in reset number ``last`` of this object, and when it is closed."""

    made, made_max = 0, 10**9

    def __init__(self, last=2, render_mode=None):
        if type(self).made >= type(self).made_max:
            raise OSError("no more of them")
        type(self).made += 1
        super().__init__()
        self.last, self.resets = last, 0

    def reset(self, *, seed=None, options=None):
        self.resets += 1
        if self.resets == self.last:
            raise ValueError("no way back")
        return super().reset(seed=seed)

    def close(self):
        raise ValueError("it does not even close")


class Limited(Countdown):
    """An unregistered class, named as ``tiny_envs:Limited``."""

    max_episode_steps = 8
    action_space = spaces.Box(np.array([-15.0, 0.0], "f"), np.array([5.0, 4.0], "f"))

    def __init__(self):
        super().__init__(length=1000)


def short_countdown(**kwargs):
    """Creates an environment; an entry point that is a function."""
    return Countdown(length=2, **kwargs)


def doubled(env):
    """Doubles rewards; a wrapper that is a function."""
    return gymnasium.wrappers.TransformReward(env, lambda reward: 2.0 * reward)


def incremented(env):
    """Adds 1 to rewards."""
    return gymnasium.wrappers.TransformReward(env, lambda reward: reward + 1.0)


class Clocked(gymnasium.wrappers.TimeAwareObservation):
    """Observes the time too; a wrapper that is a class."""


def unwrapping(env):
    """Returns no environment."""
    return env.observation_space


class StrangeInfo(Countdown):
    """Reports a success that is neither true nor false."""

    def step(self, action):
        observation, reward, ended, truncated, _ = super().step(action)
        return observation, reward, ended, truncated, {"success": np.array([True, False])}


class Timeless(Countdown):
    """Reports NaN as the duration of a step."""

    dt = float("nan")


class Remembering(Countdown):
    """Keeps its last action, like environments that penalise its change."""

    def reset(self, *, seed=None, options=None):
        self.last = np.zeros(1)
        return super().reset(seed=seed)

    def step(self, action):
        observation, _, ended, truncated, info = super().step(action)
        change, self.last = abs(action - self.last)[0], action
        return observation, change, ended, truncated, info


class Spaces(Countdown):
    """Has the given spaces."""

    def __init__(self, observation=None, action=None, render_mode=None):
        super().__init__()
        self.observation_space = observation or Countdown.observation_space
        self.action_space = action or ACTION


class Grid(Countdown):
    """Observes [[steps, steps], [draw, draw]]; the reward is the last entry of a (2, 2) action."""

    observation_space = spaces.Box(-np.inf, np.inf, (2, 2), np.float64)
    action_space = spaces.Box(np.array([[-1, -2], [-3, -4]]), np.ones((2, 2)), dtype=np.float64)

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        return np.stack([observation] * 2, 1), info

    def step(self, action):
        observation, *rest = super().step(action[1, 1:])
        return np.stack([observation] * 2, 1), *rest


class Typed(Countdown):
    """Observes numbers of a given type."""

    def __init__(self, dtype, render_mode=None):
        super().__init__(length=1000)
        self.observation_space = spaces.Box(0, 100, (2,), dtype)

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        return observation.astype(self.observation_space.dtype), info

    def step(self, action):
        observation, *rest = super().step(action)
        return observation.astype(self.observation_space.dtype), *rest


class Goal(Countdown):
    """Goal-conditioned, with a Dict observation; does not report success."""

    observation_space = spaces.Dict(
        {name: spaces.Box(-1, 1, (2,)) for name in ("observation", "desired_goal")}
    )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observe(), {}

    def step(self, action):
        _, reward, terminated, truncated, _ = super().step(action)
        return self.observe(), reward, terminated, truncated, {}

    def observe(self):
        return {"observation": np.full(2, 0.25, "f"), "desired_goal": np.full(2, 0.5, "f")}


class Reach(gymnasium.Env):
    """A point on a line, moved by half of the action; the reward is 0 near a random goal, else -1.

    - ``ends``: an episode ends at its goal.
    - ``alone``: ``compute_reward`` takes only one goal at a time.
    - ``fault``: the reward of any goal but the current one is NaN.
    """

    observation_space = spaces.Dict(
        achieved_goal=spaces.Box(-99, 99, (1,), np.float64),
        desired_goal=spaces.Box(-99, 99, (1,), np.float64),
        observation=spaces.Box(-99, 99, (2,), np.float64),
    )
    action_space = ACTION

    def __init__(self, ends=False, alone=False, fault=False, render_mode=None):
        self.ends, self.alone, self.fault = ends, alone, fault

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.goal, self.steps = 0.0, self.np_random.uniform(-6.0, 6.0, 1), 0
        return self.observe(), {}

    def step(self, action):
        self.place += 0.5 * float(action[0])
        self.steps += 1
        observation = self.observe()
        goals = observation["achieved_goal"], self.goal
        reached = bool(np.abs(goals[0] - goals[1])[0] <= 0.5)
        info = {"is_success": reached}
        return observation, float(reached) - 1.0, self.ends and reached, False, info

    def observe(self):
        place = np.array([self.place])
        observed = np.array([self.place, self.steps])
        return {"achieved_goal": place, "desired_goal": self.goal.copy(), "observation": observed}

    def compute_reward(self, achieved_goal, desired_goal, info):
        near = np.abs(achieved_goal - desired_goal)[..., 0] <= 0.5
        if self.fault and np.ndim(near) and self.goal not in desired_goal and len(near) != 32:
            return np.full(len(near), np.nan)
        return bool(near.all()) - 1.0 if self.alone else near - 1.0

    def compute_terminated(self, achieved_goal, desired_goal, info):
        return self.ends and abs(float(achieved_goal[0] - desired_goal[0])) <= 0.5


class ReachFar(Reach):
    """Like :class:`Reach`, but the reward is minus the distance."""

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -np.abs(achieved_goal - desired_goal)[..., 0]


class ReachByHand(Reach):
    """Like :class:`Reach`, but declares ``goal_rule``."""

    def __init__(self, declared=None, **kwargs):
        super().__init__(**kwargs)
        self.goal_rule = declared


class ReachInBox(gymnasium.Env):
    """Three-dimensional goals, of which the third does not count, rewarded by the largest entry."""

    action_space = ACTION
    observation_space = spaces.Dict(
        {
            name: spaces.Box(-np.inf, np.inf, (3,), np.float32)
            for name in ("achieved_goal", "desired_goal")
        }
    )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def compute_reward(self, achieved_goal, desired_goal, info):
        far = np.abs(achieved_goal - desired_goal)[..., :2].max(axis=-1) > 0.25
        return np.where(far, 0.0, 10.0)


class ReachTwisted(ReachInBox):
    """Rewards by the distance of the goals' squares, which follows no known rule."""

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -np.abs(achieved_goal**2 - desired_goal**2).sum(axis=-1)


class FaultyReach(Reach):
    """Fails in its 12th step, and is then recreated."""

    steps_total = 0

    def step(self, action):
        self.steps_total += 1
        if self.steps_total == 12:
            raise ValueError("the line broke")
        return super().step(action)


class Nested(Goal):
    """Observes a Dict with a Dict and a Tuple in it; one of its numbers is NaN after two steps."""

    observation_space = spaces.Dict(
        arm=spaces.Dict(q=spaces.Box(-1, 1, (2,)), grip=spaces.Discrete(2)),
        parts=spaces.Tuple((spaces.Box(-9, 9, (1, 2), np.int8), spaces.Box(0, 1, ()))),
    )

    def observe(self):
        broken = np.nan if self.steps == 2 else 0.5
        parts = (np.full((1, 2), self.steps, np.int8), np.array(broken, "f"))
        return {"arm": {"q": np.full(2, 0.25, "f"), "grip": 1}, "parts": parts}


class Batch(SegmentEnv):
    """A SegmentEnv without Gymnasium."""

    def __init__(self, env_count, segment_steps):
        self.env_count, self.segment_steps = env_count, segment_steps

    def spec(self) -> EnvSpec:
        return {
            "id": "Batch",
            "observation_len": 1,
            "action_len": 1,
            "action_low": [-1.0],
            "action_high": [1.0],
            "control_dt_s": 0.5,
            "episode_steps": 0,
        }

    def reset(self, mask, seeds, out: SegmentBuffers):
        out.next_observations[mask != 0, 0] = seeds[mask != 0]

    def step_segment(self, actions, out: SegmentBuffers):
        out.rewards[:] = actions[:, :, 0]
        out.steps[:] = self.segment_steps


class Timed(Batch):
    """Truncates every episode after one segment."""

    def step_segment(self, actions, out: SegmentBuffers):
        super().step_segment(actions, out)
        out.truncated[:] = 1


class Slow(Batch):
    """Takes half a second for a segment."""

    def step_segment(self, actions, out: SegmentBuffers):
        time.sleep(0.5)
        super().step_segment(actions, out)


class ScaledBatch(Batch):
    """Takes an argument."""

    def __init__(self, env_count, segment_steps, scale=1.0):
        super().__init__(env_count, segment_steps)
        self.scale = scale

    def step_segment(self, actions, out: SegmentBuffers):
        super().step_segment(self.scale * actions, out)


class BatchOfNan(Batch):
    """Returns NaN for all rewards of the first row in the second call, and recreates nothing."""

    calls = 0

    def step_segment(self, actions, out: SegmentBuffers):
        super().step_segment(actions, out)
        self.calls += 1
        if self.calls == 2:
            out.rewards[0] = np.nan


class Interpreter(Batch):
    """Checks the embedded interpreter it runs in; the Rust tests use it."""

    def step_segment(self, actions, out: SegmentBuffers):
        assert sys.prefix != sys.base_prefix, "sys.prefix is not the virtual environment"
        assert os.path.samefile(sys.executable, os.path.join(sys.prefix, "bin/python"))
        assert "" not in sys.path and os.getcwd() not in sys.path, sys.path
        assert not site.ENABLE_USER_SITE
        assert sys.flags.isolated and sys.flags.utf8_mode and not sys.flags.hash_randomization
        assert signal.getsignal(signal.SIGINT) is not signal.default_int_handler
        assert sys.stdout is sys.stderr and sys.stdin.read() == ""
        super().step_segment(actions, out)


def register(name, entry_point, **kwargs):
    gymnasium.register(f"{name}-v0", entry_point, **kwargs)


register("Countdown", Countdown)
register("Long", Countdown, kwargs={"length": 1000}, max_episode_steps=7)
register("Forking", Forking, kwargs={"length": 1000}, max_episode_steps=100)
register("Raises", Countdown, kwargs={"length": 1000, "fault": "raise"})
register("NanObservation", Countdown, kwargs={"length": 1000, "fault": "observation"})
register("InfReward", Countdown, kwargs={"length": 1000, "fault": "reward"})
register("Remembering", Remembering, kwargs={"length": 1000})
for kind in ("raise", "exit", "observation", "reward"):
    register(f"Faulty{kind.title()}", Faulty, kwargs={"fault": kind}, max_episode_steps=7)
for kind in ("hang", "hang-with-lock", "segfault"):
    name = "".join(word.title() for word in kind.split("-"))
    register(f"{name}Once", Faulty, kwargs={"fault": kind, "once": True}, max_episode_steps=7)
register("Hopeless", Faulty, kwargs={"fault": "raise", "failing_step": 1}, max_episode_steps=7)
register("FaultyReset", FaultyReset)
register("Nested", Nested)
register("Grid", Grid)
for dtype in ("int8", "uint16", "int64", "float16", "float32"):
    register(f"Typed-{dtype}", Typed, kwargs={"dtype": dtype})
register("Goal", Goal)
register("Reach", Reach, max_episode_steps=12)
register("ReachEnds", Reach, kwargs={"ends": True}, max_episode_steps=12)
register("ReachAlone", Reach, kwargs={"alone": True}, max_episode_steps=12)
register("ReachNan", Reach, kwargs={"fault": True}, max_episode_steps=12)
register("ReachTimeless", Reach)
register("ReachFar", ReachFar, max_episode_steps=12)
register("FaultyReach", FaultyReach, max_episode_steps=20)
SPARSE = {"norm": "euclidean", "threshold": 0.5, "reached": 0.0, "missed": -1.0}
for name, declared in (
    ("Declared", SPARSE),
    ("Wrong", {**SPARSE, "threshold": 0.51}),
    ("Undeclared", None),
):
    register(f"Reach{name}", ReachByHand, kwargs={"declared": declared}, max_episode_steps=12)
register("ReachInBox", ReachInBox, max_episode_steps=12)
register("ReachTwisted", ReachTwisted, max_episode_steps=12)
register("Discrete", Spaces, kwargs={"action": spaces.Discrete(3)})
register("Unbounded", Spaces, kwargs={"action": spaces.Box(-np.inf, np.inf, (2,))})
register("Image", Spaces, kwargs={"observation": spaces.Box(0, 255, (8, 8, 3), np.uint8)})
CAMERA = spaces.Tuple((ACTION, spaces.Dict(front=spaces.Box(0, 255, (8, 8), np.uint8))))
register("Camera", Spaces, kwargs={"observation": CAMERA})
register("Words", Spaces, kwargs={"observation": spaces.Text(9)})
