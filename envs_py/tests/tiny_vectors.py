"""Vector environments small enough to check against a loop over single environments.

The Rust tests use them too, as ``tiny_vectors:name`` with this folder on the Python path.
"""

import functools
import sys

import gymnasium
import numpy as np
import tiny_envs
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import batch_space

from dmprl.segment_env import SegmentEnvError


class Wandering(gymnasium.Env):
    """Draws the length of each episode, and noise in each step, from its own generator.

    Observes (steps, length, noise); the reward is the action plus noise. Even lengths terminate,
    odd ones truncate, and only the last step reports success. A step after the end is an error. An
    action of 2 causes ``fault``, but the fault "reset" is an error in the third reset of an object.
    After an action of 1.5, the observation of the next reset has a NaN.
    """

    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = tiny_envs.ACTION
    dt = 0.25
    max_episode_steps = 11

    def __init__(self, fault=None, longest=11):
        self.fault, self.longest = fault, longest
        self.steps, self.length, self.resets, self.nan_next = 0, 0, 0, False

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.resets += 1
        if self.fault == "reset" and self.resets == 3:
            raise ValueError("no way back")
        self.steps, self.length = 0, int(self.np_random.integers(1, self.longest, endpoint=True))
        observation = self.observe()
        if self.nan_next:
            observation[2] = np.nan
        self.nan_next = False
        return observation, {}

    def step(self, action):
        if self.steps >= self.length:
            raise AssertionError("a step after the end of the episode")
        self.steps += 1
        observation, reward = self.observe(), float(action[0]) + self.np_random.uniform()
        if action[0] == 2.0:
            if self.fault == "raise":
                raise ValueError("the joint broke")
            if self.fault == "exit":
                sys.exit("the gripper went home")
            if self.fault == "own":
                raise SegmentEnvError("a task of dmprl's own has diverged")
            if self.fault == "observation":
                observation[1] = np.nan
            if self.fault == "reward":
                reward = np.inf
        self.nan_next = action[0] == 1.5
        ended = self.steps == self.length
        info = {"is_success": reward > 0.5} if ended else {}
        even = self.length % 2 == 0
        return observation, reward, ended and even, ended and not even, info

    def observe(self):
        return np.array([self.steps, self.length, self.np_random.uniform()])


class Shaped(Wandering):
    """Has a Dict with a Discrete and a box of two dimensions, and an action of two dimensions."""

    observation_space = spaces.Dict(
        grid=spaces.Box(-np.inf, np.inf, (2, 2), np.float32),
        mode=spaces.Discrete(3),
        pair=spaces.Tuple((spaces.Box(-9, 99, (1,), np.int64), spaces.Box(0.0, 1.0, ()))),
    )
    action_space = spaces.Box(-2.0, np.array([[1.0], [2.0]]), (2, 1), np.float64)

    def observe(self):
        noise = np.float32(self.np_random.uniform())
        grid = np.array([[self.steps, self.length], [noise, -noise]], "f")
        pair = np.array([self.steps]), np.array(noise)
        return {"grid": grid, "mode": self.steps % 3, "pair": pair}

    def step(self, action):
        return super().step(action[:, 0])


def sync(num_envs, mode="Disabled", single=Wandering, **kwargs):
    """Steps its environments one after the other."""
    single = {"Shaped": Shaped}.get(single, single)
    return SyncVectorEnv([lambda: single(**kwargs)] * num_envs, autoreset_mode=mode)


def in_processes(num_envs, mode="Disabled", shared_memory=True, single=Wandering, **kwargs):
    """Steps each environment in a process of its own."""
    makers = [functools.partial(single, **kwargs)] * num_envs
    return AsyncVectorEnv(makers, shared_memory=shared_memory, autoreset_mode=mode)


def reach(num_envs, mode="Disabled", asynchronous=False):
    """Is goal-conditioned."""
    kind = AsyncVectorEnv if asynchronous else SyncVectorEnv
    return kind(
        [lambda: gymnasium.make("tiny_envs:Reach-v0")] * num_envs,
        autoreset_mode=AutoresetMode(mode),
    )


def counted(num_envs, **kwargs):
    """Has wrappers of Gymnasium for vector environments."""
    return gymnasium.wrappers.vector.RecordEpisodeStatistics(sync(num_envs, **kwargs))


def single(num_envs):
    """Returns no vector environment."""
    return Wandering()


class Simulator(VectorEnv):
    """All :class:`Wandering` environments as arrays, like a batched simulator.

    In the mode ``SAME_STEP``, ``final_obs`` is an array of all observations. ``defect`` makes it
    unsuitable.
    """

    dt = 0.25
    max_episode_steps = 11

    def __init__(self, num_envs, mode="Disabled", defect=None):
        self.num_envs, self.defect = num_envs, defect
        self.metadata = {"autoreset_mode": AutoresetMode(mode)}
        if defect == "mode":
            self.metadata = {}
        if defect == "count":
            self.num_envs += 1
        self.single_observation_space = Wandering.observation_space
        self.single_action_space = Wandering.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.generators = [np.random.default_rng() for _ in range(num_envs)]
        self.steps, self.lengths = np.zeros(num_envs), np.ones(num_envs)
        self.due = np.zeros(num_envs, bool)

    def reset(self, *, seed=None, options=None):
        mask = np.ones(self.num_envs, bool)
        if self.defect != "mask":
            mask = (options or {}).get("reset_mask", mask)
        if self.defect == "one seed" and seed is not None:
            raise TypeError("seed must be an integer")
        for index in np.flatnonzero(mask):
            if seed is not None and seed[index] is not None and self.defect != "seed":
                self.generators[index] = np.random.default_rng(seed[index])
            self.lengths[index] = self.generators[index].integers(1, 11, endpoint=True)
            self.steps[index] = 0
        self.due[mask] = False
        fresh = self.observe(mask)
        self.seen = np.where(mask[:, None], fresh, getattr(self, "seen", fresh))
        return self.seen.copy(), {}

    def step(self, actions):
        resets = self.due & (self.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP)
        if resets.any():
            self.reset(options={"reset_mask": resets})
        moved = ~resets
        self.steps[moved] += 1
        self.seen[moved] = self.observe(moved)[moved]
        noise = np.array([draw.uniform() if it else 0 for draw, it in self.pairs(moved)])
        rewards = np.where(moved, actions[:, 0] + noise, 0.0)
        ended = moved & (self.steps >= self.lengths)
        even = self.lengths % 2 == 0
        infos = {"is_success": rewards > 0.5, "_is_success": ended}
        self.due = ended.copy()
        if ended.any() and self.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP:
            infos = {"final_obs": self.seen.copy(), "final_info": infos}
            if self.defect == "final":
                infos = {}
            self.reset(options={"reset_mask": ended})
        return self.seen.copy(), rewards, ended & even, ended & ~even, infos

    def pairs(self, mask):
        return zip(self.generators, mask, strict=True)

    def observe(self, mask):
        noise = [draw.uniform() if it else 0.0 for draw, it in self.pairs(mask)]
        return np.stack([self.steps, self.lengths, noise], 1)
