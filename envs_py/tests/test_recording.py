"""Recordings of episodes, their pictures, and the joints that belong to the robot."""

import os
import sys
import tempfile
import unittest
from itertools import pairwise
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
from PIL import Image

from dmprl import film, recording
from dmprl.pictures import NoOpenGLError
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
    def test_a_recorded_episode_equals_the_workers(self):
        tasks = ["Reacher-v5", "dmprl/Pusher-v0", "dmprl/Thrower-v0", "dmprl/PandaReach-v0"]
        for task_id in [*tasks, "tiny_mujoco:SlowReacher", "InvertedPendulum-v5"]:
            with self.subTest(task_id):
                env = recording.make(task_id, STEPS)
                self.assertEqual(env.spec(), make(task_id, 1, STEPS).spec())
                rewards = episode(env)
                self.assertEqual(rewards, episode(make(task_id, 1, STEPS)))
                recorded, joints = env.recording(), env.joints()
                self.assertEqual(len(recorded["success"]), len(rewards))
                for name in ("joint_positions", "joint_velocities"):
                    shape = (len(rewards) + 1, len(joints))
                    self.assertEqual(np.shape(recorded[name]), shape, name)

    def test_the_state_after_each_step_is_recorded(self):
        env = recording.make("Reacher-v5", STEPS)
        spec = env.spec()
        out = SegmentBuffers(1, STEPS, spec["observation_len"], spec["action_len"])
        env.reset(np.ones(1, np.uint8), np.array([7], np.uint64), out)
        env.step_segment(np.full((1, STEPS, 2), 0.5), out)
        recorded = env.recording()
        np.testing.assert_allclose(
            np.cos(recorded["joint_positions"]), out.observations[0, :, :2], atol=1e-12
        )
        np.testing.assert_allclose(
            recorded["joint_velocities"], out.observations[0, :, 6:8], atol=1e-12
        )

    def test_the_episode_after_an_automatic_reset_is_not_recorded(self):
        env = recording.make("tiny_envs:Long-v0", STEPS)
        first = len(episode(env))
        out = SegmentBuffers(1, STEPS, 2, 1)
        env.step_segment(np.zeros((1, STEPS, 1)), out)
        self.assertEqual(len(env.recording()["success"]), first)
        self.assertEqual(len(episode(env)), first)
        self.assertEqual(len(env.recording()["success"]), first)

    def test_environments_without_joints_have_a_reason(self):
        for task_id, reason in [
            ("point_reach:PointReach-v0", "not a MuJoCo environment"),
            ("point_reach_batch:PointReachBatch", "runs a whole segment at once"),
        ]:
            env = recording.make(task_id, STEPS)
            self.assertEqual(episode(env), episode(make(task_id, 1, STEPS)))
            self.assertEqual(env.joints(), [])
            self.assertIn(reason, env.why_no_joints())
            self.assertEqual(env.recording()["joint_positions"], [])


class PicturesTest(unittest.TestCase):
    def test_frames_are_drawn_before_the_first_step_and_after_each(self):
        with tempfile.TemporaryDirectory() as folder:
            env = recording.make("Reacher-v5", STEPS, folder)
            try:
                episode(env)
            except NoOpenGLError as error:
                if os.environ.get("TEST_OPENGL_REQUIRED"):
                    raise
                self.skipTest(str(error))
            recorded = env.recording()
            self.assertEqual(recorded["frame_steps"], list(range(51)))
            self.assertEqual(sorted(os.listdir(folder)), [Path(f).name for f in recorded["frames"]])
            self.assertEqual(env.goal_in_pictures(), "red ball")

    def test_environments_that_cannot_be_drawn_are_rejected(self):
        for task_id in ("point_reach:PointReach-v0", "point_reach_batch:PointReachBatch"):
            with self.assertRaisesRegex(recording.NoPicturesError, "with the render mode"):
                recording.make(task_id, STEPS, "/nowhere")

    def test_a_fast_environment_is_not_drawn_at_every_step(self):
        env = gymnasium.make("Reacher-v5")
        for dt, steps in [(0.0, 1), (0.05, 1), (0.02, 1), (0.01, 2), (0.002, 10)]:
            env.unwrapped.frame_skip = dt / env.unwrapped.model.opt.timestep
            self.assertEqual(recording.steps_per_frame(env), steps, dt)


class FilmTest(unittest.TestCase):
    def side(self, folder, frames, flags):
        files = []
        for frame in range(frames):
            files.append(f"{folder}/{frame}.png")
            Image.new("RGB", (64, 48), (5 * frame, 0, 0)).save(files[-1])
        return film.Scenes(
            {
                "title": "a title",
                "success": "",
                "goal": "red ball",
                "frames": files,
                "steps": list(range(0, 2 * frames, 2)),
                "rewards": [-1.0] * (2 * frames - 2),
                "success_by_step": flags,
            },
            0.1,
        )

    def test_captions_follow_the_episode(self):
        with tempfile.TemporaryDirectory() as folder:
            scenes = self.side(folder, 4, [False] * 5 + [True])
            self.assertEqual([scenes.when(frame) for frame in (0, 3)], ["0.00 s", "0.60 s"])
            self.assertEqual(scenes.return_so_far(2), "return -4.00")
            words = [scenes.goal(frame)[0] for frame in (0, 1, 3)]
            self.assertEqual(
                words,
                ["goal: red ball", "not at the goal (red ball)", "at the goal (red ball)"],
            )

    def test_a_side_that_ends_first_repeats_its_last_frame_and_all_frames_have_one_size(self):
        with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as other:
            sides = [self.side(one, 3, []), self.side(other, 8, [])]
            made = list(film.pictures([sides]))
            self.assertEqual(len(made), 8)
            self.assertEqual({picture.size for picture in made}, {(2 * 640 + 8, 568)})
            left = [picture.crop((0, 44, 640, 524)).tobytes() for picture in made]
            self.assertEqual([a == b for a, b in pairwise(left)], [False] * 2 + [True] * 5)
            # One row per side. The first has fewer frames than a row of the strip can show.
            self.assertEqual(film.strip([sides]).size, (6 * 320 + 5 * 8, 2 * (240 + 88)))


class JointsTest(unittest.TestCase):
    def test_only_the_arms_joints_belong_to_the_robot(self):
        for task_id, count in [
            ("dmprl/Reacher-v1", 2),  # the target is on slides
            ("dmprl/Pusher-v0", 7),  # the cylinder and the goal are on slides
            ("dmprl/Thrower-v0", 7),  # the ball moves freely
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
