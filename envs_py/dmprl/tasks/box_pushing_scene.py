"""Builds the scene of box pushing: the Panda with a rod, and an open box on a table.

Positions, sizes, masses, inertias, friction, and limits of joints and torques are fancy-gym's, so
that the same torques move the arm alike. The shapes that collide are our Panda's.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco

from dmprl.tasks.panda_scene import MODEL

TABLE_HEIGHT = -0.019
"""Height of the table's surface [m]; the origin is the arm's base."""
ROD_TIP = (0.0, 0.0, 0.2)
"""The point of the rod whose distance to the box is rewarded, in the hand's frame [m]."""
TORQUE_MAX = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
"""[N m]"""
JOINT_RANGES = (
    (-2.9671, 2.9671),
    (-1.8326, 1.8326),
    (-2.9671, 2.9671),
    (-3.1416, 0.0873),
    (-2.9671, 2.9671),
    (-0.0873, 3.8223),
    (-2.9671, 2.9671),
)
"""Angles at which the simulation stops a joint [rad]. The reward has narrower limits."""


class Inertial(NamedTuple):
    """Mass [kg], centre of mass [m] and principal inertias [kg m²] of a body, and their axes."""

    mass: float
    position: tuple[float, float, float]
    inertia: tuple[float, float, float]
    axes: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


LINKS = (
    Inertial(
        2.77281,
        (1.1399e-05, -0.0312655, -0.0693733),
        (0.0164224, 0.0153969, 0.00546286),
        (0.98466, 0.174481, -0.000101815, 0.000347662),
    ),
    Inertial(
        2.7996,
        (-1.31766e-05, -0.0703216, 0.0311782),
        (0.016787, 0.0157415, 0.00553027),
        (0.57484, 0.818266, -6.05764e-05, -6.61626e-05),
    ),
    Inertial(
        2.14603,
        (0.0443483, 0.0249283, -0.03813),
        (0.00915257, 0.00896477, 0.00384742),
        (0.0615263, 0.349824, 0.234291, 0.904956),
    ),
    Inertial(
        2.18807,
        (-0.0385503, 0.0395256, 0.0247162),
        (0.00946899, 0.00928491, 0.00396694),
        (0.813566, 0.465041, 0.309792, 0.160858),
    ),
    Inertial(
        3.19545,
        (-6.36776e-05, 0.0384124, -0.10997),
        (0.0278873, 0.0268823, 0.00569569),
        (0.990767, -0.135571, 0.000963106, 0.000694406),
    ),
    Inertial(
        1.35761,
        (0.0510023, 0.00693267, 0.00616899),
        (0.00412168, 0.0033698, 0.00213304),
        (-0.0460841, 0.754362, 0.044494, 0.653325),
    ),
    Inertial(
        0.417345,
        (0.0103614, 0.0103596, 0.0791078),
        (0.000637671, 0.000528056, 0.000279577),
        (0.63547, 0.278021, -0.670462, 0.263369),
    ),
)
"""The seven links."""
HAND = Inertial(
    0.670782,
    (-2.76618e-06, -0.00061547, 0.0239295),
    (0.00227632, 0.00206087, 0.000456542),
    (0.697945, 0.716151, -0.000242485, 8.47563e-05),
)
FLANGE = Inertial(0.1, (0.0, 0.0, 0.0), (0.1, 0.1, 0.1))
"""Its inertia dominates that of the last joints; without it they would turn far faster."""
FINGERS = (
    Inertial(0.0218754, (0.0, 0.0119585, 0.0821816), (5.69661e-06, 5.56035e-06, 1.55183e-06)),
    Inertial(0.0218754, (0.0, -0.0119585, 0.0821816), (5.69661e-06, 5.56035e-06, 1.55183e-06)),
    Inertial(0.01, (0.0, 0.0085, 0.1144), (0.01, 0.01, 0.01)),
    Inertial(0.01, (0.0, -0.0085, 0.1144), (0.01, 0.01, 0.01)),
)
"""Fingers and their tips, in the hand's frame. They stay closed and touch nothing."""

WALLS = (
    ((0.05, 0.0, 0.0485), (0.005, 0.05, 0.045)),
    ((0.0, 0.05, 0.0485), (0.05, 0.005, 0.045)),
    ((-0.05, 0.0, 0.0485), (0.005, 0.05, 0.045)),
    ((0.0, -0.05, 0.0485), (0.05, 0.005, 0.045)),
)
"""Centre and half the edges of each of the box's walls [m]. The first has another colour."""
BOTTOM_SIZE, BOTTOM_MASS, BOTTOM_FRICTION = (0.05, 0.05, 0.01), 2.0, 0.3
WALL_MASS = 0.001
RED, BLUE, YELLOW = (0.85, 0.15, 0.1), (0.15, 0.25, 0.9), (0.95, 0.8, 0.1)


def box_pushing_model(with_decoration: bool) -> mujoco.MjModel:
    """Compiles the scene; geoms without contacts only matter in pictures."""
    spec = mujoco.MjSpec.from_file(str(MODEL))
    spec.compiler.discardvisual = not with_decoration
    option = spec.option
    option.gravity = [0.0, 0.0, -9.81]
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 3.0
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    _replace_gripper(spec)
    _set_arm(spec)
    _set_table(spec, with_decoration)
    spec.delete(spec.body("goal"))
    goal = spec.worldbody.add_body(name="goal", mocap=True)
    _add_box(goal, YELLOW, alpha=0.3)
    body = spec.worldbody.add_body(name="box")
    body.add_freejoint(name="box")
    _add_box(body, RED, alpha=1.0, contype=1, conaffinity=1)
    return spec.compile()


def _replace_gripper(spec: mujoco.MjSpec) -> None:
    spec.delete(spec.body("fingers"))
    hand = spec.body("hand")
    _set_inertial(hand, HAND)
    for part in (FLANGE, *FINGERS):
        _set_inertial(hand.add_body(), part)
    hand.add_body().add_geom(
        spec.find_default("touching"),
        name="rod",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        pos=[0.0, 0.0, 0.075],
        size=[0.01, 0.15, 0.0],
        density=1000.0,
        material="joint",
    )
    spec.site("ee").pos = ROD_TIP
    spec.delete(spec.sensor("ee_velocity"))


def _set_inertial(body: mujoco.MjsBody, inertial: Inertial) -> None:
    body.explicitinertial = True
    body.mass, body.ipos = inertial.mass, inertial.position
    body.inertia, body.iquat = inertial.inertia, inertial.axes


def _set_arm(spec: mujoco.MjSpec) -> None:
    spec.body("link0").pos = [0.0, 0.0, 0.0]
    for index, (inertial, limits, torque) in enumerate(
        zip(LINKS, JOINT_RANGES, TORQUE_MAX, strict=True), 1
    ):
        _set_inertial(spec.body(f"link{index}"), inertial)
        spec.joint(f"joint{index}").range = limits
        motor = spec.actuator(f"servo{index}")
        motor.set_to_motor()
        motor.inheritrange = 0.0
        motor.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
        motor.forcerange = [-torque, torque]


def _set_table(spec: mujoco.MjSpec, with_decoration: bool) -> None:
    """Makes the table a plane, because the box cannot reach its edges, except in pictures."""
    table = spec.geom("table")
    table.pos, table.size = [0.2, 0.0, TABLE_HEIGHT - 0.2], [1.0, 0.98, 0.2]
    table.solref, table.solimp = [0.002, 1.0], [0.999, 0.999, 0.001, 0.5, 2.0]
    spec.geom("floor").pos[2] = TABLE_HEIGHT - 0.4
    if not with_decoration:
        table.type, table.pos[2] = mujoco.mjtGeom.mjGEOM_PLANE, TABLE_HEIGHT
        spec.delete(spec.geom("floor"))


def _add_box(
    body: mujoco.MjsBody,
    colour: tuple[float, float, float],
    alpha: float,
    contype: int = 0,
    conaffinity: int = 0,
) -> None:
    shared = {
        "type": mujoco.mjtGeom.mjGEOM_BOX,
        "contype": contype,
        "conaffinity": conaffinity,
        "group": 1,
    }
    body.add_geom(
        **shared,
        size=BOTTOM_SIZE,
        mass=BOTTOM_MASS,
        # Because of its priority, the bottom's friction holds for all of its contacts.
        friction=[BOTTOM_FRICTION, 0.001, 0.0001],
        priority=1,
        rgba=[*colour, alpha],
    )
    for index, (position, size) in enumerate(WALLS):
        rgba = [*(colour if index else BLUE), alpha]
        body.add_geom(**shared, pos=position, size=size, mass=WALL_MASS, rgba=rgba)
