"""Computes the policy in NumPy, for use without Rust and as a peer in benchmarks.

It computes the same function as ``shared/runtime/src/policy`` and the same noise as
``actors/src/exploration.rs``, for E environments at once; a test compares its actions with Rust's.
:class:`dmprl.Policy` adds the policy file and a robot's safety limits. Shapes: E environments, K
steps, O observation, A action, N basis functions.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

RHO_CENTRE = np.array([1.0, 0.0, 0.0, 0.0], np.float32)
OCTAVES = 8
"""Number of octaves of the pink noise, as in Rust."""
LOG_STD_RANGE = (-20.0, 2.0)
"""Range of the network's log-stds, as in Rust."""
U_MAX = np.float32(0.995)
"""Larger actions count as this one in the state of the commands, as in Rust."""


class NumpyPolicy:
    """The policy that ``plan`` describes (written by ``deploy/bench/src/numpy_plan.rs``).

    ``parameters`` are the network's, as a flat array; by default they are read from the plan's
    file.
    """

    def __init__(self, plan: dict, parameters: Floats | None = None) -> None:
        self.env_count: int = plan["env_count"]
        self.segment_steps: int = plan["decision_steps"]
        self.action_len: int = plan["spec"]["action_len"]
        low, high = np.array(plan["spec"]["action_low"]), np.array(plan["spec"]["action_high"])
        action_range = plan["policy"].get("action_range", 1.0)
        self._mid, self._half_range = 0.5 * (low + high), 0.5 * action_range * (high - low)
        if parameters is None:
            parameters = np.fromfile(Path(plan["parameters"]), np.float32)
        self._layers = layers(plan["widths"], parameters)
        self._activations = [
            np.empty((self.env_count, width), np.float32) for width in plan["widths"][1:]
        ]
        self._head = DmpHead(plan) if plan["policy"]["kind"] == "dmp" else None
        self._bounded = self._head is None or plan["policy"]["controller"] != "position"
        self._carries = self._head is not None and plan["policy"]["start"] == "carry"
        self._follows = plan["policy"]["start"] == "action"
        # After the decisions, a network may output their log-stds.
        self._decisions: int = plan["widths"][-1] - plan["log_stds_len"]
        env_len = plan["spec"]["observation_len"]
        self._observations = np.zeros((self.env_count, plan["widths"][0]), np.float32)
        # Views: the environment's observation, and the state (y, yd) that a policy may have.
        self._seen = self._observations[:, :env_len]
        self.state = self._observations[:, env_len:]

    def u(self, observations: NDArray, noise: Noise | None = None) -> Floats:
        """Computes actions u, (E, K, A), for the environments' observations, (E, O).

        They may be outside [-1, 1]; :meth:`scaled` clips them.
        """
        self._seen[:] = observations
        x = self._observations
        for (weights, bias), out in zip(self._layers, self._activations, strict=True):
            if x is not self._observations:
                np.maximum(x, 0.0, out=x)
            x = np.dot(x, weights, out=out)
            x += bias
        x, log_std = x[:, : self._decisions], x[:, self._decisions :]
        if noise is not None:
            noise.disturb_outputs(x)
        if self._head is None:
            u = x.reshape(len(x), self.segment_steps, self.action_len)
        else:
            u = self._head.u(x, self._observations)
        if noise is not None and log_std.size > 0:
            u += noise.own_draws(log_std.reshape(u.shape))
        if self._bounded:
            u = np.tanh(u)
        if noise is not None:
            noise.disturb_u(u)
        return u

    def scaled(self, u: Floats) -> NDArray[np.float64]:
        """Clips ``u`` and scales it to the environment's units."""
        return self._mid + self._half_range * np.clip(u, -1.0, 1.0)

    def end_segments(self, u: Floats, ended: NDArray[np.bool_]) -> None:
        """Sets the state after segments of actions ``u``, (E, K, A); zero if the episode ended."""
        self.carry_from(self.segment_steps)
        for step in range(self.segment_steps):
            self.follow(u[:, step])
        self.state[ended] = 0.0

    def carry_from(self, step: int) -> None:
        """Sets the state to the DMP's after 1 to K steps, if the policy carries it."""
        if self._carries:
            self.state[:] = self._head.state_after(step)

    def follow(self, u: Floats) -> None:
        """Advances the state by a step with actions ``u``, (E, A), if it is that of the commands.

        See ``shared/runtime/src/policy/command_state.rs``.
        """
        if self._follows:
            y, yd = np.split(self.state, 2, axis=1)
            after = np.arctanh(np.clip(u, -U_MAX, U_MAX))
            yd[:] = (after - y) * np.float32(self.segment_steps)
            y[:] = after

    def unscaled(self, actions: NDArray[np.float64]) -> Floats:
        """Computes u from actions in the environment's units."""
        u = ((actions - self._mid) / self._half_range).astype(np.float32)
        return np.clip(u, -1.0, 1.0)


def layers(widths: list[int], parameters: Floats) -> list[tuple[Floats, Floats]]:
    """Splits the flat parameters into weights, (inputs, outputs), and bias of each layer."""
    expected = sum((before + 1) * after for before, after in pairwise(widths))
    if len(parameters) != expected:
        raise ValueError(
            f"{len(parameters)} parameters, expected {expected} for layers of widths {widths}"
        )
    found, at = [], 0
    for before, after in pairwise(widths):
        end = at + before * after
        # Stored as (outputs, inputs); copied, because products are faster on contiguous rows.
        weights = np.ascontiguousarray(parameters[at:end].reshape(after, before).T)
        found.append((weights, parameters[end : end + after]))
        at = end + after
    return found


class DmpHead:
    """Maps the network's outputs to a segment, as in ``shared/runtime/src/policy/dmp_head.rs``."""

    def __init__(self, plan: dict) -> None:
        policy, dmp = plan["policy"], plan["dmp"]
        self._steps: int = plan["decision_steps"]
        self._basis_count: int = dmp["basis_count"]
        self._shape = (plan["env_count"], plan["spec"]["action_len"])
        inputs = 3 + self._basis_count
        segment_map = np.array(plan["segment_map"], np.float32).reshape(3 * self._steps, inputs)
        self._map = np.ascontiguousarray(segment_map.T)
        self._goal_scaling = dmp["forcing_scaling"] == "goal"
        self._goal_range = np.float32(policy["goal_range"])
        self._controller: str = policy["controller"]
        self._inverse = self._controller == "inverse"
        self._position_scale = np.float32(policy["position_scale"])
        self._bounded = policy["rho"] == "bounded"
        self._rho_range = np.float32(policy["rho_range"] if self._bounded else 1.0)
        self._omega = np.float32(dmp["alpha_y"] / 2.0)
        self._start: str = policy["start"]
        self._env_len: int = plan["spec"]["observation_len"]
        self._sources: list[dict] = plan["task"]["start_sources"]
        measured = policy["start_velocity"] == "measured"
        segment_s = policy["segment_steps"] * plan["spec"]["control_dt_s"]
        self._velocity_scale = np.float32(segment_s if measured else 0.0)
        self._inputs = np.zeros((*self._shape, inputs), np.float32)
        self._samples = np.zeros((*self._shape, 3 * self._steps), np.float32)

    def u(self, outputs: Floats, observations: Floats) -> Floats:
        """Computes the segments' actions, (E, K, A); before their tanh if they have one."""
        n, inputs = self._basis_count, self._inputs
        raw = outputs.reshape(*self._shape, 1 + n + (4 if self._inverse else 0))
        squashed = np.tanh(raw)
        self._read_start(observations)
        np.multiply(squashed[..., 0], self._goal_range, out=inputs[..., 2])
        inputs[..., 3:] = squashed[..., 1 : 1 + n]
        if self._goal_scaling:
            inputs[..., 3:] *= (inputs[..., 2] - inputs[..., 0])[..., None]
        samples = np.matmul(inputs, self._map, out=self._samples)
        y, yd, ydd = np.split(samples, 3, axis=-1)
        if self._inverse:
            rho = (squashed if self._bounded else raw)[..., 1 + n :] * self._rho_range + RHO_CENTRE
            u = rho[..., 0:1] * y + rho[..., 1:2] * yd + rho[..., 2:3] * ydd + rho[..., 3:4]
        elif self._controller == "direct":
            u = y
        else:
            u = self._position_scale * np.diff(y, axis=-1, prepend=inputs[..., :1])
        return np.ascontiguousarray(u.transpose(0, 2, 1))

    def state_after(self, step: int) -> Floats:
        """Returns (y, yd) of every action dimension after some steps of the segments, (E, 2A)."""
        y, yd = self._samples[..., step - 1], self._samples[..., self._steps + step - 1]
        return np.concatenate([y, yd * self._omega], axis=1)

    def _read_start(self, observations: Floats) -> None:
        """Writes y0 and yd0 into the map's inputs."""
        y0, yd0 = self._inputs[..., 0], self._inputs[..., 1]
        if self._start in ("carry", "action"):
            actions = self._shape[1]
            y0[:] = observations[:, self._env_len : self._env_len + actions]
            yd0[:] = observations[:, self._env_len + actions :]
        elif self._start == "observed":
            for d, source in enumerate(self._sources):
                yd0[:, d] = observations[:, source["velocity"]] * self._velocity_scale
                if "cos" in source:
                    # Converts -0 to 0, because arctan2 of -0 can be -pi instead of pi.
                    sin, cos = observations[:, source["sin"]], observations[:, source["cos"]]
                    y0[:, d] = np.arctan2(sin + 0.0, cos + 0.0)
                else:
                    scale = np.float32(source["scale"])
                    y0[:, d] = scale * observations[:, source["index"]]


class Noise:
    """Exploration noise of the same kinds as in Rust, from another random generator."""

    def __init__(self, plan: dict, seed: int) -> None:
        exploration = plan["exploration"]
        self._kind: str = exploration["kind"]
        self._std = np.float32(exploration["std"])
        self._gaussian = np.array(plan["gaussian_std"], np.float32)
        self._own = self._gaussian.size > 0 or plan["log_stds_len"] > 0
        self._random = np.random.default_rng(seed)
        shape = (plan["env_count"], plan["spec"]["action_len"], OCTAVES)
        self._sources = np.zeros(shape, np.float32)
        self._step = np.zeros(shape[0], np.int64)
        self._periods = 1 << np.arange(OCTAVES)

    def disturb_outputs(self, outputs: Floats) -> None:
        """Adds noise to the DMP's parameters, before they are bounded."""
        if not self._own and self._kind == "dmp_parameters":
            outputs += self._std * self._normal(outputs.shape)

    def own_draws(self, log_std: Floats) -> Floats:
        """Draws the noise of a Gaussian with these logarithmic standard deviations."""
        return np.exp(np.clip(log_std, *LOG_STD_RANGE)) * self._normal(log_std.shape)

    def disturb_u(self, u: Floats) -> None:
        """Adds noise to actions, (E, K, A), and clips them to [-1, 1].

        A Gaussian policy has no other noise. Its learned standard deviations, if any, are applied
        here without clipping.
        """
        if self._gaussian.size > 0:
            u += self._gaussian * self._normal(u.shape)
        if self._own or self._kind == "dmp_parameters":
            return
        if self._kind == "gaussian":
            noise = self._normal(u.shape)
        elif self._kind == "segment":
            noise = self._normal((u.shape[0], 1, u.shape[2]))
        else:
            noise = np.stack([self._pink() for _ in range(u.shape[1])], axis=1)
        u += self._std * noise
        np.clip(u, -1.0, 1.0, out=u)

    def episodes_ended(self, ended: NDArray[np.bool_]) -> None:
        """Restarts the pink noise in these environments."""
        self._step[ended] = 0

    def _pink(self) -> Floats:
        """Draws pink noise by Voss's method.

        It is the sum of white sources that hold their values; source i is renewed every 2^i steps.
        """
        renewed = self._step[:, None] % self._periods == 0
        fresh = self._normal(self._sources.shape)
        np.copyto(self._sources, fresh, where=renewed[:, None, :])
        self._step += 1
        return self._sources.sum(axis=2) / np.float32(np.sqrt(OCTAVES))

    def _normal(self, shape: tuple[int, ...]) -> Floats:
        return self._random.standard_normal(shape, np.float32)


class Actor:
    """A policy with its noise, for E environments that run segment after segment."""

    def __init__(self, plan: dict, seed: int) -> None:
        self._policy, self._noise = NumpyPolicy(plan), Noise(plan, seed)

    def actions(self, observations: NDArray) -> NDArray[np.float64]:
        """Computes the next segment's actions in the environment's units, (E, K, A)."""
        self._u = self._policy.u(observations, self._noise)
        return self._policy.scaled(self._u)

    def end_segments(self, ended: NDArray[np.bool_]) -> None:
        """Ends a segment; ``ended`` are the environments whose episode has ended."""
        self._policy.end_segments(self._u, ended)
        self._noise.episodes_ended(ended)
