"""A user's script as a type checker sees it: what `import dmprl` says of itself must be enough."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import dmprl


def act(file: Path, observation: NDArray[np.float64]) -> NDArray[np.float64]:
    policy: dmprl.Policy = dmprl.Policy.load(file)
    policy.reset()
    return policy.segment(observation)


def learn() -> Path:
    try:
        run: dmprl.Run = dmprl.train("reacher", steps=1_000, algorithm__batch_size=64, quiet=True)
    except dmprl.TrainingError as error:
        raise SystemExit(error.status) from error
    steps: int = run.policy("latest").segment_steps
    return run.record(episodes=steps)
