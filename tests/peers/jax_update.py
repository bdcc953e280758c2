"""The update in JAX, compiled as a whole: DDPG, TD3 and SAC over segments.

A second reading of the same papers; ``check_peers.py`` holds it to the PyTorch one. The state of
an algorithm is one tree of arrays: networks are lists of (weights (in, out), bias), and the whole
update is one compiled function that gives its input's memory back.
"""

import itertools
import math
from functools import partial

import jax
import numpy as np
from jax import numpy as jnp

BATCHES = 16
BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-8
LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
TEMPERATURE_LEARNING_RATE = 3e-4


def draw_network(random, widths):
    """Layers with PyTorch's default initialisation."""

    def layer(inputs, outputs):
        bound = 1 / math.sqrt(inputs)
        draw = partial(random.uniform, -bound, bound)
        return jnp.float32(draw((inputs, outputs))), jnp.float32(draw(outputs))

    return [layer(*pair) for pair in itertools.pairwise(widths)]


def run_network(layers, x):
    """ReLU layers and a linear last one."""
    for weights, bias in layers[:-1]:
        x = jax.nn.relu(x @ weights + bias)
    weights, bias = layers[-1]
    return x @ weights + bias


def segment_matrix(s):
    """(3 + N, 3K): what unit (y0, yd0, g, w) make of (y, yd, ydd); the movement is linear."""
    count, steps = s.basis_count, s.integration_steps
    centres = np.exp(-s.alpha_x * np.arange(count) / (count - 1))
    widths = count**1.5 / (centres * s.alpha_x)
    y, yd, goal, *weights = np.eye(3 + count)
    dt, phase, ydd, samples = 1 / steps, 1.0, np.zeros(3 + count), []
    for step in range(1, steps + 1):
        phase -= s.alpha_x * phase * dt
        psi = np.exp(-widths * (phase - centres) ** 2)
        forcing = phase * (psi @ np.stack(weights)) / psi.sum()
        before = ydd
        ydd = s.alpha_y * (s.alpha_y / 4 * (goal - y) - yd) + forcing
        match s.integrator:
            case "semi_implicit":
                yd = yd + ydd * dt
                y = y + yd * dt
            case "explicit":
                y, yd = y + yd * dt, yd + ydd * dt
            case _:
                y, yd = y + yd * dt, yd + before * dt
        if step % (steps // s.steps) == 0:
            samples.append((y, yd, ydd))
    return np.float32(np.concatenate([np.stack(kind) for kind in zip(*samples, strict=True)]).T)


def starts(s, observations):
    """(y0, yd0), each (B, A)."""
    at, dims = s.observation_len, s.action_len
    if s.start == "zero":
        zero = jnp.zeros((len(observations), dims))
        return zero, zero
    if s.start == "carry":
        return observations[:, at : at + dims], observations[:, at + dims :]
    speed = s.steps * s.control_dt_s if s.start_velocity == "measured" else 0.0

    def position(source):
        if source.cos is None:
            return source.scale * observations[:, source.index]
        return jnp.arctan2(observations[:, source.sin], observations[:, source.cos])

    y0 = [position(source) for source in s.start_sources]
    yd0 = [speed * observations[:, source.velocity] for source in s.start_sources]
    return jnp.stack(y0, 1), jnp.stack(yd0, 1)


class Policy:
    """From parameters and observations to a segment before its tanh."""

    def __init__(self, settings):
        self.s = settings
        self.per_dimension = 1 + settings.basis_count + 4
        numbers = settings.steps * settings.action_len
        dmp = settings.policy == "dmp"
        self.head = settings.action_len * (self.per_dimension if dmp else settings.steps)
        self.outputs = self.head + (numbers if settings.algorithm == "sac" else 0)
        self.matrix = segment_matrix(settings) if dmp else None

    def run(self, parameters, observations):
        """Pre-tanh actions (B, K, A), end state (B, 2A or 0), extra outputs."""
        s = self.s
        outputs = run_network(parameters, observations)
        extra = outputs[:, self.head :]
        if s.policy != "dmp":
            decided = outputs[:, : self.head].reshape(-1, s.steps, s.action_len)
            return decided, outputs[:, :0], extra
        head = jnp.tanh(outputs[:, : self.head].reshape(-1, s.action_len, self.per_dimension))
        goal = s.goal_range * head[..., :1]
        weights = s.weight_range * s.omega**2 * head[..., 1 : 1 + s.basis_count]
        rho = s.rho_range * head[..., 1 + s.basis_count :, None]
        y0, yd0 = (start[..., None] for start in starts(s, observations))
        if s.forcing_scaling == "goal":
            weights = weights * (goal - y0)
        samples = jnp.concatenate([y0, yd0, goal, weights], -1) @ self.matrix
        y, yd, ydd = jnp.split(samples, 3, -1)
        yd, ydd = yd / s.omega, ydd / s.omega**2
        pre = (1 + rho[:, :, 0]) * y + rho[:, :, 1] * yd + rho[:, :, 2] * ydd + rho[:, :, 3]
        seen = s.carries and s.critic == "segment"
        end = jnp.concatenate([y[..., -1], yd[..., -1]], 1) if seen else outputs[:, :0]
        return pre.swapaxes(1, 2), end, extra

    def draw(self, parameters, observations, noise):
        """Squashed Gaussian: actions, end state, log pi (B,)."""
        mean, end, raw = self.run(parameters, observations)
        log_std = jnp.clip(raw.reshape(mean.shape), LOG_STD_MIN, LOG_STD_MAX)
        pre = mean + jnp.exp(log_std) * noise
        gaussian = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
        squashing = 2 * (math.log(2) - pre - jax.nn.softplus(-2 * pre))
        return jnp.tanh(pre), end, (gaussian - squashing).sum((1, 2))


def q(s, critics, observations, actions, end):
    """Q of each critic, (B,) each."""
    seen = actions[:, 0] if s.critic == "first" else jnp.concatenate([flat(actions), end], 1)
    inputs = jnp.concatenate([observations, seen], 1)
    return [run_network(critic, inputs)[:, 0] for critic in critics]


def flat(actions):
    """(B, K, A) as (B, K A)."""
    return actions.reshape(len(actions), -1)


def adam_start(parameters):
    """Moments and number of steps."""
    zeros = jax.tree.map(jnp.zeros_like, parameters)
    return zeros, jax.tree.map(jnp.zeros_like, parameters), jnp.float32(0)


def adam(parameters, gradient, moments, learning_rate):
    """One step; returns parameters and moments."""
    first, second, count = moments
    count = count + 1
    first = jax.tree.map(lambda m, g: BETA1 * m + (1 - BETA1) * g, first, gradient)
    second = jax.tree.map(lambda v, g: BETA2 * v + (1 - BETA2) * g * g, second, gradient)
    size, root = learning_rate / (1 - BETA1**count), jnp.sqrt(1 - BETA2**count)

    def step(parameter, m, v):
        return parameter - size * m / (jnp.sqrt(v) / root + EPSILON)

    return jax.tree.map(step, parameters, first, second), (first, second, count)


def follow(target, network, share):
    """Polyak averaging."""
    return jax.tree.map(lambda slow, fast: slow + share * (fast - slow), target, network)


def critic_step(s, state, batch, q_next):
    """Descends the sum of the critics' squared errors."""
    targets = batch["rewards"] + batch["bootstrap"] * q_next

    def loss(critics):
        values = [run_network(critic, batch["critic_inputs"])[:, 0] for critic in critics]
        return sum(((value - targets) ** 2).mean() for value in values)

    gradient = jax.grad(loss)(state["critics"])
    critics, moments = adam(
        state["critics"], gradient, state["critics_adam"], s.critic_learning_rate
    )
    return state | {"critics": critics, "critics_adam": moments}


def actor_step(s, state, loss):
    """Descends `loss`, a function of the actor that returns (loss, more); returns more too."""
    gradient, more = jax.grad(loss, has_aux=True)(state["actor"])
    actor, moments = adam(state["actor"], gradient, state["actor_adam"], s.actor_learning_rate)
    return state | {"actor": actor, "actor_adam": moments}, more


def follow_all(s, state):
    """Moves the targets that the algorithm has."""
    names = [name for name in ["actor", "critics"] if f"{name}_target" in state]
    return state | {
        f"{name}_target": follow(state[f"{name}_target"], state[name], s.polyak) for name in names
    }


def deterministic(s, policy, state, batch):
    """DDPG and TD3."""
    following = batch["next_observations"]
    pre, end, _ = policy.run(state["actor_target"], following)
    actions = jnp.tanh(pre)
    if s.algorithm == "td3":
        noise = jnp.clip(0.2 * batch["target_noise"], -0.5, 0.5)
        actions = jnp.clip(actions + noise, -1, 1)
    q_next = q(s, state["critics_target"], following, actions, end)
    state = critic_step(s, state, batch, jnp.stack(q_next).min(0))

    def actor_and_targets(state):
        def loss(actor):
            pre, end, _ = policy.run(actor, batch["observations"])
            first = state["critics"][:1]
            return -q(s, first, batch["observations"], jnp.tanh(pre), end)[0].mean(), None

        return follow_all(s, actor_step(s, state, loss)[0])

    if s.algorithm == "ddpg":
        return actor_and_targets(state)
    state = state | {"updates": state["updates"] + 1}
    return jax.lax.cond(state["updates"] % 2 == 0, actor_and_targets, lambda same: same, state)


def stochastic(s, policy, state, batch):
    """SAC."""
    temperature = jnp.exp(state["log_temperature"])
    following = batch["next_observations"]
    actions, end, log_pi = policy.draw(state["actor"], following, batch["next_noise"])
    q_next = jnp.minimum(*q(s, state["critics_target"], following, actions, end))
    state = critic_step(s, state, batch, q_next - temperature * log_pi)

    def loss(actor):
        actions, end, log_pi = policy.draw(actor, batch["observations"], batch["noise"])
        values = q(s, state["critics"], batch["observations"], actions, end)
        return (temperature * log_pi - jnp.minimum(*values)).mean(), log_pi

    state, log_pi = actor_step(s, state, loss)
    numbers = s.steps * s.action_len
    entropy = -s.action_len if s.policy == "mlp" else -numbers / 2
    gradient = -(log_pi + entropy).mean()
    value, moments = adam(
        state["log_temperature"], gradient, state["temperature_adam"], TEMPERATURE_LEARNING_RATE
    )
    state = state | {"log_temperature": value, "temperature_adam": moments}
    return follow_all(s, state)


def draw_state(s, policy):
    """Networks, targets and optimisers."""
    random = np.random.default_rng(1)
    actor = draw_network(random, [s.policy_observation_len, *s.hidden, policy.outputs])
    inputs = s.policy_observation_len + s.critic_action_len
    count = 1 if s.algorithm == "ddpg" else 2
    critics = [draw_network(random, [inputs, *s.critic_hidden, 1]) for _ in range(count)]
    return state_of(s, actor, critics)


def state_of(s, actor, critics):
    """The state that begins with these networks, the targets being copies."""
    state = {
        "actor": actor,
        "actor_adam": adam_start(actor),
        "critics": critics,
        "critics_adam": adam_start(critics),
        "critics_target": jax.tree.map(jnp.copy, critics),
    }
    if s.algorithm == "sac":
        zero = jnp.float32(0)
        return state | {"log_temperature": zero, "temperature_adam": adam_start(zero)}
    counter = {"updates": jnp.int32(0)} if s.algorithm == "td3" else {}
    return state | counter | {"actor_target": jax.tree.map(jnp.copy, actor)}


def update_function(s, policy):
    """(state, batch) -> state, not compiled."""
    kind = stochastic if s.algorithm == "sac" else deterministic
    return partial(kind, s, policy)


def compiled(update):
    """As one function, which works in the memory of the state that it is given."""
    return jax.jit(update, donate_argnums=0)


def draw_batches(s):
    """Batches to take turns with."""
    random = np.random.default_rng(2)
    rows, observation = s.batch_size, s.policy_observation_len
    for _ in range(BATCHES):
        critic_inputs = random.uniform(-1, 1, (rows, observation + s.critic_action_len))
        batch = {
            "observations": critic_inputs[:, :observation],
            "critic_inputs": critic_inputs,
            "rewards": random.standard_normal(rows),
            "bootstrap": np.full(rows, 0.95),
            "next_observations": random.uniform(-1, 1, (rows, observation)),
        }
        yield {name: jnp.asarray(values, jnp.float32) for name, values in batch.items()}


def make(settings, threads):
    """Returns a function that makes one update, and its description."""
    policy = Policy(settings)
    shape = (settings.batch_size, settings.steps, settings.action_len)
    names = {"td3": ["target_noise"], "sac": ["next_noise", "noise"]}
    drawn = names.get(settings.algorithm, [])
    inner = update_function(settings, policy)

    def with_noise(held, batch):
        state, key = held
        key, *keys = jax.random.split(key, 1 + len(drawn))
        noise = {name: jax.random.normal(k, shape) for name, k in zip(drawn, keys, strict=True)}
        return inner(state, batch | noise), key

    whole = compiled(with_noise)
    held = [(draw_state(settings, policy), jax.random.key(1))]
    batches = itertools.cycle(list(draw_batches(settings)))

    def update():
        held[0] = whole(held[0], next(batches))
        # Else the next update is merely queued behind this one.
        jax.block_until_ready(held[0])

    return update, f"JAX {jax.__version__}, compiled, {threads} cores"
