"""The command ``dmprl`` of a wheel, without the program (``dmprl_command``)."""

import os
import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock

import dmprl_command as command


class Main(unittest.TestCase):
    def test_environments_run_in_an_isolated_python(self):
        before = {"HOME": "/home/me", "PYTHONPATH": "/other/python", "PYTHONHASHSEED": "7"}
        after = command.isolated(before)
        self.assertEqual(after["HOME"], "/home/me")
        self.assertNotIn("PYTHONPATH", after)
        self.assertEqual(after["PYTHONHASHSEED"], "0")
        self.assertEqual(command.isolated(after), after)

    def test_the_script_is_found_beside_this_python_if_a_module_was_called(self):
        with tempfile.TemporaryDirectory() as folder:
            script = Path(folder, "dmprl")
            script.touch()
            module = Path(folder, "__main__.py")
            module.touch(mode=0o755)
            python = os.path.join(folder, "python")
            with mock.patch.object(sys, "executable", python), mock.patch.dict(os.environ, PATH=""):
                with mock.patch.object(sys, "argv", [str(module), "tasks"]):
                    with self.assertRaisesRegex(SystemExit, "install dmprl with pip"):
                        command.script()  # it is not executable
                    script.chmod(0o755)
                    self.assertEqual(command.script(), script)
                with mock.patch.object(sys, "argv", [str(script), "tasks"]):
                    self.assertEqual(command.script(), script)


if __name__ == "__main__":
    unittest.main()
