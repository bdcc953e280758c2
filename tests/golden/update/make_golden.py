"""Writes the golden updates *.safetensors, beside this file; see README.md.

    pip install -r requirements.txt && python make_golden.py

Every case is computed twice, in float32 for the file and in float64 to see how much float32 loses:
a case whose result hangs on the order of its sums would test nothing, and is refused here.
"""

import copy
import json
import platform
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import torch
from algorithms import (
    ALGORITHMS,
    DROPPED,
    QUANTILES,
    SMOOTHING_MAX,
    SMOOTHING_STD,
    TEMPERATURE_LEARNING_RATE,
    Kit,
)
from networks import flat, flat_gradient
from safetensors.torch import save_file
from settings import Settings, Start

SEED = 20250611
UPDATES = 20
# Updates of which losses, gradients and targets are kept. TD3's second is the first that moves the
# actor.
DETAILED = {"ddpg": (1,), "td3": (1, 2), "sac": (1,), "tqc": (1,)}
# A quarter of the tolerances of the test that reads the files.
LOST_AT_FIRST, LOST_AT_LAST = 2.5e-6, 2.5e-5

BASE = Settings(
    algorithm="ddpg",
    policy="dmp",
    observation_len=4,
    action_len=2,
    control_dt_s=0.02,
    start_sources=(Start(cos=0, sin=1, velocity=2), Start(index=3, velocity=2, scale=-1.0)),
    batch_size=16,
    hidden=(24, 16),
    critic_hidden=(20, 12),
)
VARIANTS = {
    "dmp": {},
    "mlp": dict(policy="mlp"),
    "chunk": dict(policy="chunk"),
    "dmp_carry": dict(start="carry"),
    "dmp_first": dict(critic="first"),
    "dmp_observed": dict(start="observed"),
    "dmp_observed_at_rest": dict(start="observed", start_velocity="zero"),
    "dmp_goal_scaling": dict(start="observed", forcing_scaling="goal"),
    "dmp_paper": dict(integrator="paper", alpha_y=25.0, basis_count=3),
    "dmp_action": dict(start="action", controller="direct"),
    "dmp_layer_norm": dict(critic_layer_norm=True, critics=3),
}
# What concerns only the policy is the same for all algorithms: shown with one.
CASES = {
    "ddpg": [name for name in VARIANTS if name != "dmp_layer_norm"],
    "td3": ["dmp", "mlp", "chunk", "dmp_carry", "dmp_first"],
    "sac": ["dmp", "mlp", "chunk", "dmp_carry", "dmp_first", "dmp_action"],
    "tqc": ["dmp", "mlp", "chunk", "dmp_carry", "dmp_layer_norm"],
}


def configuration(case):
    """Everything that the case depends on, as dmprl's own configuration keys.

    Also what is a default there, which may be tuned. (TD3 here moves its actor at every 2nd update,
    and windows, target and discount are in the batches.)
    """
    sources = ", ".join(
        f"{{cos = {s.cos}, sin = {s.sin}, velocity = {s.velocity}}}"
        if s.cos is not None
        else f"{{index = {s.index}, velocity = {s.velocity}, scale = {s.scale}}}"
        for s in case.start_sources
    )
    keys = {
        "task.start_sources": f"[{sources}]",
        "policy.kind": case.policy,
        "policy.hidden": list(case.hidden),
        "policy.start": case.start,
        "policy.start_velocity": case.start_velocity,
        "policy.segment_steps": case.segment_steps,
        "policy.goal_range": case.goal_range,
        "policy.weight_range": case.weight_range,
        "policy.controller": case.controller,
        "policy.rho": "bounded",
        "policy.rho_range": case.rho_range,
        "dmp.integrator": case.integrator,
        "dmp.integration_steps": case.integration_steps,
        "dmp.canonical": "euler",
        "dmp.widths": "ndp",
        "dmp.alpha_x": case.alpha_x,
        "dmp.alpha_y": case.alpha_y,
        "dmp.basis_count": case.basis_count,
        "dmp.forcing_scaling": case.forcing_scaling,
        "algorithm.name": case.algorithm,
        "algorithm.critic": case.critic,
        "algorithm.critic_hidden": list(case.critic_hidden),
        "algorithm.critic_layer_norm": str(case.critic_layer_norm).lower(),
        "algorithm.batch_size": case.batch_size,
        "algorithm.critic_learning_rate": case.critic_learning_rate,
        "algorithm.actor_learning_rate": case.actor_learning_rate,
        "algorithm.polyak": case.polyak,
    }
    if case.algorithm == "td3":
        keys["algorithm.td3.target_noise_std"] = SMOOTHING_STD
        keys["algorithm.td3.target_noise_clip"] = SMOOTHING_MAX
        keys["algorithm.td3.actor_interval"] = 2
    if case.algorithm == "tqc":
        keys["algorithm.tqc.critics"] = case.critics
        keys["algorithm.tqc.quantiles"] = QUANTILES
        keys["algorithm.tqc.dropped_quantiles"] = DROPPED
    if case.algorithm in ("sac", "tqc"):
        keys["algorithm.sac.target_entropy_per_action"] = -1.0 if case.policy == "mlp" else -0.5
        keys["algorithm.sac.temperature_learning_rate"] = TEMPERATURE_LEARNING_RATE
    return {key: str(value) for key, value in keys.items()}


def draw_batches(case):
    """UPDATES batches: name -> (UPDATES, B, ..)."""
    rows, observation = case.batch_size, case.policy_observation_len

    def uniform(*shape):
        return 2 * torch.rand(UPDATES, rows, *shape) - 1

    observations = uniform(observation)
    batches = {
        "observations": observations,
        "critic_inputs": torch.cat([observations, uniform(case.critic_action_len)], dim=-1),
        "rewards": uniform(),
        # Every fourth row terminated.
        "bootstrap": torch.where(torch.arange(rows) % 4 == 0, 0.0, 0.5 + 0.5 * uniform()),
        "next_observations": uniform(observation),
    }
    both = ["next_noise", "noise"]
    noise = {"td3": ["target_noise"], "sac": both, "tqc": both}
    for name in noise.get(case.algorithm, []):
        batches[name] = torch.randn(UPDATES, rows, case.steps, case.action_len)
    return batches


def draw_algorithm(case):
    """The algorithm with targets that differ from their networks, so that mixing them up shows."""
    algorithm = ALGORITHMS[case.algorithm](case, Kit())
    with torch.no_grad():
        for name, network in algorithm.networks.items():
            if name.endswith("_target"):
                for values in network.parameters():
                    values += 0.1 * torch.rand(values.shape) - 0.05
        if case.algorithm in ("sac", "tqc"):
            algorithm.log_temperature -= 0.5
    return algorithm


def parameters_of(algorithm):
    """Every network's parameters, and the temperature's, by name."""
    named = {name: list(net.parameters()) for name, net in algorithm.networks.items()}
    if hasattr(algorithm, "log_temperature"):
        named["log_temperature"] = [algorithm.log_temperature]
    return named


def run(algorithm, batches):
    """Makes all updates; returns the tensors of the file."""
    detailed = DETAILED[algorithm.settings.algorithm]
    out = {f"initial.{n}": flat(v) for n, v in parameters_of(algorithm).items()}
    for index in range(UPDATES):
        algorithm.update({name: values[index] for name, values in batches.items()})
        count = index + 1
        if count in detailed:
            if algorithm.targets is not None:
                out[f"update_{count}.targets"] = algorithm.targets.clone()
            for name, loss in algorithm.losses.items():
                out[f"update_{count}.loss.{name}"] = loss.reshape(1)
            # An update that skips the actor leaves the gradient of another.
            stale = {"actor"} - set(algorithm.losses)
            for name, values in parameters_of(algorithm).items():
                if not name.endswith("_target") and name not in stale:
                    out[f"update_{count}.gradient.{name}"] = flat_gradient(values)
        if count in (*detailed, UPDATES):
            for name, values in parameters_of(algorithm).items():
                out[f"update_{count}.parameters.{name}"] = flat(values)
    return out


def in_double(algorithm, batches):
    """The same start in float64."""
    algorithm = copy.deepcopy(algorithm)
    for network in algorithm.networks.values():
        network.double()
    if hasattr(algorithm, "log_temperature"):
        algorithm.log_temperature.data = algorithm.log_temperature.data.double()
    return algorithm, {name: values.double() for name, values in batches.items()}


def check_conditioning(name, single, double):
    """Refuses a case that float32 does not determine."""
    worst = {}
    for key, values in single.items():
        stage = key.split(".")[0]
        lost = ((values - double[key]).norm() / double[key].norm().clamp(min=1e-30)).item()
        worst[stage] = max(worst.get(stage, 0.0), lost)
    for stage, lost in worst.items():
        limit = LOST_AT_LAST if stage == f"update_{UPDATES}" else LOST_AT_FIRST
        assert lost < limit, f"{name}: float32 loses {lost:.1e} of {stage}; take another seed"
    print(name, {stage: f"{lost:.1e}" for stage, lost in worst.items()})


def make(name, case, seed):
    """Computes and writes one case."""
    torch.manual_seed(seed)
    algorithm, batches = draw_algorithm(case), draw_batches(case)
    precise = in_double(algorithm, batches)
    result = run(algorithm, batches)
    check_conditioning(name, result, run(*precise))
    # The observations are the first columns of the critic's inputs.
    kept = {key: values for key, values in batches.items() if key != "observations"}
    tensors = {**result, **{f"batch.{key}": values for key, values in kept.items()}}
    write(name, tensors, configuration(case), seed)


def write(name, tensors, keys, seed, script="make_golden.py"):
    """Writes a file with its origin; `keys`: dmprl's configuration of the case."""
    about = dict(
        script=f"tests/golden/update/{script}",
        seed=seed,
        versions=dict(python=platform.python_version(), torch=version("torch")),
        configuration=keys,
        updates=UPDATES,
    )
    # One entry: of several, the order in the file is left to chance.
    metadata = {"about": json.dumps(about)}
    tensors = {key: values.detach().contiguous() for key, values in tensors.items()}
    path = Path(__file__).with_name(f"{name}.safetensors")
    save_file(tensors, path, metadata)
    path.chmod(0o644)


def main():
    """Writes every case."""
    torch.set_num_threads(1)
    for algorithm, variants in CASES.items():
        for offset, variant in enumerate(variants):
            case = replace(BASE, algorithm=algorithm, **VARIANTS[variant])
            make(f"{algorithm}_{variant}", case, SEED + offset)


if __name__ == "__main__":
    main()
