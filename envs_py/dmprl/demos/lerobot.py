"""Reads LeRobotDatasets of versions 2 and 3, with ``pyarrow`` alone.

Both versions have ``meta/info.json`` and parquet files with one row per frame: in version 2 one
file per episode (``data/chunk-000/episode_000000.parquet``), in version 3 many episodes in one file
(``data/chunk-000/file-000.parquet``). Images and videos are not read.

A frame has the observation before its action, and no frame follows the last one. So an episode of
T frames has T - 1 steps.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmprl.demos.source import (
    Columns,
    DemosError,
    Episode,
    Source,
    entry_names,
    missing_package,
)

INFO = Path("meta") / "info.json"
FILES = {
    "v2.0": "data/chunk-*/episode_*.parquet",
    "v2.1": "data/chunk-*/episode_*.parquet",
    "v3.0": "data/chunk-*/file-*.parquet",
}
"""Pattern of the data files of each version."""
BOOKKEEPING = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Columns that every data set has and that are no part of an observation."""
STATE, ACTION, REWARD, SUCCESS = "observation.state", "action", "next.reward", "next.success"
NUMBERS = re.compile(r"float\d+|u?int\d+|bool")


class LeRobotSource(Source):
    """A LeRobotDataset in a folder."""

    def __init__(self, name: str, folder: Path) -> None:
        self.name, self.format = name, "LeRobotDataset"
        try:
            from pyarrow import parquet
        except ModuleNotFoundError:
            raise missing_package(name, "pyarrow") from None
        self._parquet = parquet
        with self.explained():
            info = json.loads((folder / INFO).read_text())
            version = info.get("codebase_version")
            if version not in FILES:
                raise DemosError(
                    f"{name}: {INFO} has version {version!r}; expected {', '.join(FILES)}"
                )
            self.format = f"LeRobotDataset {version}"
            self.rate_hz = float(info["fps"])
            self._files = sorted(folder.glob(FILES[version]), key=numbers_of)
            self._check_complete(info)
            self._read_features(info["features"])

    def _check_complete(self, info: dict[str, Any]) -> None:
        frames = sum(self._parquet.read_metadata(file).num_rows for file in self._files)
        self.episode_count = int(info["total_episodes"])
        if not frames or not self.episode_count:
            raise DemosError(f"{self.name}: the data set has no episodes")
        if frames != info["total_frames"]:
            raise DemosError(
                f"{self.name}: {INFO} has {info['total_frames']} frames, the data files have "
                f"{frames}; is the download incomplete?"
            )

    def _read_features(self, features: dict[str, Any]) -> None:
        self.columns, self.others = {}, {}
        for column, feature in features.items():
            dtype, shape = str(feature["dtype"]), tuple(feature["shape"])
            if column in BOOKKEEPING:
                continue
            if NUMBERS.fullmatch(dtype) and len(shape) == 1:
                self.columns[column] = entry_names(column, math.prod(shape))
            else:
                self.others[column] = dtype if dtype in ("image", "video") else f"{dtype} {shape}"
        self.observation = (STATE,) if STATE in self.columns else ()
        self.action = ACTION if ACTION in self.columns else ""
        self.reward = REWARD if REWARD in self.columns else None

    def episodes(self, columns: Columns) -> Iterator[Episode]:  # noqa: D102 - inherited
        wanted = [*columns.observation, columns.action]
        wanted += [columns.reward] if columns.reward else []
        wanted += [SUCCESS] if SUCCESS in self.columns else []
        with self.explained():
            number = 0
            for index, frames in self._frames(list(dict.fromkeys(wanted))):
                counted = frames["frame_index"][:, 0]
                if index != number or not np.array_equal(counted, np.arange(len(counted))):
                    raise DemosError(
                        f"{self.name}: expected the frames of episode {number} in order, got "
                        f"frames {counted[0]:.0f} to {counted[-1]:.0f} of episode {index}"
                    )
                yield episode_of(frames, columns)
                number += 1
            if number != self.episode_count:
                raise DemosError(
                    f"{self.name}: expected {self.episode_count} episodes, the data files have "
                    f"{number}"
                )

    def _frames(self, wanted: list[str]) -> Iterator[tuple[int, dict[str, NDArray]]]:
        """Yields index and rows of each episode, which may span several files."""
        pending: dict[str, NDArray] | None = None
        for file in self._files:
            table = self._parquet.read_table(
                file, columns=["episode_index", "frame_index", *wanted]
            )
            rows = {it: self._rows(table.column(it), it) for it in table.column_names}
            if pending is not None:
                rows = {it: np.concatenate([pending[it], rows[it]]) for it in rows}
            indices = rows["episode_index"][:, 0]
            starts = [0, *(np.flatnonzero(np.diff(indices)) + 1).tolist()]
            for first, end in itertools.pairwise(starts):
                yield int(indices[first]), {it: values[first:end] for it, values in rows.items()}
            pending = {it: values[starts[-1] :] for it, values in rows.items()}
        if pending is not None:
            yield int(pending["episode_index"][0, 0]), pending

    def _rows(self, column: Any, name: str) -> NDArray[np.float64]:
        """Returns the numbers of a column, (N, length)."""
        length = len(self.columns.get(name, ("",)))
        count, values = len(column), column.combine_chunks()
        if hasattr(values, "flatten") and hasattr(values.type, "value_type"):
            values = values.flatten()
        if len(values) != count * length or values.null_count:
            raise DemosError(
                f"{self.name}: {name}: expected {length} numbers in each of {count} frames"
            )
        return values.to_numpy(zero_copy_only=False).astype(np.float64).reshape(count, length)


def episode_of(frames: dict[str, NDArray], columns: Columns) -> Episode:
    """Makes an episode of its frames. The last frame only gives the last observation."""
    steps = len(frames["frame_index"]) - 1
    observations = [frames[it] for it in columns.observation]
    success = frames.get(SUCCESS)
    return Episode(
        observations=np.concatenate(observations, axis=1),
        actions=frames[columns.action][:steps],
        rewards=frames[columns.reward][:steps, 0] if columns.reward else None,
        # The step of the last frame, which may have ended the task, is not used.
        terminated=False,
        success=None if success is None else bool(success[-1, 0]),
    )


def numbers_of(file: Path) -> list[int]:
    """Returns the numbers of chunk and file, by which files are in order."""
    return [int(number) for part in file.parts[-2:] for number in re.findall(r"\d+", part)]
