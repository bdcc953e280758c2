"""MuJoCo's warnings of a Gymnasium environment go to standard error."""

import os
import subprocess
import sys
import tempfile
import unittest

UNSTABLE = """
import mujoco
from dmprl.segment_env import make

make("ENVIRONMENT", 1, 5)
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
)
for _ in range(3):
    data = mujoco.MjData(model)
    data.qvel[:] = 1e30
    mujoco.mj_step(model, data)
"""


class WarningsTest(unittest.TestCase):
    def test_a_registered_environment(self):
        self.assert_told_once_and_without_a_file("InvertedPendulum-v5")

    def test_a_class(self):
        self.assert_told_once_and_without_a_file("tiny_envs:Countdown")

    def assert_told_once_and_without_a_file(self, environment):
        with tempfile.TemporaryDirectory() as folder:
            paths = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
            ran = subprocess.run(
                [sys.executable, "-c", UNSTABLE.replace("ENVIRONMENT", environment)],
                cwd=folder,
                env={**os.environ, **paths},
                capture_output=True,
                text=True,
                timeout=120,
                check=True,
            )
            self.assertEqual(os.listdir(folder), [])
        lines = [line for line in ran.stderr.splitlines() if line.startswith("MuJoCo: ")]
        self.assertEqual(len(lines), 1, ran.stderr)
        self.assertIn("The simulation is unstable", lines[0])


if __name__ == "__main__":
    unittest.main()
