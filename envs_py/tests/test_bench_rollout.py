"""Unit tests of the rollout benchmark's peers; the whole is tested through the program."""

import unittest
from unittest import mock

import gymnasium
import numpy as np
import tiny_envs

from dmprl.bench_peers import (
    PANDA_GYM_IDS,
    AbsentError,
    GymnasiumLoop,
    PandaGymLoop,
    RandomActor,
    envpool_id,
    flat,
    gymnasium_env,
)
from dmprl.bench_physics import Ceiling, PlainMujoco
from dmprl.bench_rollout import run_for
from dmprl.numpy_policy import Noise
from dmprl.segment_env import SegmentBuffers, make
from dmprl.tasks import TASKS


def plan(task_id, action_len=2, **exploration):
    """Returns a plan without a policy, for peers and noise that need none."""
    return {
        "task": {"id": task_id},
        "options": "wrappers = []\n[kwargs]\n",
        "env_count": 3,
        "decision_steps": 5,
        "controls": "random",
        "spec": {
            "action_low": [-1.0] * action_len,
            "action_high": [1.0] * action_len,
            "action_len": action_len,
            "episode_steps": 50,
        },
        "exploration": {"kind": "gaussian", "std": 0.1, **exploration},
        "gaussian_std": [],
        "log_stds_len": 0,
    }


class PeerTest(unittest.TestCase):
    def test_envpool_runs_the_same_version_or_its_newest(self):
        known = ["Reacher-v4", "Reacher-v5", "Pusher-v2", "Pusher-v4", "PusherHard-v9"]
        self.assertEqual(envpool_id("Reacher-v5", known), "Reacher-v5")
        self.assertEqual(envpool_id("Pusher-v5", known), "Pusher-v4")
        for task_id in ("Thrower-v0", "dmprl/Reacher-v1", "module:Class"):
            with self.assertRaisesRegex(AbsentError, task_id):
                envpool_id(task_id, known)

    def test_simulations_run_whole_segments(self):
        for kind in (PlainMujoco, Ceiling):
            peer = kind(plan("Reacher-v5"), seed=1)
            self.assertEqual([peer.segment() for _ in range(12)], [15] * 12)

    def test_the_ceiling_runs_segments_longer_than_an_episode(self):
        peer = Ceiling({**plan("Reacher-v5"), "decision_steps": 60}, seed=1)
        self.assertEqual([peer.segment() for _ in range(2)], [180] * 2)

    def test_the_ceiling_repeats_the_episode_of_the_workers_environments(self):
        for task_id, action_len in (("Pusher-v5", 7), ("dmprl/PandaReach-v0", 3)):
            peer, env = Ceiling(plan(task_id, action_len), seed=3), make(task_id, 3, 5)
            spec = env.spec()
            out = SegmentBuffers(3, 5, spec["observation_len"], spec["action_len"])
            env.reset(np.ones(3, np.uint8), np.arange(3, 6, dtype=np.uint64), out)
            actor = RandomActor(plan(task_id, action_len), seed=3)
            for _ in range(4):
                env.step_segment(actor.actions(out.next_observations), out)
                peer.segment()
            np.testing.assert_array_equal(peer._batch.qpos, env.batch.qpos)

    def test_plain_mujoco_repeats_the_episode_of_gymnasium(self):
        peer = PlainMujoco(plan("Reacher-v5"), seed=3)
        env = gymnasium.make("Reacher-v5").unwrapped
        env.reset(seed=5)
        for _ in range(2):
            peer.segment()
        actor = RandomActor(plan("Reacher-v5"), seed=3)
        for action in np.concatenate([actor.actions(None)[2] for _ in range(2)]):
            env.step(action.astype(np.float32))
        np.testing.assert_array_equal(peer._batch.qpos[2], env.data.qpos)

    def test_an_unavailable_peer_has_a_reason(self):
        for peer, task_id in (
            (PlainMujoco, "CartPole-v1"),
            (Ceiling, "Pendulum-v1"),
            (GymnasiumLoop, "Nothing-v0"),
            (GymnasiumLoop, "nowhere:Arm"),
            (GymnasiumLoop, "tiny_envs:Batch"),
            (PandaGymLoop, "Reacher-v5"),
        ):
            with self.assertRaisesRegex(AbsentError, task_id):
                peer(plan(task_id), seed=1)

    def test_the_reason_contains_any_exception_of_gymnasium(self):
        with (
            mock.patch.object(tiny_envs.FaultyReset, "made_max", 0),
            self.assertRaisesRegex(AbsentError, "OSError: no more of them"),
        ):
            gymnasium_env(plan("tiny_envs:FaultyReset-v0"))

    def test_an_unregistered_class_has_the_workers_time_limit(self):
        env = gymnasium_env(plan("tiny_envs:Limited"))
        env.reset(seed=1)
        ended = [env.step(env.action_space.sample())[3] for _ in range(50)]
        self.assertEqual(ended, [False] * 49 + [True])

    def test_nested_observations_are_in_the_workers_order(self):
        for task_id in ("tiny_envs:Goal-v0", "tiny_envs:Nested-v0"):
            out = SegmentBuffers(1, 1, make(task_id, 1, 1).spec()["observation_len"], 1)
            make(task_id, 1, 1).reset(np.ones(1, np.uint8), np.ones(1, np.uint64), out)
            observation = flat(gymnasium_env(plan(task_id)).reset(seed=1)[0])
            np.testing.assert_allclose(observation, out.next_observations[0])

    def test_every_panda_task_has_an_id_in_panda_gym(self):
        self.assertEqual(set(PANDA_GYM_IDS), {task for task in TASKS if "Panda" in task})

    def test_whole_segments_are_measured(self):
        answer = run_for(lambda: 7, 0.01)
        self.assertEqual(answer["steps"] % 7, 0)
        self.assertGreaterEqual(answer["seconds"], 0.01)


class NoiseTest(unittest.TestCase):
    def test_noise_is_held_as_its_kind_requires_and_stays_within_bounds(self):
        for kind, equal_steps in (("gaussian", False), ("segment", True), ("pink", False)):
            u = np.zeros((3, 5, 2), np.float32)
            Noise(plan("Reacher-v5", kind=kind, std=5.0), seed=1).disturb_u(u)
            self.assertTrue((np.abs(u) <= 1.0).all() and (u != 0.0).all())
            self.assertEqual(bool((u == u[:, :1]).all()), equal_steps)

    def test_pink_noise_has_unit_variance_and_restarts_with_an_episode(self):
        noise = Noise({**plan("Reacher-v5", kind="pink", std=0.1), "env_count": 2000}, seed=1)
        first, second = (np.zeros((2000, 4, 2), np.float32) for _ in range(2))
        noise.disturb_u(first)
        noise.episodes_ended(np.ones(2000, np.bool_))
        noise.disturb_u(second)
        # 4000 draws, each with a standard error of 0.02. One step later, 7 of 8 sources are equal.
        self.assertAlmostEqual(float((first[:, 0] ** 2).mean()) / 0.01, 1.0, delta=0.1)
        correlation = (first[:, 0] * first[:, 1]).mean() / 0.01
        self.assertAlmostEqual(float(correlation), 7 / 8, delta=0.1)
        self.assertAlmostEqual(float((first[:, 3] * second[:, 0]).mean()) / 0.01, 0.0, delta=0.1)


if __name__ == "__main__":
    unittest.main()
