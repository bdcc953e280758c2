"""From observation to a segment before its tanh: the policies `mlp`, `chunk` and `dmp`."""

import torch
from dmp import rollout, starts
from networks import mlp
from torch import nn


class MlpPolicy(nn.Module):
    """The network alone: one action (`mlp`) or the K actions of a segment (`chunk`)."""

    def __init__(self, settings, extra_outputs=0):
        super().__init__()
        self.settings = settings
        self.network = mlp(
            settings.policy_observation_len,
            settings.hidden,
            settings.steps * settings.action_len + extra_outputs,
        )

    def forward(self, observations):
        """Pre-tanh actions (B, K, A), end state (B, 0), extra outputs (B, extra)."""
        outputs = self.network(observations)
        shape = (self.settings.steps, self.settings.action_len)
        decided = shape[0] * shape[1]
        return outputs[:, :decided].unflatten(1, shape), outputs[:, :0], outputs[:, decided:]


class DmpPolicy(nn.Module):
    """A segment of K actions: DMP, then the adaptive inverse, the position or no controller.

    Outputs of one action dimension stand together: goal, N weights, 4 rho (of the former only).
    """

    def __init__(self, settings, extra_outputs=0):
        super().__init__()
        self.settings = settings
        rho = 4 if settings.controller == "inverse" else 0
        self.per_dimension = 1 + settings.basis_count + rho
        self.outputs = settings.action_len * self.per_dimension
        self.network = mlp(
            settings.policy_observation_len, settings.hidden, self.outputs + extra_outputs
        )

    def samples(self, y0, yd0, goal, weights):
        """The movement; a benchmark replaces it by something faster."""
        return rollout(self.settings, y0, yd0, goal, weights)

    def forward(self, observations):
        """Pre-tanh actions (B, K, A), end state (B, 2A or 0), extra outputs (B, extra)."""
        s = self.settings
        outputs = self.network(observations)
        head = outputs[:, : self.outputs].reshape(-1, s.action_len, self.per_dimension).tanh()
        goal = s.goal_range * head[..., 0]
        weights = s.weight_range * s.omega**2 * head[..., 1 : 1 + s.basis_count]
        rho = s.rho_range * head[..., 1 + s.basis_count :]
        y0, yd0 = starts(s, observations)
        y, yd, ydd = self.samples(y0, yd0, goal, weights)
        if s.controller == "position":
            before = torch.cat([y0[:, None], y[:, :-1]], dim=1)
            return s.position_scale * (y - before), outputs[:, :0], outputs[:, :0]
        if s.controller == "direct":
            return y, outputs[:, :0], outputs[:, self.outputs :]
        yd, ydd = yd / s.omega, ydd / s.omega**2
        rho = rho[:, None]  # (B, 1, A, 4): the same over the K steps
        pre = (1 + rho[..., 0]) * y + rho[..., 1] * yd + rho[..., 2] * ydd + rho[..., 3]
        seen = s.carries and s.critic == "segment"
        end = torch.cat([y[:, -1], yd[:, -1]], dim=1) if seen else outputs[:, :0]
        return pre, end, outputs[:, self.outputs :]


def make_policy(settings, extra_outputs=0):
    """The policy that the settings name."""
    kinds = {"mlp": MlpPolicy, "chunk": MlpPolicy, "dmp": DmpPolicy}
    return kinds[settings.policy](settings, extra_outputs)


def seen_by_critic(settings, actions, end):
    """Selects the critic's inputs from a segment's actions (B, K, A) and end state."""
    if settings.critic == "first":
        return actions[:, 0]
    return torch.cat([actions.flatten(1), end], dim=1)
