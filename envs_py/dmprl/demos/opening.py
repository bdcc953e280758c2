"""Opens a source of demonstrations by its name."""

from __future__ import annotations

from pathlib import Path

from dmprl.demos import lerobot, minari
from dmprl.demos.archive import ArchiveSource
from dmprl.demos.source import DemosError, Source

MINARI_PREFIX = "minari:"


def open_source(name: str) -> Source:
    """Opens ``minari:ID``, a folder with a Minari data set or a LeRobotDataset, or a file.

    :raises DemosError: if the source does not exist or is incomplete, or a package is missing.
    """
    if name.startswith(MINARI_PREFIX):
        dataset_id = name.removeprefix(MINARI_PREFIX)
        return minari.MinariSource(name, minari.folder_of_id(name, dataset_id))
    path = Path(name)
    if path.is_file():
        return ArchiveSource(name)
    if (path / lerobot.INFO).is_file():
        return lerobot.LeRobotSource(name, path)
    for folder in (path, path / "data"):
        if (folder / minari.METADATA).is_file():
            return minari.MinariSource(name, folder)
    found = "a folder without either" if path.is_dir() else "no such file or folder"
    raise DemosError(
        f"{name}: expected {MINARI_PREFIX}ID, the folder of a Minari data set "
        f"({minari.METADATA}) or of a LeRobotDataset ({lerobot.INFO}), or a .npz file; got {found}"
    )
