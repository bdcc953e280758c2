"""One update of DDPG, TD3, SAC and TQC over segments, as their papers write them.

Each class has `networks` (name -> module), `losses` (name -> number) of the last update and
`targets`, the critics' regression targets. A batch maps names to tensors; see the README.
"""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from networks import follow, mlp
from policies import make_policy, seen_by_critic
from torch.nn.functional import huber_loss, softplus

SMOOTHING_STD = 0.2
SMOOTHING_MAX = 0.5
ACTOR_EVERY = 2
LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
TEMPERATURE_LEARNING_RATE = 3e-4
QUANTILES, DROPPED = 25, 2


def adam(parameters, learning_rate):
    """Kingma & Ba 2015 with PyTorch's defaults: betas 0.9 and 0.999, epsilon 1e-8."""
    return torch.optim.Adam(parameters, lr=learning_rate)


@dataclass(frozen=True)
class Kit:
    """Parts that a benchmark replaces by faster ones with the same results."""

    make_policy: Callable = make_policy
    adam: Callable = adam
    follow: Callable = follow


def squared_error(q, targets):
    """mean (Q - target)^2."""
    return ((q - targets) ** 2).mean()


class ActorCritic:
    """The networks and the critic's inputs, common to the three algorithms."""

    def __init__(self, settings, kit, critics, extra_outputs=0):
        self.settings, self.kit = settings, kit
        self.updates = 0
        self.losses, self.targets = {}, None
        self.actor = kit.make_policy(settings, extra_outputs)
        inputs = settings.policy_observation_len + settings.critic_action_len
        self.critics = [mlp(inputs, settings.critic_hidden, 1) for _ in range(critics)]
        self.critic_targets = copy.deepcopy(self.critics)
        both = [values for critic in self.critics for values in critic.parameters()]
        self.critic_adam = kit.adam(both, settings.critic_learning_rate)
        self.actor_adam = kit.adam(self.actor.parameters(), settings.actor_learning_rate)

    @property
    def networks(self):
        """Every network and target by name."""
        count = len(self.critics)
        names = ["critic"] if count == 1 else [f"critic_{index + 1}" for index in range(count)]
        pairs = dict(zip(names, self.critics, strict=True))
        slow = {f"{n}_target": c for n, c in zip(names, self.critic_targets, strict=True)}
        return {"actor": self.actor, **pairs, **slow}

    def q(self, critics, observations, actions, end):
        """Q of each critic, (B,) each."""
        seen = seen_by_critic(self.settings, actions, end)
        inputs = torch.cat([observations, seen], dim=1)
        return [critic(inputs)[:, 0] for critic in critics]

    def critic_step(self, batch, q_next):
        """target = reward + bootstrap * q_next; descends the sum of the critics' errors."""
        self.targets = batch["rewards"] + batch["bootstrap"] * q_next
        self.descend_critics(
            sum(
                squared_error(critic(batch["critic_inputs"])[:, 0], self.targets)
                for critic in self.critics
            )
        )

    def descend_critics(self, loss):
        """One step of all critics."""
        self.critic_adam.zero_grad()
        loss.backward()
        self.critic_adam.step()
        self.losses = {"critic": loss.detach()}

    def actor_step(self, loss):
        """Descends the actor's loss; no critic's parameter has a gradient of it."""
        self.actor_adam.zero_grad()
        loss.backward(inputs=list(self.actor.parameters()))
        self.actor_adam.step()
        self.losses["actor"] = loss.detach()

    def follow_critics(self):
        """Moves the critics' targets."""
        for target, critic in zip(self.critic_targets, self.critics, strict=True):
            self.kit.follow(target, critic, self.settings.polyak)


class Ddpg(ActorCritic):
    """Lillicrap et al. 2016, Algorithm 1."""

    def __init__(self, settings, kit, critics=1):
        super().__init__(settings, kit, critics)
        self.actor_target = copy.deepcopy(self.actor)

    @property
    def networks(self):
        """Every network and target by name."""
        return {**super().networks, "actor_target": self.actor_target}

    def update(self, batch):
        """Critic, actor, targets."""
        self.updates += 1
        with torch.no_grad():
            following = batch["next_observations"]
            pre, end, _ = self.actor_target(following)
            (q_next,) = self.q(self.critic_targets, following, pre.tanh(), end)
        self.critic_step(batch, q_next)
        self.actor_step(-self.policy_value(batch))
        self.follow_all()

    def policy_value(self, batch):
        """mean Q_1(s, pi(s))."""
        pre, end, _ = self.actor(batch["observations"])
        return self.q(self.critics[:1], batch["observations"], pre.tanh(), end)[0].mean()

    def follow_all(self):
        """Moves the critics' and the actor's targets."""
        self.follow_critics()
        self.kit.follow(self.actor_target, self.actor, self.settings.polyak)


class Td3(Ddpg):
    """Fujimoto et al. 2018, Algorithm 1: twin critics, target smoothing, a delayed actor."""

    def __init__(self, settings, kit):
        super().__init__(settings, kit, critics=2)

    def update(self, batch):
        """Critics; every second time actor and targets too."""
        self.updates += 1
        with torch.no_grad():
            following = batch["next_observations"]
            pre, end, _ = self.actor_target(following)
            noise = (SMOOTHING_STD * batch["target_noise"]).clamp(-SMOOTHING_MAX, SMOOTHING_MAX)
            actions = (pre.tanh() + noise).clamp(-1.0, 1.0)
            q_next = torch.minimum(*self.q(self.critic_targets, following, actions, end))
        self.critic_step(batch, q_next)
        if self.updates % ACTOR_EVERY == 0:
            self.actor_step(-self.policy_value(batch))
            self.follow_all()


class Sac(ActorCritic):
    """Haarnoja et al. 2018 (SAC Algorithms and Applications): squashed Gaussian, temperature.

    The entropy is one term per decision: log pi is summed over the K A numbers of a segment.
    """

    def __init__(self, settings, kit):
        numbers = settings.steps * settings.action_len
        super().__init__(settings, kit, 2, extra_outputs=numbers)
        self.target_entropy = -settings.action_len if settings.policy == "mlp" else -numbers / 2
        self.log_temperature = torch.zeros(1, requires_grad=True)
        self.temperature_adam = kit.adam([self.log_temperature], TEMPERATURE_LEARNING_RATE)

    def draw(self, observations, noise):
        """Actions (B, K, A), end state, log pi (B,)."""
        mean, end, raw = self.actor(observations)
        log_std = raw.reshape(mean.shape).clamp(LOG_STD_MIN, LOG_STD_MAX)
        pre = mean + log_std.exp() * noise
        gaussian = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
        # log (1 - tanh(pre)^2), without the cancellation.
        squashing = 2 * (math.log(2) - pre - softplus(-2 * pre))
        return pre.tanh(), end, (gaussian - squashing).sum(dim=(1, 2))

    def update(self, batch):
        """Critics, actor, temperature, targets of the critics."""
        self.updates += 1
        temperature = self.log_temperature.detach().exp()
        with torch.no_grad():
            actions, end, log_pi = self.draw(batch["next_observations"], batch["next_noise"])
        self.fit_critics(batch, actions, end, temperature * log_pi)
        actions, end, log_pi = self.draw(batch["observations"], batch["noise"])
        q = self.value(batch["observations"], actions, end)
        self.actor_step((temperature * log_pi - q).mean())
        self.temperature_step(log_pi.detach())
        self.follow_critics()

    def fit_critics(self, batch, actions, end, cost):
        """Fits the critics to the values of the next actions, less the entropy's cost, (B,)."""
        with torch.no_grad():
            q = self.q(self.critic_targets, batch["next_observations"], actions, end)
            q_next = torch.minimum(*q) - cost
        self.critic_step(batch, q_next)

    def value(self, observations, actions, end):
        """The actor's objective, (B,)."""
        return torch.minimum(*self.q(self.critics, observations, actions, end))

    def temperature_step(self, log_pi):
        """Descends -log temperature * mean(log pi + target entropy)."""
        loss = -(self.log_temperature * (log_pi + self.target_entropy)).mean()
        self.temperature_adam.zero_grad()
        loss.backward()
        self.temperature_adam.step()
        self.losses["temperature"] = loss.detach()


class Tqc(Sac):
    """Kuznetsov et al. 2020, Algorithm 1: SAC whose critics predict quantiles of the return."""

    def __init__(self, settings, kit):
        super().__init__(settings, kit)
        inputs = settings.policy_observation_len + settings.critic_action_len
        shape = (inputs, settings.critic_hidden, QUANTILES, settings.critic_layer_norm)
        self.critics = [mlp(*shape) for _ in range(settings.critics)]
        self.critic_targets = copy.deepcopy(self.critics)
        both = [values for critic in self.critics for values in critic.parameters()]
        self.critic_adam = kit.adam(both, settings.critic_learning_rate)

    def quantiles(self, critics, observations, actions, end):
        """All quantiles of all critics, (B, critics * M)."""
        seen = seen_by_critic(self.settings, actions, end)
        inputs = torch.cat([observations, seen], dim=1)
        return torch.cat([critic(inputs) for critic in critics], dim=1)

    def fit_critics(self, batch, actions, end, cost):
        """Fits every quantile to the targets that are left after the largest are dropped."""
        with torch.no_grad():
            following = batch["next_observations"]
            atoms = self.quantiles(self.critic_targets, following, actions, end)
            atoms = atoms.sort(dim=1).values[:, : len(self.critics) * (QUANTILES - DROPPED)]
            atoms = atoms - cost[:, None]
            targets = batch["rewards"][:, None] + batch["bootstrap"][:, None] * atoms
        self.descend_critics(
            sum(quantile_huber(critic(batch["critic_inputs"]), targets) for critic in self.critics)
        )

    def value(self, observations, actions, end):
        """The mean of all quantiles, (B,)."""
        return self.quantiles(self.critics, observations, actions, end).mean(dim=1)


def quantile_huber(quantiles, targets):
    """Equations 8 and 9: the mean over batch, quantiles (B, M) and targets (B, T)."""
    count = quantiles.shape[1]
    fractions = (torch.arange(count, dtype=quantiles.dtype) + 0.5) / count
    total = 0.0
    for index in range(count):
        delta = targets - quantiles[:, index : index + 1]
        error = huber_loss(delta, torch.zeros_like(delta), reduction="none")
        weight = torch.where(delta < 0, 1.0 - fractions[index], fractions[index])
        total = total + (weight * error).mean()
    return total / count


ALGORITHMS = {"ddpg": Ddpg, "td3": Td3, "sac": Sac, "tqc": Tqc}
