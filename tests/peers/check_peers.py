"""Holds both peers to the golden updates: ``python check_peers.py``; nothing said means equal.

So the times that they are asked for are those of the update that dmprl does, and the golden files
have been reproduced by a second implementation that does not share a line with the first.
"""

import itertools
import sys
from dataclasses import replace
from pathlib import Path

GOLDEN = Path(__file__).parents[1] / "golden" / "update"
sys.path.append(str(GOLDEN))

import jax_update  # noqa: E402 - found by the line above
import numpy as np  # noqa: E402
import torch  # noqa: E402
import torch_update  # noqa: E402
from algorithms import ALGORITHMS  # noqa: E402
from jax import numpy as jnp  # noqa: E402
from make_golden import BASE, CASES, UPDATES, VARIANTS, parameters_of  # noqa: E402
from networks import flat  # noqa: E402
from safetensors.numpy import load_file  # noqa: E402

LOST_MAX = 1e-5


def batches_of(settings, golden):
    """The file's batches, one dictionary an update."""
    names = [name for name in golden if name.startswith("batch.")]
    for index in range(UPDATES):
        batch = {name.removeprefix("batch."): golden[name][index] for name in names}
        observations = batch["critic_inputs"][:, : settings.policy_observation_len]
        yield batch | {"observations": np.ascontiguousarray(observations)}


def torch_result(settings, golden):
    """Network name -> flat parameters after all updates."""
    kit = torch_update.KIT
    algorithm = ALGORITHMS[settings.algorithm](settings, kit)
    for name, values in parameters_of(algorithm).items():
        initial = torch.tensor(golden[f"initial.{name}"])  # a copy
        with torch.no_grad():
            torch.nn.utils.vector_to_parameters(initial, values)
    for batch in batches_of(settings, golden):
        algorithm.update({name: torch.from_numpy(values) for name, values in batch.items()})
    return {name: flat(values).numpy() for name, values in parameters_of(algorithm).items()}


def layers(vector, widths):
    """JAX's layers of a flat vector."""
    out, at = [], 0
    for inputs, outputs in itertools.pairwise(widths):
        weights = vector[at : at + inputs * outputs].reshape(outputs, inputs).T
        at += inputs * outputs
        out.append((jnp.array(weights), jnp.array(vector[at : at + outputs])))
        at += outputs
    return out


def flat_layers(network):
    """The other way round."""
    return np.concatenate([np.concatenate([np.ravel(w.T), b]) for w, b in network])


def jax_result(settings, golden):
    """Network name -> flat parameters after all updates."""
    s, policy = settings, jax_update.Policy(settings)
    actor = [s.policy_observation_len, *s.hidden, policy.outputs]
    critic = [s.policy_observation_len + s.critic_action_len, *s.critic_hidden, 1]
    names = ["critic"] if s.algorithm == "ddpg" else ["critic_1", "critic_2"]

    def network(name, widths):
        return layers(golden[f"initial.{name}"], widths)

    critics = [network(name, critic) for name in names]
    state = jax_update.state_of(s, network("actor", actor), critics)
    state["critics_target"] = [network(f"{name}_target", critic) for name in names]
    if s.algorithm == "sac":
        state["log_temperature"] = jnp.array(golden["initial.log_temperature"][0])
    else:
        state["actor_target"] = network("actor_target", actor)
    update = jax_update.compiled(jax_update.update_function(s, policy))
    for batch in batches_of(s, golden):
        state = update(state, batch)
    result = {"actor": state["actor"], **dict(zip(names, state["critics"], strict=True))}
    for name, target in zip(names, state["critics_target"], strict=True):
        result[f"{name}_target"] = target
    if s.algorithm == "sac":
        temperature = {"log_temperature": np.ravel(state["log_temperature"])}
    else:
        result["actor_target"], temperature = state["actor_target"], {}
    return {name: flat_layers(values) for name, values in result.items()} | temperature


def main():
    """Compares the end of every golden file."""
    for algorithm, variants in CASES.items():
        for variant in variants:
            settings = replace(BASE, algorithm=algorithm, **VARIANTS[variant])
            golden = load_file(GOLDEN / f"{algorithm}_{variant}.safetensors")
            for of in [torch_result, jax_result]:
                result = of(settings, golden)
                prefix = f"update_{UPDATES}.parameters."
                expected = {n.removeprefix(prefix): v for n, v in golden.items() if prefix in n}
                assert set(result) == set(expected), (set(result), set(expected))
                for name, values in expected.items():
                    lost = np.linalg.norm(result[name] - values) / np.linalg.norm(values)
                    what = f"{of.__name__}, {algorithm} {variant}, {name}: {lost:.1e} of its norm"
                    assert lost < LOST_MAX, what


if __name__ == "__main__":
    main()
