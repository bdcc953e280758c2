"""What is written down of an episode, and which joints are the robot's."""

import sys
import unittest
from pathlib import Path

import mujoco
import numpy as np

from dmprl import recording
from dmprl.robot_joints import robot_joints
from dmprl.segment_env import SegmentBuffers, make

sys.path.append(str(Path(__file__).parent))  # for the tiny environments' module
sys.path.append(str(Path(__file__).resolve().parents[2] / "docs" / "examples"))

STEPS = 5


def episode(env, seed=1000):
    """Runs an episode of random actions; returns its rewards."""
    spec = env.spec()
    out = SegmentBuffers(1, STEPS, spec["observation_len"], spec["action_len"])
    env.reset(np.ones(1, np.uint8), np.array([seed], np.uint64), out)
    random, rewards = np.random.default_rng(3), []
    low, high = spec["action_low"], spec["action_high"]
    while not (out.terminated[0] or out.truncated[0]):
        env.step_segment(random.uniform(low, high, (1, STEPS, spec["action_len"])), out)
        rewards += out.rewards[0, : out.steps[0]].tolist()
    return rewards


class EpisodeTest(unittest.TestCase):
    def test_an_episode_is_that_of_the_batched_task(self):
        tasks = ["Reacher-v5", "dmprl/Pusher-v0", "dmprl/Thrower-v0", "dmprl/PandaReach-v0"]
        for task_id in [*tasks, "tiny_mujoco:SlowReacher", "InvertedPendulum-v5"]:
            with self.subTest(task_id):
                env = recording.make(task_id, STEPS)
                self.assertEqual(env.spec(), {**make(task_id, 1, STEPS).spec(), "id": task_id})
                rewards = episode(env)
                self.assertEqual(rewards, episode(make(task_id, 1, STEPS)))
                written, joints = env.recording(), env.joints()
                self.assertEqual(len(written["success"]), len(rewards))
                for name in ("joint_positions", "joint_velocities"):
                    self.assertEqual(np.shape(written[name]), (len(rewards) + 1, len(joints)), name)

    def test_the_state_written_down_is_that_after_each_step(self):
        env = recording.make("Reacher-v5", STEPS)
        spec = env.spec()
        out = SegmentBuffers(1, STEPS, spec["observation_len"], spec["action_len"])
        env.reset(np.ones(1, np.uint8), np.array([7], np.uint64), out)
        env.step_segment(np.full((1, STEPS, 2), 0.5), out)
        written = env.recording()
        np.testing.assert_allclose(
            np.cos(written["joint_positions"]), out.observations[0, :, :2], atol=1e-12
        )
        np.testing.assert_allclose(
            written["joint_velocities"], out.observations[0, :, 6:8], atol=1e-12
        )

    def test_the_next_episode_which_begins_by_itself_is_not_written_down(self):
        env = recording.make("tiny_envs:Long-v0", STEPS)
        first = len(episode(env))
        out = SegmentBuffers(1, STEPS, 2, 1)
        env.step_segment(np.zeros((1, STEPS, 1)), out)
        self.assertEqual(len(env.recording()["success"]), first)
        self.assertEqual(len(episode(env)), first)
        self.assertEqual(len(env.recording()["success"]), first)

    def test_what_shows_no_joints_says_why(self):
        for task_id, reason in [
            ("point_reach:PointReach-v0", "not a MuJoCo environment"),
            ("point_reach_batch:PointReachBatch", "runs a whole segment at once"),
        ]:
            env = recording.make(task_id, STEPS)
            self.assertEqual(episode(env), episode(make(task_id, 1, STEPS)))
            self.assertEqual(env.joints(), [])
            self.assertIn(reason, env.why_no_joints())
            self.assertEqual(env.recording()["joint_positions"], [])


class JointsTest(unittest.TestCase):
    def test_only_the_arms_joints_are_the_robots(self):
        for task_id, count in [
            ("dmprl/Reacher-v1", 2),  # the target is on slides
            ("dmprl/Pusher-v0", 7),  # and so are cylinder and goal
            ("dmprl/Thrower-v0", 7),  # the ball flies
            ("dmprl/PandaReachJoints-v0", 7),
        ]:
            self.assertEqual(
                [kind for _, kind in recording.make(task_id, STEPS).joints()], ["hinge"] * count
            )

    def test_tendons_and_dragged_bodies_move_joints_too(self):
        model = mujoco.MjModel.from_xml_string("""
            <mujoco>
              <worldbody>
                <body name="hand" mocap="true"/>
                <body>
                  <joint name="lift" type="slide"/><geom size="1"/>
                  <body name="wrist"><joint name="turn"/><geom size="1"/>
                    <body><joint name="finger"/><geom size="1"/></body>
                    <body><joint name="ball" type="ball"/><geom size="1"/></body>
                  </body>
                </body>
                <body><joint name="pulled"/><geom size="1"/></body>
                <body><freejoint/><geom size="1"/></body>
              </worldbody>
              <tendon><fixed name="string"><joint joint="pulled" coef="1"/></fixed></tendon>
              <equality><weld body1="hand" body2="wrist"/></equality>
              <actuator><motor tendon="string"/></actuator>
            </mujoco>
        """)
        joints = robot_joints(model)
        self.assertEqual(joints.names, ["lift", "turn", "pulled"])
        self.assertEqual(joints.kinds, ["slide", "hinge", "hinge"])
        self.assertEqual([model.jnt_qposadr[model.joint(n).id] for n in joints.names], joints.qpos)


if __name__ == "__main__":
    unittest.main()
