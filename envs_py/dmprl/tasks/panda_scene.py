"""Builds the scenes in which the Panda moves objects: the arm, a gripper, objects and their goals.

Sizes, masses and friction are panda-gym's, which simulates in Bullet. Bullet multiplies the
friction coefficients of two bodies (0.5 for most, 1.0 for the fingertips), MuJoCo takes the larger
one; the coefficients below give the same result for each pair that touches.

Contacts are stiffer than MuJoCo's default, so that cubes stack and are gripped without sinking in.
Friction cones are elliptic and ``impratio`` is above 1, because a gripped cube otherwise slips.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import mujoco

MODEL = Path(__file__).parent / "models" / "panda.xml"
FINGER_FRICTION, CUBE_FRICTION, PUCK_FRICTION = 0.5, 0.25, 0.022
FINGER_OPENING = 0.04
"""Largest distance of a finger from the middle of the gripper [m]."""
FINGER_SERVO = {"kp": 5000.0, "kv": 100.0}
"""Gains of a finger [N/m, N s/m]. As for the arm, the speed is 50/s times the position error. Its
target is within the finger's range, so the force on a gripped cube is at most 100 N."""
FINGER_ARMATURE = 0.5
"""Inertia of a finger's drive [kg]. A lighter finger would sink into what it grips."""
OBJECT_CONTACT = {"solref": [0.005, 1.0], "solimp": [0.95, 0.99, 0.001, 0.5, 2.0]}
GREEN, BLUE = (0.1, 0.8, 0.1), (0.15, 0.25, 0.9)
GOAL_ALPHA = 0.3


class MovedObject(NamedTuple):
    """An object on the table, and its goal, which looks like it."""

    shape: mujoco.mjtGeom
    size: tuple[float, float, float]
    """Half the lengths of a box; radius and half the height of a cylinder [m]."""
    mass: float
    """[kg]"""
    friction: float
    """Friction with the table."""
    colour: tuple[float, float, float] = GREEN

    @property
    def start_height(self) -> float:
        """Height of the centre at the start and at the goal [m].

        As in panda-gym, a puck starts 15 mm too high, and its goal remains there.
        """
        return max(self.size)


class Scene(NamedTuple):
    """Everything but the arm."""

    objects: tuple[MovedObject, ...]
    table_x: tuple[float, float] = (-0.85, 0.25)
    """Edges of the table [m]."""
    has_edges: bool = True
    """Whether objects can fall off the table. Without edges it is a plane, on which a cylinder
    slides without trembling, and MuJoCo's search for several contacts of convex shapes, which
    gives a cylinder at the corner of a box the normal of a face, is not needed."""
    has_gripper: bool = False
    """Whether the fingers move; otherwise they stay closed."""
    finger_friction: float = FINGER_FRICTION
    """Friction of the fingers with an object."""


def cube(mass: float = 1.0, colour: tuple[float, float, float] = GREEN) -> MovedObject:
    """Returns a cube with an edge of 4 cm."""
    return MovedObject(mujoco.mjtGeom.mjGEOM_BOX, (0.02, 0.02, 0.02), mass, CUBE_FRICTION, colour)


def puck() -> MovedObject:
    """Returns a cylinder with a diameter of 6 cm and a height of 3 cm.

    In panda-gym its friction is 0.02, and Bullet damps moving bodies. Together they slow the puck
    by 0.22 m/s².
    """
    size = (0.03, 0.015, 0.0)
    return MovedObject(mujoco.mjtGeom.mjGEOM_CYLINDER, size, 1.0, PUCK_FRICTION)


def scene_model(scene: Scene, with_decoration: bool) -> mujoco.MjModel:
    """Compiles a scene; geoms without contacts only matter in pictures."""
    spec = mujoco.MjSpec.from_file(str(MODEL))
    spec.compiler.discardvisual = not with_decoration
    option = spec.option
    option.gravity = [0.0, 0.0, -9.81]
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10.0
    _compensate_gravity(spec)
    if scene.has_gripper:
        _add_fingers(spec)
    _set_table(spec, scene)
    if not scene.has_edges:
        option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD.value
        if not with_decoration:
            table = spec.geom("table")
            table.type, table.pos[2] = mujoco.mjtGeom.mjGEOM_PLANE, 0.0
    spec.delete(spec.body("goal"))
    for index, moved in enumerate(scene.objects):
        _add_object(spec, f"object{index + 1}" if len(scene.objects) > 1 else "object", moved)
    return spec.compile()


def _compensate_gravity(spec: mujoco.MjSpec) -> None:
    for body in spec.bodies:
        if body.mass > 0.0:
            body.gravcomp = 1.0


def _add_fingers(spec: mujoco.MjSpec) -> None:
    """Replaces the closed fingers by two that slide along the hand's y axis."""
    closed = spec.body("fingers")
    position, half = closed.pos, closed.geoms[0].size / [1.0, 2.0, 1.0]
    height = closed.geoms[0].pos[2]
    spec.delete(closed)
    for name, side in (("finger1", 1.0), ("finger2", -1.0)):
        finger = spec.body("hand").add_body(
            name=name,
            pos=position,
            mass=0.1,
            ipos=[0.0, side * 0.01, 0.02],
            inertia=[4.2e-5, 3.9e-5, 1.7e-5],
            explicitinertial=True,
            gravcomp=1.0,
        )
        finger.add_joint(
            name=name,
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=[0.0, side, 0.0],
            range=[0.0, FINGER_OPENING],
            limited=True,
            armature=FINGER_ARMATURE,
        )
        finger.add_geom(
            spec.find_default("touching"),
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[0.0, side * half[1], height],
            size=half,
            material="joint",
        )
        servo = spec.add_actuator(
            name=name,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            ctrllimited=True,
            ctrlrange=[0.0, FINGER_OPENING],
        )
        servo.set_to_position(**FINGER_SERVO)


def _set_table(spec: mujoco.MjSpec, scene: Scene) -> None:
    table, (left, right) = spec.geom("table"), scene.table_x
    table.pos[0], table.size[0] = (left + right) / 2, (right - left) / 2
    fingers = {"fingers", "finger1", "finger2"}
    least = min(moved.friction for moved in scene.objects)
    for geom in spec.geoms:
        geom.friction[0] = scene.finger_friction if geom.name in fingers else least


def _add_object(spec: mujoco.MjSpec, name: str, moved: MovedObject) -> None:
    look = {"type": moved.shape, "size": moved.size, "group": 1}
    goal = spec.worldbody.add_body(name=name.replace("object", "goal"), mocap=True)
    goal.add_geom(**look, rgba=[*moved.colour, GOAL_ALPHA], contype=0, conaffinity=0, mass=0.0)
    body = spec.worldbody.add_body(name=name, pos=[0.0, 0.0, moved.size[-1]])
    body.add_freejoint(name=name)
    body.add_geom(
        **look,
        **OBJECT_CONTACT,
        name=name,
        mass=moved.mass,
        rgba=[*moved.colour, 1.0],
        contype=1,
        conaffinity=1,
        friction=[moved.friction, 0.001, 0.0001],
    )
    for sensor in (mujoco.mjtSensor.mjSENS_FRAMELINVEL, mujoco.mjtSensor.mjSENS_FRAMEANGVEL):
        spec.add_sensor(type=sensor, objtype=mujoco.mjtObj.mjOBJ_XBODY, objname=name)
