"""The command ``dmprl`` of a wheel, without the program (``dmprl_command``)."""

import os
import sys
import tempfile
import unittest
from importlib import metadata
from pathlib import Path
from unittest import mock

import dmprl_command
from dmprl_command import installed


class EndedError(Exception):
    """Raised instead of the end of the process."""


class CommandTest(unittest.TestCase):
    def setUp(self):
        self.folder = Path(self.enterContext(tempfile.TemporaryDirectory()))
        self.script = self.folder / "dmprl"
        self.script.touch(mode=0o755)
        python = str(self.folder / "python")
        self.enterContext(mock.patch.object(sys, "executable", python))
        self.enterContext(mock.patch.dict(os.environ, PATH=""))

    def call(self, called):
        self.enterContext(mock.patch.object(sys, "argv", [str(called), "tasks", "--json"]))

    def test_every_command_runs_once_more_in_an_isolated_python(self):
        self.call(self.script)
        before = {"HOME": "/home/me", "PYTHONPATH": "/other/python", "PYTHONHASHSEED": "7"}
        with (
            mock.patch.dict(os.environ, before, clear=True),
            mock.patch.object(os, "execve", side_effect=EndedError) as execve,
            self.assertRaises(EndedError),
        ):
            dmprl_command.main()
        program, words, after = execve.call_args.args
        self.assertEqual((program, words[0]), (sys.executable, sys.executable))
        self.assertEqual(words[1:], [str(self.script), "tasks", "--json"])
        self.assertEqual((after["HOME"], after["PYTHONHASHSEED"]), ("/home/me", "0"))
        self.assertNotIn("PYTHONPATH", after)

        # The second time it runs the program, whatever the variables are.
        program = mock.Mock()
        program.run.side_effect = EndedError
        modules = {"dmprl_command._program": program}
        with (
            mock.patch.dict(os.environ, after | {"PYTHONPATH": "/again"}, clear=True),
            mock.patch.dict(sys.modules, modules),
            mock.patch.object(dmprl_command, "_program", program, create=True),
            self.assertRaises(EndedError),
        ):
            dmprl_command.main()
        program.run.assert_called_once_with([str(self.script), "tasks", "--json"])

    def test_the_script_is_found_beside_this_python_if_a_module_was_called(self):
        module = self.folder / "__main__.py"
        module.touch(mode=0o755)
        self.call(module)
        self.assertEqual(dmprl_command.script(), self.script)
        self.script.chmod(0o644)
        with self.assertRaisesRegex(SystemExit, "install dmprl with pip"):
            dmprl_command.script()


class InstalledTest(unittest.TestCase):
    def has_simulation(self, **versions):
        """Return the answer where these packages are installed."""
        requires = {
            "dmprl": [
                "numpy<3,>=2",
                'mujoco<5,>=4 ; extra == "sim"',
                "gymnasium[mujoco]<2,>=1.2 ; extra == 'sim'",
                "other ; extra == 'video'",
            ],
            "gymnasium": ["imageio>=2.14.1; extra == 'mujoco'", "jax; extra == 'jax'"],
        }

        def version(name):
            if name not in versions:
                raise metadata.PackageNotFoundError(name)
            return versions[name]

        with (
            mock.patch.object(metadata, "requires", requires.get),
            mock.patch.object(metadata, "version", version),
        ):
            return installed.has_extra("sim")

    def test_a_part_is_there_if_all_its_packages_have_permitted_versions(self):
        fits = {"mujoco": "4.0.0", "gymnasium": "1.2", "imageio": "2.37.0"}
        self.assertTrue(self.has_simulation(**fits))
        self.assertTrue(self.has_simulation(**fits | {"gymnasium": "1.10.3rc1"}))
        for others in [
            {"mujoco": "3.9.1"},
            {"mujoco": "5.0.0"},
            {"gymnasium": "1.1.9"},
            {"gymnasium": "2"},
            {"imageio": "2.9"},
        ]:
            self.assertFalse(self.has_simulation(**fits | others), others)
        for missing in fits:
            some = {name: version for name, version in fits.items() if name != missing}
            self.assertFalse(self.has_simulation(**some), missing)


if __name__ == "__main__":
    unittest.main()
