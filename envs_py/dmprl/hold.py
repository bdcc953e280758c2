"""The command that holds a robot, in the robot's own terms.

A policy has none by default, because the same numbers hold one robot and move another. In Rust it
is in ``shared/runtime/src/policy/hold.rs``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

POSITION, ZERO_VELOCITY, ZERO_TORQUE = "position", "zero-velocity", "zero-torque"


class NoHoldError(RuntimeError):
    """Raised if a robot is to be held or limited, but its hold is not known."""

    def __init__(self) -> None:
        super().__init__(
            "the policy states no hold, the command that holds the robot: state it with dmprl "
            "export --hold, or here with policy.limit(hold=dmprl.Hold.zero_velocity()), "
            "dmprl.Hold.zero_torque() or dmprl.Hold.position(values)"
        )


@dataclass(frozen=True)
class Hold:
    """The command that holds a robot; a class method creates one."""

    kind: str
    values: tuple[float, ...] = ()

    @classmethod
    def position(cls, values: ArrayLike) -> Hold:
        """Holds a robot that takes positions. It moves to this one and keeps it.

        :param values: (A,) in the environment's units of an action.
        """
        return cls(POSITION, tuple(np.asarray(values, np.float64).ravel().tolist()))

    @classmethod
    def zero_velocity(cls) -> Hold:
        """Holds a robot that takes velocities, or displacements per control step.

        All are 0, so the robot stops where it is.
        """
        return cls(ZERO_VELOCITY)

    @classmethod
    def zero_torque(cls) -> Hold:
        """Holds a robot that takes torques.

        All are 0, so an arm without gravity compensation falls.
        """
        return cls(ZERO_TORQUE)

    @classmethod
    def parse(cls, text: str) -> Hold:
        """Parses ``zero-velocity``, ``zero-torque`` or ``position=V,V,…``, as ``dmprl export``.

        :raises ValueError: for any other text.
        """
        kind, _, values = text.partition("=")
        if text in (ZERO_VELOCITY, ZERO_TORQUE):
            return cls(text)
        try:
            if kind == POSITION:
                return cls(kind, tuple(float(value) for value in values.split(",")))
        except ValueError:
            pass
        raise ValueError(
            f"hold is {text!r}: expected zero-velocity, zero-torque or position=V,V,… (one per "
            "action)"
        )

    @classmethod
    def of_file(cls, entry: Any) -> Hold:
        """Reads the hold of a policy file.

        :raises ValueError: if it is not a hold.
        """
        values = entry.get("values", ()) if isinstance(entry, dict) else ()
        if entry == {"kind": POSITION, "values": values}:
            return cls.position([float(value) for value in values])
        if entry in ({"kind": ZERO_VELOCITY}, {"kind": ZERO_TORQUE}):
            return cls(entry["kind"])
        raise ValueError(f"hold is {entry!r}: expected one that this version of dmprl supports")

    def action(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the action that holds the robot, (A,), in the environment's units.

        :raises ValueError: if it is not an action within the bounds.
        """
        held = np.array(self.values) if self.kind == POSITION else np.zeros(low.shape)
        if held.shape != low.shape:
            raise ValueError(
                f"hold has {held.size} values, expected {low.size}, one per action dimension"
            )
        if not ((held >= low) & (held <= high)).all():
            raise ValueError(f"hold is {held}: expected {low} to {high}")
        return held
