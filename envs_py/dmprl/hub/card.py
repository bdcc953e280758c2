"""The model card of a policy: ``README.md`` with the hub's metadata at its start."""

from __future__ import annotations

import json
import shlex
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

VERSIONS = ("python", "mujoco", "gymnasium", "numpy")
"""Packages that a manifest names."""


@dataclass(frozen=True)
class Facts:
    """The contents of a card."""

    repo: str
    """``OWNER/NAME``."""
    config: dict[str, Any]
    """The run's resolved configuration."""
    spec: dict[str, Any]
    """The environment's sizes and bounds."""
    manifest: dict[str, Any]
    """Versions and commands of the run."""
    rows: list[dict[str, Any]]
    """The run's evaluations, oldest first."""
    policy_version: int
    """The policy, which is in one of the rows."""
    film: str | None
    """The address of its film."""

    @property
    def row(self) -> dict[str, Any]:
        """The policy's evaluation; the latest if there are several."""
        return [row for row in self.rows if row["policy_version"] == self.policy_version][-1]

    @property
    def task(self) -> str:
        """The task's name, or its id if it has none."""
        return self.config["task"]["name"] or self.config["task"]["id"]

    @property
    def algorithm(self) -> str:
        """The algorithm's name, as in ``train --algo``."""
        return self.config["algorithm"]["name"]


def read(folder: Path, repo: str, policy_version: int, film: str | None) -> Facts:
    """Reads the files of a repository that is about to be uploaded."""
    lines = (folder / "evaluations.jsonl").read_text(encoding="utf-8").splitlines()
    return Facts(
        repo=repo,
        config=tomllib.loads((folder / "config.toml").read_text(encoding="utf-8")),
        spec=json.loads((folder / "spec.json").read_text(encoding="utf-8")),
        manifest=json.loads((folder / "manifest.json").read_text(encoding="utf-8")),
        rows=[json.loads(line) for line in lines],
        policy_version=policy_version,
        film=film,
    )


def model_card(facts: Facts) -> str:
    """Returns the text of ``README.md``."""
    parts = [
        f"---\n{metadata(facts)}---",
        f"# {facts.algorithm.upper()} policy for {facts.task}",
        description(facts),
        film(facts.film),
        f"## Result\n\n{result(facts)}",
        f"## Use\n\n{use(facts)}",
        f"## Training\n\n{training(facts)}",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def metadata(facts: Facts) -> str:
    """Returns the hub's metadata in YAML. Strings are in JSON, which YAML contains."""
    row = facts.row
    tags = ["reinforcement-learning", "deep-reinforcement-learning", "robotics", "dmprl"]
    tags += [facts.algorithm, facts.task]
    if facts.config["policy"]["kind"] == "dmp":
        tags.append("dynamic-movement-primitives")
    metrics = [("mean_reward", f"{row['return_mean']:.2f} +/- {np.std(row['returns']):.2f}")]
    if row["success_rate"] is not None:
        metrics.append(("success_rate", row["success_rate"]))
    lines = ["library_name: dmprl", "pipeline_tag: reinforcement-learning", "tags:"]
    lines += [f"- {json.dumps(tag)}" for tag in tags]
    lines += [
        "model-index:",
        f"- name: {json.dumps(facts.repo.rpartition('/')[2])}",
        "  results:",
        "  - task:",
        "      type: reinforcement-learning",
        "      name: reinforcement-learning",
        "    dataset:",
        f"      name: {json.dumps(facts.task)}",
        f"      type: {json.dumps(facts.config['task']['id'])}",
        "    metrics:",
    ]
    for name, value in metrics:
        lines += [f"    - type: {name}", f"      name: {name}", f"      value: {json.dumps(value)}"]
        lines.append("      verified: false")
    return "".join(f"{line}\n" for line in lines)


def description(facts: Facts) -> str:
    """Describes the policy in a paragraph."""
    spec, policy, task_id = facts.spec, facts.config["policy"], facts.config["task"]["id"]
    steps = policy["segment_steps"]
    outputs = {
        "dmp": f"a dynamic movement primitive, which gives {steps} actions",
        "chunk": f"{steps} actions",
        "mlp": "one action",
    }
    text = (
        f"A policy that dmprl trained. From an observation of {spec['observation_len']} entries it "
        f"computes {outputs[policy['kind']]} of {spec['action_len']} entries."
    )
    module, colon, _ = task_id.partition(":")
    if colon:
        text += (
            f" The task is in the Python module `{module}`. To play the policy, install it, or "
            "name its folder with `dmprl pull --python-path`."
        )
    return text


def film(address: str | None) -> str:
    """Shows the film; empty if there is none."""
    if address is None:
        return ""
    if address.endswith(".gif"):
        return f"![Episodes of the policy]({address})"
    return f'<video controls loop muted src="{address}"></video>'


def result(facts: Facts) -> str:
    """Returns the table of the result, and its limits."""
    config, row = facts.config, facts.row
    count, first = len(row["returns"]), config["evaluation"]["first_seed"]
    lines = [
        ("Task", f"`{facts.task}` ({config['task']['id']})"),
        ("Algorithm", f"{facts.algorithm.upper()}, policy {kind(config['policy'])}"),
        ("Seed of the training", str(config["run"]["seed"])),
        ("Environment steps", f"{row['env_steps']:,}"),
        ("Return", f"{row['return_mean']:.2f} ± {np.std(row['returns']):.2f}"),
    ]
    if row["success_rate"] is not None:
        lines.append(("Success rate", f"{row['success_rate']:.2f}"))
    lines.append(("Episodes", f"{count}, without noise, seeds {first} to {first + count - 1}"))
    rows = "".join(f"| {name} | {value} |\n" for name, value in lines)
    text = "Return is mean and standard deviation over these episodes, of one policy from one seed."
    if len(facts.rows) > 1 and rank(row) == max(map(rank, facts.rows)):
        text += (
            f" It is the best of the run's {len(facts.rows)} evaluations, so other episodes may "
            "have a lower return."
        )
    return f"| | |\n|---|---|\n{rows}\n{text}"


def rank(row: dict[str, Any]) -> tuple[float, float]:
    """Orders evaluations as ``--policy best`` does: by success rate, then by mean return."""
    return row["success_rate"] or 0.0, row["return_mean"]


def kind(policy: dict[str, Any]) -> str:
    """Returns the kind of a policy and how its segments are executed."""
    if policy["kind"] == "mlp":
        return "`mlp`"
    # Runs of older versions do not have it.
    blends = policy.get("execution") == "ensemble"
    how = "blended at every step" if blends else "executed as a whole"
    return f"`{policy['kind']}`, segments of {policy['segment_steps']} steps, {how}"


def use(facts: Facts) -> str:
    """Shows the commands and the lines of Python that use the policy."""
    folder = f"runs/{facts.repo.replace('/', '-')}"
    return f"""```sh
dmprl pull {facts.repo}
dmprl play {folder}
dmprl eval {folder}
```

In Python, with NumPy only:

```sh
dmprl pull {facts.repo} --output policy.safetensors
```

```python
import dmprl

policy = dmprl.Policy.load("policy.safetensors")
observation = [0.0] * {facts.spec["observation_len"]}  # of the environment or the robot
action = policy.action(observation)  # ({facts.spec["action_len"]},), once per control step
```"""


def training(facts: Facts) -> str:
    """States how the policy was trained."""
    sessions = facts.manifest["sessions"]
    commands = "".join(f"{shlex.join(session['command'])}\n" for session in sessions)
    session = sessions[-1]
    commit = f", commit {session['git_commit']}" if session["git_commit"] else ""
    packages = session.get("packages") or {}
    versions = [f"{name} {packages[name]}" for name in VERSIONS if packages.get(name)]
    text = f"```text\n{commands}```\n\n"
    text += f"dmprl {session['dmprl_version']}{commit}"
    text += f"; {', '.join(versions)}. " if versions else ". "
    return text + "`config.toml` has the whole configuration."
