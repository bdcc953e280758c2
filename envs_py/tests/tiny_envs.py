"""Environments small enough to compute by hand, registered when this module is imported.

The Rust tests use them too, as ``tiny_envs:Id`` with this folder on the Python path.
"""

import os
import signal
import site
import sys

import gymnasium
import numpy as np
from gymnasium import spaces

from dmprl.segment_env import EnvSpec, SegmentBuffers, SegmentEnv

ACTION = spaces.Box(-2.0, 2.0, (1,), np.float64)


class Countdown(gymnasium.Env):
    """Observes (steps taken, a number drawn at reset); terminates after ``length`` steps.

    The reward is the action. A fault happens in the step whose action is 2: ``fault`` says which.
    """

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = ACTION

    def __init__(self, length=3, fault=None, render_mode=None):
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


class Remembering(Countdown):
    """Keeps its last action, as environments do that charge for its change."""

    def reset(self, *, seed=None, options=None):
        self.last = np.zeros(1)
        return super().reset(seed=seed)

    def step(self, action):
        observation, _, ended, truncated, info = super().step(action)
        change, self.last = abs(action - self.last)[0], action
        return observation, change, ended, truncated, info


class Spaces(Countdown):
    """Has the spaces that it is given."""

    def __init__(self, observation=None, action=None, render_mode=None):
        super().__init__()
        self.observation_space = observation or Countdown.observation_space
        self.action_space = action or ACTION


class Goal(Countdown):
    """A goal-conditioned environment: a Dict observation; does not report success."""

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


class Batch(SegmentEnv):
    """A SegmentEnv of its own, without Gymnasium."""

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
    """Every episode is one segment: the time limit ends it."""

    def step_segment(self, actions, out: SegmentBuffers):
        super().step_segment(actions, out)
        out.truncated[:] = 1


class Interpreter(Batch):
    """Checks the embedded interpreter around it; the Rust tests run it."""

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
register("Raises", Countdown, kwargs={"length": 1000, "fault": "raise"})
register("NanObservation", Countdown, kwargs={"length": 1000, "fault": "observation"})
register("InfReward", Countdown, kwargs={"length": 1000, "fault": "reward"})
register("Remembering", Remembering, kwargs={"length": 1000})
register("Goal", Goal)
register("Discrete", Spaces, kwargs={"action": spaces.Discrete(3)})
register("Unbounded", Spaces, kwargs={"action": spaces.Box(-np.inf, np.inf, (2,))})
register("Image", Spaces, kwargs={"observation": spaces.Box(0, 255, (8, 8, 3), np.uint8)})
