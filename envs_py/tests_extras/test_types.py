"""The annotations of the package, as mypy reads them in a user's program."""

import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

PROGRAM = """
import dmprl
import numpy as np


class Stop(dmprl.Callback):
    def on_evaluation(self, run: dmprl.Run, row: dict[str, object]) -> bool:
        return True


run = dmprl.train("reacher", steps=10, callbacks=[Stop()])
policy = run.policy()
reveal_type(policy.predict(np.zeros(10)))
reveal_type(policy.action(np.zeros(10)))
reveal_type(dmprl.make("reacher"))
dmprl.train(1)
"""
FLOATS = "numpy.ndarray[tuple[Any, ...], numpy.dtype[numpy.float64]]"


class TypesTest(unittest.TestCase):
    def test_a_strict_program_is_accepted_and_a_mistake_is_found(self):
        with tempfile.TemporaryDirectory() as folder:
            program = Path(folder) / "program.py"
            program.write_text(PROGRAM)
            checked = subprocess.run(
                [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", program.name],
                cwd=folder,
                capture_output=True,
                text=True,
                timeout=300,
                check=False,
            )
        lines = [line.partition(": ")[2] for line in checked.stdout.splitlines()]
        self.assertEqual(checked.stderr, "")
        self.assertEqual(
            lines[:3],
            [
                f'note: Revealed type is "tuple[{FLOATS}, None]"',
                f'note: Revealed type is "{FLOATS}"',
                'note: Revealed type is "gymnasium.core.Env[Any, Any]"',
            ],
        )
        self.assertRegex(lines[3], r'error: Argument 1 to "train" has incompatible type "int"')
        self.assertEqual(len(lines), 5, checked.stdout)


if __name__ == "__main__":
    unittest.main()
