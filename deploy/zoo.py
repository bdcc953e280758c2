"""Adds a run's latest policy to the Python package: ``python deploy/zoo.py RUN [NAME]``.

It evaluates the policy over 100 episodes. The run must be of a program that was built from a commit
without changes. The copy names no path of this machine.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
ZOO = ROOT / "envs_py" / "dmprl" / "zoo"
EPISODES = 100


def add(run: Path, name: str | None) -> Path:
    """Writes the folder of a run's latest policy, and returns it."""
    manifest = json.loads((run / "manifest.json").read_text())
    for session in manifest["sessions"]:
        if (session["git_commit"] or "-dirty").endswith("-dirty"):
            sys.exit(f"{run}: trained by a build with uncommitted changes: {session['git_commit']}")
        session["command"] = ["dmprl", *without_paths(session["command"][1:])]
    config = (run / "config.toml").read_text()
    # Paths of demonstrations, modules and secrets are on one line of their own each.
    if '"/' in config or manifest["init_from"]:
        sys.exit(f"{run}: its config.toml or manifest names a file of this machine")
    row = evaluated(run)
    target = ZOO / (name or tomllib.loads(config)["task"]["name"])
    shutil.rmtree(target, ignore_errors=True)
    (target / "policies").mkdir(parents=True)
    (target / "config.toml").write_text(config)
    (target / "manifest.json").write_text(json.dumps(manifest, indent=2) + "\n")
    (target / "evaluations.jsonl").write_text(json.dumps(row) + "\n")
    shutil.copy(run / "spec.json", target)
    policy = f"policies/{row['policy_version']}.safetensors"
    shutil.copy(run / policy, target / policy)
    return target


def evaluated(run: Path) -> dict[str, object]:
    """Returns a row of ``evaluations.jsonl`` for the latest policy."""
    options = ["--policy", "latest", "--episodes", str(EPISODES), "--json"]
    command = [str(ROOT / "target/release/dmprl"), "eval", str(run), *options]
    row = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    return {key: row[key] for key in row if key not in ("run", "return_std", "episodes")}


def without_paths(words: list[str]) -> list[str]:
    """Removes --run-dir, and shortens other paths to their last part."""
    if "--run-dir" in words:
        at = words.index("--run-dir")
        words = words[:at] + words[at + 2 :]
    return [Path(word).name if word.startswith("/") else word for word in words]


if __name__ == "__main__":
    if not 2 <= len(sys.argv) <= 3:
        sys.exit(__doc__)
    print(add(Path(sys.argv[1]), sys.argv[2] if len(sys.argv) == 3 else None))
