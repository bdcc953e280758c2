"""Reads a policy file: safetensors with the policy's description in its metadata.

``dmprl export`` and training (in a run's ``policies/``) write the files, with
``shared/runtime/src/policy_file.rs``. Reading one needs only NumPy: the format is the header's
length, the header in JSON, and the numbers.
"""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmprl.hold import Hold

FORMAT = "dmprl-policy-1"
FORMAT_WITH_HOLD = "dmprl-policy-2"
"""Format of a file with a hold. Earlier programs would hold the robot with another action."""
HEADER_BYTES_MAX = 100_000_000
"""Limit of the safetensors library. A file with a longer header is damaged."""


class PolicyFileError(ValueError):
    """Raised for a file that is not a policy, is damaged, or is too old."""


@dataclass(frozen=True)
class PolicyFile:
    """Contents of a policy file."""

    path: Path
    description: dict[str, Any]
    """Environment, algorithm, policy, DMP and start; ``PolicyDescription`` in Rust."""
    origin: dict[str, Any] | None
    """Run, task, seed and return of the policy; None in a run's own files."""
    version: int
    env_steps: int
    layers: list[tuple[NDArray[np.float32], NDArray[np.float32]]]
    """Weights, (outputs, inputs), and bias of each layer."""
    segment_map: NDArray[np.float32] | None
    """Map from (y0, yd0, g, w) to the samples of one dimension, (3K, 3+N); None without a DMP."""
    hold: Hold | None
    """The command that holds the robot, if the export stated it."""


def read(path: Path) -> PolicyFile:
    """Reads a policy file.

    :raises OSError: if it cannot be read.
    :raises PolicyFileError: if it is not a policy file, or is damaged; the message names the field.
    """
    fields, tensors = _contents(path)
    expected = FORMAT_WITH_HOLD if "hold" in fields else FORMAT
    if (found := fields.get("format")) != expected:
        raise PolicyFileError(f"{path}: format is {found or 'missing'}, expected {expected}")
    if "description" not in fields:
        raise PolicyFileError(
            f"{path}: has no description, because an older dmprl wrote it; write it again with "
            "dmprl export RUN"
        )
    layers = []
    while (name := f"actor.{len(layers)}.weight") in tensors:
        weight, bias = tensors[name], tensors.get(f"actor.{len(layers)}.bias")
        before = layers[-1][0].shape[0] if layers else None
        fits = weight.ndim == 2 and bias is not None and bias.shape == weight.shape[:1]
        if not fits or (before is not None and weight.shape[1] != before):
            raise PolicyFileError(
                f"{path}: the shape of {name} does not fit its bias or the previous layer"
            )
        layers.append((weight, bias))
    if not layers:
        raise PolicyFileError(f"{path}: no tensor actor.0.weight")
    if not all(np.isfinite(tensor).all() for tensor in tensors.values()):
        raise PolicyFileError(f"{path}: a parameter is not finite")
    found, expected = fields.get("checksum"), checksum(fields, tensors)
    if found != expected:
        raise PolicyFileError(f"{path}: checksum is {found or 'missing'}, expected {expected}")
    try:
        return PolicyFile(
            path=path,
            description=json.loads(fields["description"]),
            origin=json.loads(fields["origin"]) if "origin" in fields else None,
            version=int(fields["policy_version"]),
            env_steps=int(fields["env_steps"]),
            layers=layers,
            segment_map=tensors.get("segment_map"),
            hold=Hold.of_file(json.loads(fields["hold"])) if "hold" in fields else None,
        )
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise PolicyFileError(f"{path}: damaged: {error!r}") from error


def checksum(fields: dict[str, str], tensors: dict[str, NDArray[np.float32]]) -> str:
    """Computes the CRC-32 of the description, the hold, and the tensors' bytes in name order."""
    crc = zlib.crc32((fields["description"] + fields.get("hold", "")).encode())
    for name in sorted(tensors):
        crc = zlib.crc32(tensors[name].astype("<f4").tobytes(), crc)
    return f"{crc:08x}"


def _contents(path: Path) -> tuple[dict[str, str], dict[str, NDArray[np.float32]]]:
    """Reads the metadata and the tensors of a safetensors file."""
    data = path.read_bytes()
    length = int.from_bytes(data[:8], "little")
    if len(data) < 8 or length > min(HEADER_BYTES_MAX, len(data) - 8):
        raise PolicyFileError(f"{path}: not a safetensors file, or truncated")
    numbers = memoryview(data)[8 + length :]
    tensors: dict[str, NDArray[np.float32]] = {}
    try:
        header = json.loads(data[8 : 8 + length])
        fields = header.pop("__metadata__", {})
        if not all(isinstance(field, str) for field in fields.values()):
            raise PolicyFileError(f"{path}: metadata is not text")
        for name, entry in header.items():
            begin, end = entry["data_offsets"]
            if entry["dtype"] != "F32" or not 0 <= begin <= end <= len(numbers):
                raise PolicyFileError(f"{path}: {name} is damaged")
            # Copied, because the data may be unaligned, and so that the file's bytes can be freed.
            tensor = np.frombuffer(numbers[begin:end], "<f4").astype(np.float32)
            tensors[name] = tensor.reshape(entry["shape"])
    except PolicyFileError:
        raise
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise PolicyFileError(f"{path}: not a readable safetensors file: {error!r}") from error
    return fields, tensors
