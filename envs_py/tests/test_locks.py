"""The locks in ``envs_py/locks`` against the requirements in ``pyproject.toml``."""

import itertools
import tomllib
import unittest
from pathlib import Path

from pip._vendor.packaging.requirements import Requirement
from pip._vendor.packaging.utils import canonicalize_name

PACKAGE = Path(__file__).parents[1]
PYTHONS = ["3.11", "3.12", "3.13", "3.14"]
MACHINES = ["x86_64", "aarch64"]
EXTRAS = ["demos", "hub", "rerun", "search", "video"]
REMEDY = "run deploy/lock.sh"


def read(name):
    """Return the requirements of a lock, each with its number of hashes."""
    text = (PACKAGE / "locks" / f"{name}.txt").read_text().replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    parts = [line.split(" --hash=") for line in lines]
    return [(Requirement(first.strip()), len(hashes)) for first, *hashes in parts]


def environment(python, machine):
    return {
        "python_version": python,
        "python_full_version": f"{python}.0",
        "platform_machine": machine,
        "sys_platform": "linux",
        "platform_system": "Linux",
        "os_name": "posix",
        "platform_python_implementation": "CPython",
        "implementation_name": "cpython",
        "extra": "",
    }


def versions(name, where):
    """Return the locked version of each package in an environment."""
    found = {}
    for requirement, hashes in read(name):
        assert hashes > 0, f"{requirement} has no hash"
        if requirement.marker is None or requirement.marker.evaluate(where):
            package = canonicalize_name(requirement.name)
            assert package not in found, f"{package} is locked twice"
            (specifier,) = requirement.specifier
            assert specifier.operator == "==", requirement
            found[package] = specifier.version
    return found


class LockTest(unittest.TestCase):
    def setUp(self):
        self.manifest = tomllib.loads((PACKAGE / "pyproject.toml").read_text())

    def places(self):
        for python, machine in itertools.product(PYTHONS, MACHINES):
            yield environment(python, machine)

    def check(self, lock, wanted):
        for where in self.places():
            locked = versions(lock, where)
            for requirement in map(Requirement, wanted):
                version = locked.get(canonicalize_name(requirement.name))
                self.assertIsNotNone(version, f"{requirement} is not locked: {REMEDY}")
                fits = requirement.specifier.contains(version, prereleases=True)
                self.assertTrue(fits, f"{requirement}, locked {version}: {REMEDY}")

    def test_base_lock_has_package_simulation_and_build_tool(self):
        project = self.manifest["project"]
        simulation = project["optional-dependencies"]["sim"]
        build = self.manifest["build-system"]["requires"]
        self.check("base", [*project["dependencies"], *simulation, *build])

    def test_parts_that_the_program_installs_are_locked_and_go_with_the_base(self):
        extras = self.manifest["project"]["optional-dependencies"]
        for extra in EXTRAS:
            self.check(extra, extras[extra])
            for where in self.places():
                base = versions("base", where)
                for package, version in versions(extra, where).items():
                    self.assertEqual(base.get(package, version), version, package)

    def test_parts_can_be_installed_after_each_other(self):
        for one, other in itertools.combinations(EXTRAS, 2):
            for where in self.places():
                found = versions(one, where)
                for package, version in versions(other, where).items():
                    self.assertEqual(found.get(package, version), version, f"{one}, {other}")

    def test_locks_name_no_host(self):
        for path in (PACKAGE / "locks").iterdir():
            self.assertNotIn("://", path.read_text(), path)


if __name__ == "__main__":
    unittest.main()
