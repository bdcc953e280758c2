"""Reads dmprl's own files of demonstrations (docs/demonstrations.md)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dmprl.demos.source import Columns, DemosError, Episode, Source, entry_names

ARRAYS = (
    "observations",
    "actions",
    "rewards",
    "next_observations",
    "terminated",
    "truncated",
)


class ArchiveSource(Source):
    """A NumPy archive. Unlike the learner, it also reads compressed ones."""

    format = "npz"
    others = {}  # noqa: RUF012 - never changed
    observation, action, reward = ("observations",), "actions", "rewards"

    def __init__(self, name: str) -> None:
        self.name = name
        with self.explained():
            archive = np.load(name)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise DemosError(f"{name}: expected an archive of numpy.savez, got a single array")
            if missing := [key for key in ARRAYS if key not in archive.files]:
                raise DemosError(
                    f"{name}: expected arrays {', '.join(ARRAYS)}; {', '.join(missing)} is missing"
                )
            self._arrays = {key: archive[key] for key in ARRAYS}
            self._success = archive["success"] if "success" in archive.files else None
            self.rate_hz = float(archive["rate_hz"][0]) if "rate_hz" in archive.files else 0.0
            self._check_shapes()
        arrays = self._arrays
        self.columns = {
            key: entry_names(key, arrays[key].shape[1]) for key in ("observations", "actions")
        }
        ended = (arrays["terminated"] != 0) | (arrays["truncated"] != 0)
        rows = len(ended)
        ends = {*(np.flatnonzero(ended) + 1).tolist(), rows} - {0}
        self._ends = sorted(ends)  # the last episode may be cut short
        self.episode_count = len(self._ends)

    def _check_shapes(self) -> None:
        rows = len(self._arrays["rewards"])
        for key, array in self._arrays.items():
            dimensions = 2 if key in ("observations", "actions", "next_observations") else 1
            if array.ndim != dimensions or len(array) != rows:
                expected = f"({rows}, …)" if dimensions == 2 else f"({rows},)"
                raise DemosError(f"{self.name}: {key}: expected {expected}, got {array.shape}")
        if self._arrays["observations"].shape != self._arrays["next_observations"].shape:
            raise DemosError(f"{self.name}: next_observations and observations differ in shape")

    def choices(self, part: str) -> list[str]:  # noqa: D102 - inherited
        return [f"{part}s"]

    def episodes(self, columns: Columns) -> Iterator[Episode]:  # noqa: D102 - inherited
        arrays, first = self._arrays, 0
        for end in self._ends:
            rows = slice(first, end)
            observations = [
                arrays["observations"][rows],
                arrays["next_observations"][end - 1 :][:1],
            ]
            yield Episode(
                observations=np.concatenate(observations).astype(np.float64),
                actions=arrays["actions"][rows].astype(np.float64),
                rewards=arrays["rewards"][rows].astype(np.float64) if columns.reward else None,
                terminated=bool(arrays["terminated"][end - 1]),
                success=None if self._success is None else bool(self._success[end - 1]),
            )
            first = end
