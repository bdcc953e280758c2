"""Tests the trained policies that come with the package."""

import json
import tempfile
import tomllib
import unittest
from pathlib import Path

import numpy as np

import dmprl
from dmprl import zoo
from dmprl.segment_env import SUCCESS_YES, SegmentBuffers, make

REACHED = 0.9
"""Success rate of all policies of tasks with a goal, from 100 episodes."""


class ZooTest(unittest.TestCase):
    def test_every_policy_loads_and_fits_its_task(self):
        self.assertIn("panda-pick-and-place", zoo.names())
        for name in zoo.names():
            policy = dmprl.Policy.load(f"zoo:{name}")
            env = make(policy.spec["id"], 1, policy.segment_steps)
            self.assertEqual(env.spec()["observation_names"], policy.spec["observation_names"])
            observation = np.zeros(policy.spec["observation_len"])
            self.assertEqual(policy.segment(observation).shape[1], len(policy.low), name)

    def test_every_policy_states_how_it_was_made_and_what_it_reaches(self):
        for name in zoo.names():
            folder = zoo.FOLDER / name
            row = json.loads((folder / "evaluations.jsonl").read_text())
            self.assertEqual(len(row["returns"]), 100, name)
            if row["success_rate"] is not None:
                self.assertGreaterEqual(row["success_rate"], REACHED, name)
            session = json.loads((folder / "manifest.json").read_text())["sessions"][0]
            self.assertEqual(session["command"][:3], ["dmprl", "train", name])
            self.assertFalse(session["git_commit"].endswith("-dirty"), name)
            self.assertTrue((folder / f"policies/{row['policy_version']}.safetensors").is_file())
            for file in ("manifest.json", "config.toml"):
                self.assertNotIn('"/', (folder / file).read_text(), f"a path in {name}/{file}")

    def test_the_table_in_the_book_has_every_policy(self):
        page = Path(__file__).resolve().parents[2] / "docs" / "zoo.md"
        table = [line for line in page.read_text().splitlines() if line.startswith("| `")]
        rows = []
        for name in zoo.names():
            folder = zoo.FOLDER / name
            row = json.loads((folder / "evaluations.jsonl").read_text())
            seed = tomllib.loads((folder / "config.toml").read_text())["run"]["seed"]
            size = (folder / f"policies/{row['policy_version']}.safetensors").stat().st_size
            success = "" if row["success_rate"] is None else f"{row['success_rate']:.2f}"
            figures = f"{row['return_mean']:.2f} | {success} | {size / 1024:.0f} |"
            rows.append(f"| `{name}` | {seed} | {row['env_steps']:,} | {figures}")
        self.assertEqual(sorted(table), sorted(rows))

    def test_the_cube_is_brought_to_its_goal(self):
        policies = [dmprl.Policy.load("zoo:panda-pick-and-place") for _ in range(20)]
        count, steps = len(policies), policies[0].segment_steps
        env = make(policies[0].spec["id"], count, steps)
        out = SegmentBuffers(count, steps, env.spec()["observation_len"], len(policies[0].low))
        env.reset(np.ones(count, np.uint8), np.arange(3000, 3000 + count, dtype=np.uint64), out)
        while not out.truncated.any():
            for index, policy in enumerate(policies):
                out.actions[index] = policy.segment(out.next_observations[index])
            env.step_segment(out.actions, out)
        self.assertGreaterEqual((out.success == SUCCESS_YES).mean(), 0.8)

    def test_unknown_names_are_refused_with_the_known_ones(self):
        for name in ("dance", "../zoo/panda-reach", str(zoo.FOLDER / "panda-reach"), ""):
            with self.assertRaisesRegex(dmprl.PolicyFileError, f"{name}; expected .*panda-reach"):
                dmprl.Policy.load(f"zoo:{name}")
        with tempfile.TemporaryDirectory() as folder:
            self.assertIsNone(zoo.path(Path(folder)))


if __name__ == "__main__":
    unittest.main()
