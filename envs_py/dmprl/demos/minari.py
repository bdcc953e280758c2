"""Reads Minari data sets, with the package ``minari``."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dmprl.demos.source import Columns, DemosError, Episode, Source, missing_package
from dmprl.flat_spaces import image_in
from dmprl.observation_names import names_of

SPACES = ("observation_space", "action_space")
METADATA = "metadata.json"
SUCCESS = ("success", "is_success")
"""Entries of the recorded infos, in the order in which they are searched."""


class MinariSource(Source):
    """A data set of Minari's local store or in any other folder.

    Its columns are the entries of a Dict observation, or ``observation``, and ``action``.
    """

    rate_hz = 0.0
    observation: tuple[str, ...] = ()
    action, reward = "", "rewards"

    def __init__(self, name: str, folder: Path) -> None:
        self.name, self.format = name, "Minari"
        with self.explained():
            check_metadata(name, folder)
            self._dataset = opened(name, folder)
        self.format = f"Minari {self._dataset.minari_version}"
        self.episode_count = self._dataset.total_episodes
        self.columns, self.others = {}, {}
        for column, space in self._observation_spaces().items():
            if self._add(column, space):
                self.observation += (column,)
        if self._add("action", self._dataset.action_space):
            self.action = "action"

    def _observation_spaces(self) -> dict[str, spaces.Space]:
        space = self._dataset.observation_space
        return dict(space.spaces) if isinstance(space, spaces.Dict) else {"observation": space}

    def _add(self, column: str, space: spaces.Space) -> bool:
        if image_in(space) is not None:
            self.others[column] = "image"
        elif not space.is_np_flattenable:
            self.others[column] = type(space).__name__
        else:
            self.columns[column] = names_of(space, column)
        return column in self.columns

    def choices(self, part: str) -> list[str]:  # noqa: D102 - inherited
        return [it for it in self.columns if (it == "action") == (part == "action")]

    def episodes(self, columns: Columns) -> Iterator[Episode]:  # noqa: D102 - inherited
        observation_spaces = self._observation_spaces()
        is_dict = isinstance(self._dataset.observation_space, spaces.Dict)
        with self.explained():
            for recorded in self._dataset.iterate_episodes():
                parts = recorded.observations if is_dict else {"observation": recorded.observations}
                flat_parts = [flat(observation_spaces[it], parts[it]) for it in columns.observation]
                yield Episode(
                    observations=np.concatenate(flat_parts, axis=1),
                    actions=flat(self._dataset.action_space, recorded.actions),
                    rewards=np.asarray(recorded.rewards, np.float64) if columns.reward else None,
                    terminated=bool(recorded.terminations[-1]),
                    success=success_at_end(recorded.infos),
                )


def check_metadata(name: str, folder: Path) -> None:
    """Refuses a data set that does not contain its spaces.

    For such a data set Minari would create the environment that it names, and thus run code that a
    file chooses.
    """
    metadata = json.loads((folder / METADATA).read_text())
    for key in SPACES:
        if not isinstance(metadata.get(key), str):
            raise DemosError(
                f"{name}: {METADATA} has no {key}; expected a data set that contains its spaces, "
                "as Minari 0.5 writes it"
            )
    if not metadata.get("total_episodes"):
        raise DemosError(f"{name}: the data set has no episodes")


def opened(name: str, folder: Path) -> Any:
    """Opens the data set in a folder."""
    try:
        import minari
    except ModuleNotFoundError as error:
        raise missing_package(name, error.name or "minari") from None
    return minari.MinariDataset(folder)


def folder_of_id(name: str, dataset_id: str) -> Path:
    """Returns the folder of a data set in Minari's local store.

    :raises DemosError: if it is not there, with the command that downloads it.
    """
    try:
        from minari.storage.datasets_root_dir import get_dataset_path
    except ModuleNotFoundError as error:
        raise missing_package(name, error.name or "minari") from None
    folder = get_dataset_path(dataset_id) / "data"
    if not (folder / METADATA).is_file():
        raise DemosError(
            f"{name}: Minari's local store has no data set {dataset_id} (looked in {folder}); "
            f"download it with: dmprl env add 'minari[hf]' && "
            f"{Path(sys.executable).with_name('minari')} download {dataset_id}"
        )
    return folder


def flat(space: spaces.Space, rows: Any) -> NDArray[np.float64]:
    """Flattens the rows of a space as ``gymnasium.spaces.flatten`` does, all at once."""
    if isinstance(space, spaces.Dict):
        parts = [flat(part, rows[key]) for key, part in space.spaces.items()]
        return np.concatenate(parts, axis=1)
    if isinstance(space, spaces.Tuple):
        parts = [flat(part, rows[index]) for index, part in enumerate(space.spaces)]
        return np.concatenate(parts, axis=1)
    if isinstance(space, spaces.Box):
        return np.asarray(rows, np.float64).reshape(len(rows), -1)
    return np.stack([np.asarray(spaces.flatten(space, row), np.float64) for row in rows])


def success_at_end(infos: dict[str, Any] | None) -> bool | None:
    """Returns the success that was recorded for the last step; None if it was not recorded."""
    for key in SUCCESS:
        values = np.atleast_1d((infos or {}).get(key, []))
        if values.size:
            return bool(values.ravel()[-1])
    return None
