"""Writes golden.json, beside this file: DMP trajectories computed by two public packages.

    pip install -r requirements.txt && python make_golden.py

Read by shared/runtime/src/dmp/golden_tests.rs, which reproduces the numbers with our own parts.

Both packages use the paper's forcing term (no factor g - y0) and semi-implicit Euler steps. They
differ from our defaults in the phase (exact; alpha_x 4.605 and 3) and in the basis widths.
- movement_primitives: `step` with the step function "euler", which takes inner steps of int_dt
  (0.001 s) and evaluates the phase at the *end* of each. Its default "rk4" takes the phase of a
  step that has already passed and is of first order only, at a step of dt: not used.
- mp_pytorch: one step per time given, with the phase at the *start* of the step.
"""

import json
import platform
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from movement_primitives.dmp import DMP
from mp_pytorch.basis_gn import NormalizedRBFBasisGenerator
from mp_pytorch.mp.dmp import DMP as TorchDmp  # noqa: N811 - two classes of one name
from mp_pytorch.phase_gn import ExpDecayPhaseGenerator

SEED = 20241105
PACKAGES = ["movement_primitives", "mp-pytorch", "numpy", "torch"]
STEPS = 40  # output steps over tau
INNER_STEPS = 25  # movement_primitives' own steps per output step


def draw_cases(generator):
    """The worked example of research/algorithms.md, section 6, then random parameters."""
    weights = [10.0, -20.0, 30.0, 0.0, 5.0]
    cases = [dict(alpha_y=25.0, tau=1.0, y0=0.0, yd0=0.0, goal=1.0, weights=weights)]
    variants = [(3, 10.0, 1.0), (4, 5.0, 2.0), (5, 15.0, 0.5), (6, 25.0, 1.0)]
    for basis_count, alpha_y, tau in variants:
        cases.append(
            dict(
                alpha_y=alpha_y,
                tau=tau,
                y0=generator.uniform(-1, 1),
                yd0=generator.uniform(-1, 1),
                goal=generator.uniform(-1, 1),
                weights=(50 * generator.standard_normal(basis_count)).tolist(),
            )
        )
    return cases


def movement_primitives_case(case):
    dt = case["tau"] / STEPS
    dmp = DMP(
        n_dims=1,
        execution_time=case["tau"],
        dt=dt,
        n_weights_per_dim=len(case["weights"]),
        int_dt=dt / INNER_STEPS,
        alpha_y=case["alpha_y"],
        beta_y=case["alpha_y"] / 4,
    )
    dmp.configure(
        start_y=np.array([case["y0"]]),
        start_yd=np.array([case["yd0"]]),
        goal_y=np.array([case["goal"]]),
    )
    dmp.set_weights(np.array(case["weights"]))
    y, yd = np.array([case["y0"]]), np.array([case["yd0"]])
    ys, yds = [y[0]], [yd[0]]
    for _ in range(STEPS):
        y, yd = dmp.step(y, yd, step_function="euler")
        ys.append(y[0])
        yds.append(yd[0])
    term = dmp.forcing_term
    return dict(
        case,
        alpha_x=term.alpha_z,
        inner_steps=INNER_STEPS,
        centres=list(term.centers),
        widths=list(term.widths),
        y=ys,
        yd=yds,
    )


def mp_pytorch_case(case):
    real = dict(dtype=torch.float64)
    alpha_x = 3.0
    phase = ExpDecayPhaseGenerator(tau=case["tau"], alpha_phase=alpha_x, **real)
    basis = NormalizedRBFBasisGenerator(
        phase, num_basis=len(case["weights"]), basis_bandwidth_factor=3, **real
    )
    dmp = TorchDmp(basis, num_dof=1, alpha=case["alpha_y"], **real)
    dmp.update_inputs(
        times=torch.linspace(0, case["tau"], STEPS + 1, **real),
        params=torch.tensor([*case["weights"], case["goal"]], **real),
        params_L=None,
        init_time=torch.tensor(0.0, **real),
        init_pos=torch.tensor([case["y0"]], **real),
        init_vel=torch.tensor([case["yd0"]], **real),
    )
    y, yd = dmp.get_traj_pos(), dmp.get_traj_vel()
    return dict(
        case,
        alpha_x=alpha_x,
        inner_steps=1,
        centres=basis.centers_p.tolist(),
        widths=(basis.bandwidth / 2).tolist(),  # psi = exp(-bandwidth d^2 / 2)
        y=y[..., 0].tolist(),
        yd=yd[..., 0].tolist(),
    )


def one_case_per_line(golden):
    def value(item):
        if isinstance(item, list):
            return "[\n" + ",\n".join("  " + json.dumps(case) for case in item) + "\n ]"
        return json.dumps(item)

    lines = [f" {json.dumps(key)}: {value(item)}" for key, item in golden.items()]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def main():
    cases = draw_cases(np.random.default_rng(SEED))
    golden = dict(
        script="tests/golden/dmp/make_golden.py",
        seed=SEED,
        versions=dict(
            python=platform.python_version(),
            **{name: version(name) for name in PACKAGES},
        ),
        movement_primitives=[movement_primitives_case(case) for case in cases],
        mp_pytorch=[mp_pytorch_case(case) for case in cases],
    )
    Path(__file__).with_name("golden.json").write_text(one_case_per_line(golden))


if __name__ == "__main__":
    main()
