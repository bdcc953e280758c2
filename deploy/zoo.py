"""Adds a finished run's last policy to the Python package: ``python deploy/zoo.py RUN [NAME]``.

The run's last evaluation must have 100 episodes (``--set evaluation.final_episodes=100``), and its
program must have been built from a commit without changes. The copy names no path of this machine.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

ZOO = Path(__file__).parents[1] / "envs_py" / "dmprl" / "zoo"
EPISODES = 100


def add(run: Path, name: str | None) -> Path:
    """Writes the folder of a run's last policy, and returns it."""
    rows = [json.loads(line) for line in (run / "evaluations.jsonl").read_text().splitlines()]
    last, manifest = rows[-1], json.loads((run / "manifest.json").read_text())
    if len(last["returns"]) != EPISODES:
        sys.exit(f"{run}: the last evaluation has {len(last['returns'])} episodes, not {EPISODES}")
    config = (run / "config.toml").read_text()
    task = next(line for line in config.splitlines() if line.startswith("name = "))
    for session in manifest["sessions"]:
        if session["git_commit"] is None or session["git_commit"].endswith("-dirty"):
            sys.exit(f"{run}: made by a program of no commit: {session['git_commit']}")
        session["command"] = ["dmprl", *without_paths(session["command"][1:])]
    target = ZOO / (name or task.split('"')[1])
    shutil.rmtree(target, ignore_errors=True)
    (target / "policies").mkdir(parents=True)
    (target / "config.toml").write_text(config)
    (target / "manifest.json").write_text(json.dumps(manifest, indent=2) + "\n")
    (target / "evaluations.jsonl").write_text(json.dumps(last) + "\n")
    shutil.copy(run / "spec.json", target)
    policy = f"policies/{last['policy_version']}.safetensors"
    shutil.copy(run / policy, target / policy)
    return target


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
