"""Runs a trained policy on a robot. It needs only NumPy and the policy file.

::

    policy = dmprl.Policy.load("policy.safetensors")
    policy.reset()
    action = policy.action(observation)  # once per control step

It behaves like ``shared/runtime/src/policy_runtime`` in Rust; a test compares them. Shapes: K steps
of a segment, O observation, A action.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dmprl import zoo
from dmprl.hold import Hold, NoHoldError
from dmprl.numpy_policy import NumpyPolicy
from dmprl.plan import Plan
from dmprl.policy_description import check
from dmprl.policy_file import PolicyFile, PolicyFileError, read
from dmprl.predict import observation_rows, start_flags

Actions = NDArray[np.float64]

HOLD_STEPS_MAX = 10_000
"""Maximum number of control steps from any action to the hold. A lower rate is rejected."""


class Policy:
    """Runs a policy on one observation at a time; :meth:`load` creates one."""

    def __init__(self, file: PolicyFile) -> None:
        check(file.description)
        self.file = file
        """Description, origin and version of the policy."""
        spec = file.description["spec"]
        self.spec: dict[str, Any] = spec
        """The environment: ``observation_len``, ``action_low``, ``control_dt_s`` [s], …"""
        self.low: Actions = np.array(spec["action_low"], np.float64)
        self.high: Actions = np.array(spec["action_high"], np.float64)
        self._network = NumpyPolicy(_network_plan(file), _flat(file))
        self._has_state = self._network.state.shape[1] > 0
        self.segment_steps: int = self._network.segment_steps
        """Control steps per decision, K."""
        self._rate: Actions = np.full(self.low.shape, np.inf)
        self._stated_hold: Actions | None = None
        if file.hold is not None:
            self._stated_hold = file.hold.action(self.low, self.high)
        self._hold_after = self.segment_steps
        self._deadline_s = np.inf
        self._clock: Callable[[], float] = time.monotonic
        self._plan = Plan(self.segment_steps, self.low.size)
        execution = file.description["policy"].get("execution", "segment")
        self._is_ensemble = execution == "ensemble" and self.segment_steps > 1
        self._others: list[Policy] = []
        """Act in the other environments of :meth:`predict`, each at its own step."""
        self._start_episode()

    @classmethod
    def load(cls, path: str | Path) -> Policy:
        """Loads a policy file, the best policy of a run directory, or ``zoo:TASK``.

        ``dmprl export`` writes policy files; those of :mod:`dmprl.zoo` come with the package.

        :raises OSError: if it cannot be read.
        :raises dmprl.PolicyFileError: if it is not a policy file, is damaged, or is too old.
        """
        path = zoo.path(path) or Path(path)
        if path.is_dir():
            run, path = path, path / "checkpoints" / "best"
            if not path.exists():
                raise PolicyFileError(
                    f"{run}: has no checkpoints/best; expected the directory of a run with an "
                    "evaluated policy"
                )
        file = read(path)
        try:
            return cls(file)
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            raise PolicyFileError(f"{path}: inconsistent contents: {error!r}") from error

    def __repr__(self) -> str:
        spec = self.spec
        return (
            f"<Policy for {spec['id']}: observation of {spec['observation_len']} values, "
            f"{self.segment_steps} actions of {self.low.size} values per decision, "
            f"{spec['control_dt_s']:g} s per action>"
        )

    def __deepcopy__(self, memo: dict[int, Any]) -> Policy:
        """Returns a policy with the same limits, at the start of an episode."""
        other = Policy(self.file)
        other._rate, other._stated_hold = self._rate, self._stated_hold
        other._hold_after, other._deadline_s = self._hold_after, self._deadline_s
        other._clock = self._clock
        return other

    @property
    def is_holding(self) -> bool:
        """Whether the last action was the hold or on the way to it.

        On request, because observations stopped, or because the caller was frozen.
        """
        return self._holding

    def limit(
        self,
        *,
        rate: ArrayLike | None = None,
        hold: Hold | None = None,
        hold_after: int | None = None,
        deadline_s: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Sets limits; omitted ones do not change. All need a hold, from here or from the file.

        :param rate: maximum change of an action between control steps, (A,) or one number for all,
            in the environment's units; initially infinite.
        :param hold: command that holds the robot; initially the one stated at ``dmprl export``.
        :param hold_after: control steps without an observation after which the robot holds;
            initially K. More than K has no effect, because the next segment needs an observation.
        :param deadline_s: longest time between two calls of :meth:`action` [s]; initially infinite.
            After a longer one, the caller was frozen and the robot has executed an old action, so
            the policy holds: its next decision is by the observation of the next call.
        :param clock: returns the time for ``deadline_s`` [s].
        :raises dmprl.NoHoldError: if no hold is stated; nothing changes then.
        :raises ValueError: if a limit is invalid; nothing changes then.
        """
        rates, held, after = self._rate, self._stated_hold, self._hold_after
        if hold is not None:
            if not isinstance(hold, Hold):
                raise ValueError(
                    f"hold is {hold!r}: expected dmprl.Hold.zero_velocity(), "
                    "dmprl.Hold.zero_torque() or dmprl.Hold.position(values)"
                )
            held = hold.action(self.low, self.high)
        if held is None:
            raise NoHoldError
        if rate is not None:
            rates = _broadcast("rate", rate, self.low.shape)
            smallest = (self.high - self.low) / (HOLD_STEPS_MAX - 1)  # the last is for rounding
            if not (rates >= smallest).all():
                raise ValueError(
                    f"rate is {rates}: expected {smallest} or more, to reach the hold in "
                    f"{HOLD_STEPS_MAX} control steps"
                )
        if hold_after is not None:
            if hold_after < 0:
                raise ValueError(f"hold_after is {hold_after}: expected 0 or more")
            after = int(hold_after)
        if deadline_s is not None:
            if not deadline_s > 0.0:
                raise ValueError(f"deadline_s is {deadline_s}: expected a positive number")
            self._deadline_s, self._clock, self._called_at_s = float(deadline_s), clock, None
        self._rate, self._stated_hold, self._hold_after = rates, held, after
        self._others.clear()  # they have the limits from before

    def reset(self, y0: Sequence[float] | NDArray | None = None) -> None:
        """Starts an episode. The next action starts a plan.

        A limited rate starts from the hold, as if the robot had executed the hold before. State the
        robot's present position before, if it is held by one.

        :param y0: start of the DMP, (A,) in units of y, for a policy whose segments start where the
            previous one ended (``policy.start = "carry"`` or ``"action"``). The default is 0, as in
            training. For ``action`` it is tanh⁻¹ of the last action, scaled to [-1, 1]; in training
            it is at most 2.99 (an action of 0.995).
        :raises ValueError: if y0 is not A finite numbers, or the policy has another start.
        """
        if y0 is not None:
            if not self._has_state:
                raise ValueError(
                    "y0 must be None: this policy's segments do not start where the previous one "
                    "ended"
                )
            y0 = np.asarray(y0, np.float32)
            if y0.shape != self.low.shape or not np.isfinite(y0).all():
                raise ValueError(f"y0 is {y0}: expected {self.low.size} finite numbers")
        for policy in (self, *self._others):
            policy._start_episode(y0)

    def _start_episode(self, y0: NDArray[np.float32] | None = None) -> None:
        self._network.state[:] = 0.0
        if y0 is not None:
            self._network.state[0, : self.low.size] = y0
        self._plan.clear()
        self._previous: Actions | None = None
        self._called_at_s: float | None = None
        self._missed = 0
        self._holding = False

    def segment(self, observation: ArrayLike) -> Actions:
        """Decides the next segment's actions, (K, A), in the environment's units.

        For a caller that executes all of them. Drops the rest of the plan.

        :param observation: (O,) in the environment's units.
        :raises ValueError: if the observation is invalid, or the network's outputs are NaN. The
            only available action is then :meth:`hold`; the policy continues at the next valid
            observation.
        """
        self._called_at_s = None  # the caller returns after K steps
        seen = self._checked(observation)
        self._plan.clear()
        self._decide(seen)
        self._missed, self._holding = 0, False
        return np.stack([self._next_action() for _ in range(self.segment_steps)])

    def action(self, observation: ArrayLike | None = None) -> Actions:
        """Returns the next control step's action, (A,), in the environment's units.

        With ``policy.execution = "ensemble"`` the policy decides from every observation and blends
        the new segment with the rest of its plan. With ``"segment"`` it decides at a segment's
        first step; within the segment, observations only reset the watchdog.

        :param observation: (O,); None if there is no new one since the last call. After
            ``hold_after`` calls without one, if no action is planned, or after the deadline, the
            action is the hold; the next observation then starts a new plan.
        :raises ValueError: as :meth:`segment`, at every step.
        :raises dmprl.NoHoldError: if there is no observation and no hold is stated.
        """
        if self._is_late():
            # The observation may be from before the freeze.
            self._holding = True
            if observation is not None:
                self._checked(observation)
            return self._limited(self._known_hold())
        if observation is not None:
            seen = self._checked(observation)
            if self._holding:
                self._plan.clear()
            if self._is_ensemble or self._plan.is_empty:
                self._decide(seen)
            self._missed, self._holding = 0, False
        else:
            self._known_hold()
            self._missed += 1
            due = self._plan.is_empty
            self._holding = self._holding or due or self._missed > self._hold_after
        if self._holding:
            return self._limited(self._known_hold())
        return self._next_action()

    def predict(
        self,
        observation: ArrayLike | Mapping[str, ArrayLike],
        state: None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, None]:
        """Returns the next actions, (A,) or (E, A), and None, as Stable-Baselines3's ``predict``.

        For code written for Stable-Baselines3, such as its ``evaluate_policy``. The actions are
        those of :meth:`action` and have no noise. The policy remembers each environment's place in
        its segment, so state the starts of episodes, or call :meth:`reset` before each.

        :param observation: (O,), or (E, O) of E environments, or a mapping with such entries,
            which are joined in the order of their names.
        :param episode_start: (E,), whether each observation is the first of an episode.
        :raises ValueError: as :meth:`segment`, or if the shapes differ from these.
        """
        rows, is_batch = observation_rows(observation, self.spec["observation_len"])
        starts = start_flags(episode_start, len(rows))
        while len(self._others) + 1 < len(rows):
            self._others.append(copy.deepcopy(self))
        actions = []
        for policy, row, starts_here in zip((self, *self._others), rows, starts, strict=False):
            if starts_here:
                policy._start_episode()
            actions.append(policy.action(row))
        return np.stack(actions) if is_batch else actions[0], None

    def hold(self) -> Actions:
        """Returns an action towards the hold, as far as the rate limit allows, (A,).

        Use it after an error, and whenever the policy must not act. The next observation starts a
        new plan.

        :raises dmprl.NoHoldError: if no hold is stated.
        """
        self._is_late()  # records the call
        self._holding = True
        return self._limited(self._known_hold())

    def hold_until_reached(self, send: Callable[[Actions], object]) -> int:
        """Sends actions towards the hold until the last one is the hold; returns their number.

        There is one per control step, no faster than the rate limit allows. Call it at the end of
        every drive, also after an error or a signal.

        :param send: sends the action to the robot and waits for the end of the control step. If it
            raises an exception, the robot did not get the hold.
        :raises dmprl.NoHoldError: if no hold is stated.
        """
        for sent in range(1, HOLD_STEPS_MAX + 1):
            action = self.hold()
            reached = bool((action == self._known_hold()).all())
            send(action)
            if reached:
                return sent
        raise RuntimeError(f"the hold was not reached in {HOLD_STEPS_MAX} control steps")

    def _known_hold(self) -> Actions:
        if self._stated_hold is None:
            raise NoHoldError
        return self._stated_hold

    def _is_late(self) -> bool:
        """Records a call. Returns whether it comes too late after the previous one."""
        if self._deadline_s == np.inf:
            return False
        before_s, self._called_at_s = self._called_at_s, self._clock()
        # A clock that goes backwards or returns NaN measures nothing, so the call counts as late.
        return before_s is not None and not 0.0 <= self._called_at_s - before_s <= self._deadline_s

    def _next_action(self) -> Actions:
        """Returns the next planned action, limited."""
        action = self._limited(self._network.scaled(self._plan.take()))
        self._step += 1
        self._network.carry_from(self._step)
        return action

    def _limited(self, wanted: Actions) -> Actions:
        # The first action starts from the hold. Without one, the rate is not limited either.
        first = wanted if self._stated_hold is None else self._stated_hold
        previous = first if self._previous is None else self._previous
        near = np.clip(wanted, previous - self._rate, previous + self._rate)
        self._previous = np.clip(near, self.low, self.high)
        # Not the wanted action, because the robot gets this one.
        self._network.follow(self._network.unscaled(self._previous)[None])
        return self._previous.copy()

    def _decide(self, seen: NDArray[np.float32]) -> None:
        # Far outside the training data, the network can overflow to infinity and NaN.
        with np.errstate(over="ignore", invalid="ignore"):
            u = self._network.u(seen[None])
        if np.isnan(u).any():
            self._plan.clear()
            raise ValueError(
                "the policy's actions for this observation are not finite: it is far outside the "
                "training data"
            )
        self._plan.add(u[0])
        self._step = 0

    def _checked(self, observation: ArrayLike) -> NDArray[np.float32]:
        """Checks an observation and converts it to the network's type."""
        with np.errstate(over="ignore"):
            seen = np.asarray(observation, np.float64).astype(np.float32)
        expected = (self.spec["observation_len"],)
        if seen.shape != expected:
            raise ValueError(f"observation has shape {seen.shape}, expected {expected}")
        not_finite = np.flatnonzero(~np.isfinite(seen))
        if not_finite.size > 0:
            index = int(not_finite[0])
            names = self.spec["observation_names"]
            name = f", {names[index]}," if names else ""
            value = np.asarray(observation)[index]
            raise ValueError(f"observation[{index}]{name} is {value}: expected a finite number")
        return seen


def _broadcast(what: str, values: ArrayLike, shape: tuple[int, ...]) -> Actions:
    """Returns one value per action dimension; rejects NaN."""
    array = np.asarray(values, np.float64)
    if array.shape not in ((), shape) or np.isnan(array).any():
        raise ValueError(f"{what} is {values}: expected one number or {shape[0]} numbers")
    return np.broadcast_to(array, shape).copy()


def _network_plan(file: PolicyFile) -> dict[str, Any]:
    """Creates the plan for :class:`NumpyPolicy`."""
    description = file.description
    policy, spec = description["policy"], description["spec"]
    is_dmp = policy["kind"] == "dmp"
    steps: int = 1 if policy["kind"] == "mlp" else policy["segment_steps"]
    if is_dmp:
        expected = (3 * steps, 3 + description["dmp"]["basis_count"])
        if file.segment_map is None or file.segment_map.shape != expected:
            found = None if file.segment_map is None else file.segment_map.shape
            raise ValueError(f"segment_map has shape {found}, expected {expected}")
    has_state = policy["start"] == "action" or (is_dmp and policy["start"] == "carry")
    state_len = 2 * spec["action_len"] if has_state else 0
    widths = [file.layers[0][0].shape[1], *(len(bias) for _, bias in file.layers)]
    inputs = spec["observation_len"] + state_len
    if widths[0] != inputs:
        raise ValueError(f"actor.0.weight has {widths[0]} inputs, expected {inputs}")
    # The network of SAC and TQC outputs the log-stds after the decisions.
    log_stds_len = steps * spec["action_len"] if description["algorithm"] in ("sac", "tqc") else 0
    controlled = 4 if policy["controller"] == "inverse" else 0
    decided = 1 + description["dmp"]["basis_count"] + controlled if is_dmp else steps
    outputs = decided * spec["action_len"] + log_stds_len
    if widths[-1] != outputs:
        name = f"actor.{len(file.layers) - 1}.weight"
        raise ValueError(f"{name} has {widths[-1]} outputs, expected {outputs}")
    return {
        "env_count": 1,
        "decision_steps": steps,
        "spec": spec,
        "widths": widths,
        "policy": policy,
        "dmp": description["dmp"],
        "task": {"start_sources": description["start_sources"]},
        "segment_map": file.segment_map,
        "log_stds_len": log_stds_len,
    }


def _flat(file: PolicyFile) -> NDArray[np.float32]:
    return np.concatenate([part.ravel() for layer in file.layers for part in layer])
