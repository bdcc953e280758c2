"""Rerun logs of real episodes, read back with the library (extra `rerun`).

``tests/tests/python_extras.rs`` trains a run and lets an observer run episodes of its policy. It
sets ``TEST_RUN`` to the run's directory and ``TEST_OBSERVED`` to the observer's file.
"""

import contextlib
import io
import json
import os
import tempfile
import unittest
from pathlib import Path
from unittest import mock

import numpy as np
from PIL import Image
from rerun.chunk import RrdReader

import dmprl
from dmprl import rerun_log

DT = 0.02
STEPS = 50


class Entity:
    """The rows of an entity, in the order of their steps."""

    def __init__(self, chunks):
        rows = [row for chunk in chunks for row in chunk.to_record_batch().to_pylist()]
        self.rows = sorted(rows, key=lambda row: row["step"])
        self.steps = [row["step"] for row in self.rows]
        self.seconds = [row["time"].total_seconds() for row in self.rows if "time" in row]

    @property
    def values(self):
        """One value for each row, or an array if there are several."""
        values = np.array([row["Scalars:scalars"] for row in self.rows])
        return values[:, 0] if values.shape[1] == 1 else values


def write(folder, sides):
    """Writes a log of named observations; returns its entities and the reported progress."""
    plan = {"sides": [], "output": str(folder / "log.rrd")}
    for index, (name, lines) in enumerate(sides):
        file = folder / f"{index}.jsonl"
        file.write_text("".join(json.dumps(line) + "\n" for line in lines))
        plan["sides"].append({"name": name, "title": f"side {index}", "episodes": str(file)})
    (folder / "plan.json").write_text(json.dumps(plan))
    output = io.StringIO()
    arguments = mock.patch("sys.argv", ["rerun_log", str(folder / "plan.json")])
    # With the variable, rerun logs nothing.
    off = mock.patch.dict(os.environ, {"RERUN": "off"})
    with arguments, off, contextlib.redirect_stdout(output):
        rerun_log.main()
    reader = RrdReader(folder / "log.rrd")
    assert len(reader.recordings()) == len(reader.blueprints()) == 1
    chunks = {}
    for chunk in reader.stream().to_chunks():
        if not chunk.is_static:
            chunks.setdefault(chunk.entity_path.replace("\\", ""), []).append(chunk)
    entities = {path: Entity(found) for path, found in chunks.items()}
    return entities, [json.loads(line)["filmed"] for line in output.getvalue().splitlines()]


class RerunLog(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        lines = Path(os.environ["TEST_OBSERVED"]).read_text().splitlines()
        self.robot, *self.episodes = map(json.loads, lines)

    def test_the_log_has_the_steps_of_the_environment(self):
        entities, _ = write(self.folder, [("run", [self.robot, *self.episodes])])
        env = dmprl.make("reacher")
        names = env.unwrapped.task.observation_names()
        for seed in (1000, 1001):
            root = f"/episode_{seed}"
            log = {
                path.removeprefix(root + "/"): entity
                for path, entity in entities.items()
                if path.startswith(root + "/")
            }
            expected = {f"observation/{name}" for name in names}
            expected |= {"reward", "return", "segment/index", "command/action[0]"}
            self.assertLessEqual(expected, set(log))
            self.assertNotIn("success", log)  # the task does not report it
            commands = np.stack([log[f"command/action[{i}]"].values for i in (0, 1)], axis=1)
            observations, rewards = self.replay(env, seed, commands)
            for name, column in zip(names, observations.T, strict=True):
                entity = log[f"observation/{name}"]
                self.assertEqual(entity.steps, list(range(STEPS + 1)))
                np.testing.assert_allclose(entity.seconds, DT * np.arange(STEPS + 1), atol=1e-9)
                np.testing.assert_allclose(entity.values, column, atol=1e-9)
            self.assertEqual(log["command/action[0]"].steps, list(range(STEPS)))
            self.assertEqual(log["reward"].steps, list(range(1, STEPS + 1)))
            np.testing.assert_allclose(log["reward"].values, rewards, atol=1e-9)
            returns = np.concatenate([[0.0], np.cumsum(rewards)])
            np.testing.assert_allclose(log["return"].values, returns, atol=1e-9)
            # The reacher observes cosines of its joints, and their velocities.
            position, velocity = log["joint/position/joint0"], log["joint/velocity/joint0"]
            self.assertEqual(position.steps, list(range(STEPS + 1)))
            cosines = observations[:, names.index("cos_joint0")]
            np.testing.assert_allclose(np.cos(position.values), cosines, atol=1e-9)
            velocities = observations[:, names.index("velocity_joint0")]
            np.testing.assert_allclose(velocity.values, velocities, atol=1e-9)

    def replay(self, env, seed, commands):
        """Runs an episode with given commands; returns its observations and rewards."""
        observation, _ = env.reset(seed=seed)
        observations, rewards = [observation], []
        for command in commands:
            observation, reward, *_ = env.step(command)
            observations.append(observation)
            rewards.append(reward)
        return np.array(observations), rewards

    def test_the_log_has_the_segments_of_the_policy(self):
        policy = dmprl.Run(os.environ["TEST_RUN"]).policy("latest")
        log, _ = write(self.folder, [("run", [self.robot, self.episodes[0]])])
        entity = {name: log[f"/episode_1000/segment/{name}"] for name in segment_entities()}
        first_steps = list(range(STEPS))  # an ensemble decides at every step
        for name in ("index", "start/action[0]", "goal/action[1]", "weights/action[0]"):
            self.assertEqual(entity[name].steps, first_steps, name)
        np.testing.assert_array_equal(entity["index"].values, np.arange(len(first_steps)))
        basis_count = policy.file.description["dmp"]["basis_count"]
        weights = entity["weights/action[0]"].values
        self.assertEqual(weights.shape, (len(first_steps), basis_count))
        self.assertEqual(entity["position/action[0]"].steps, list(range(1, STEPS + 1)))
        names = policy.spec["observation_names"]
        columns = [log[f"/episode_1000/observation/{name}"].values for name in names]
        commands = [log[f"/episode_1000/command/action[{i}]"].values for i in (0, 1)]
        observations, commands = np.stack(columns, axis=1), np.stack(commands, axis=1)
        policy.reset()
        actions = [policy.action(row) for row in observations[:STEPS]]
        np.testing.assert_allclose(commands, actions, atol=1e-5)
        # Segments of this policy start at zero; other starts are tested in Rust.
        self.assertEqual(policy.file.description["policy"]["start"], "zero")
        self.assertFalse(entity["start/action[0]"].values.any())

    def test_a_cut_segment_success_and_pictures(self):
        episode = cut(self.episodes[0], 7)
        episode["success_by_step"] = [None, False, False, False, False, True, True]
        for step in (0, 7):
            file = self.folder / f"{step}.png"
            Image.new("RGB", (64, 48), (30 * step, 0, 0)).save(file)
            episode["frames"].append(str(file))
            episode["frame_steps"].append(step)
        robot = {**self.robot, "control_dt_s": 0.0, "joints": []}
        log, progress = write(self.folder, [("run", [robot, episode])])
        success = log["/episode_1000/success"]
        self.assertEqual((success.steps, success.seconds), ([2, 3, 4, 5, 6, 7], []))
        self.assertEqual(success.values.tolist(), [0, 0, 0, 0, 1, 1])
        self.assertEqual(log["/episode_1000/segment/position/action[0]"].steps, list(range(1, 8)))
        camera = log["/episode_1000/camera"]
        self.assertEqual(camera.steps, [0, 7])
        last = camera.rows[1]
        self.assertEqual(last["EncodedImage:media_type"], ["image/jpeg"])
        with Image.open(io.BytesIO(bytes(last["EncodedImage:blob"][0]))) as picture:
            self.assertEqual((picture.format, picture.size), ("JPEG", (64, 48)))
            self.assertLess(abs(picture.getpixel((5, 5))[0] - 210), 5)
        self.assertFalse([path for path in log if "/joint/" in path])
        self.assertEqual(progress[-1], {"done": 2, "of": 2})
        self.assertTrue(all(report["done"] < 2 for report in progress[:-1]))

    def test_runs_of_one_name_and_policies_without_primitives_have_their_own_entities(self):
        other = json.loads(json.dumps(self.episodes[0]))
        for segment in other["details"]["segments"]:
            segment["primitives"] = None
        other["details"]["observation_names"] = []
        sides = [("run", [self.robot, self.episodes[0]]), ("run", [self.robot, other])]
        log, _ = write(self.folder, sides)
        self.assertIn("/run/episode_1000/segment/goal/action[0]", log)
        self.assertIn("/run-2/episode_1000/segment/index", log)
        self.assertIn("/run-2/episode_1000/observation/observation[0]", log)
        self.assertNotIn("/run-2/episode_1000/segment/goal/action[0]", log)


def segment_entities():
    """Returns the entities of a DMP policy's segments with two action dimensions."""
    parts = ("start", "goal", "weights", "position")
    return ["index", *(f"{part}/action[{i}]" for part in parts for i in (0, 1))]


def cut(episode, steps):
    """Returns the first steps of an episode."""
    episode = json.loads(json.dumps(episode))
    details, segments = episode["details"], []
    for segment in details["segments"]:
        if segment["first_step"] < steps:
            segment["steps"] = min(segment["steps"], steps - segment["first_step"])
            segments.append(segment)
    details["segments"] = segments
    details["observations"] = details["observations"][: steps + 1]
    details["commands"] = details["commands"][:steps]
    episode["rewards"] = episode["rewards"][:steps]
    return {**episode, "frames": [], "frame_steps": []}


if __name__ == "__main__":
    unittest.main()
