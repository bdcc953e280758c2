"""Draws a MuJoCo model anew for each episode (``task.randomise``), for policies of a real robot.

Each factor multiplies the model's own value, so the model is unchanged if all factors are 1. The
draws come from a stream of their own: an environment starts the same episodes with and without
them.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from dmprl.env_options import Randomise, RandomiseError

STREAM = 1
"""Separates the stream of these draws from others of the same seed."""
UNSCALABLE = (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_SDF)
"""Geoms whose size is not in ``geom_size``."""

CHANGED = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_pos",
    "bvh_aabb",
    "geom_friction",
    "geom_size",
    "geom_pos",
    "geom_rbound",
    "geom_aabb",
    "pair_friction",
    "dof_damping",
    "actuator_biasprm",
)
"""Fields that a :class:`ModelRandomiser` writes."""


class ModelRandomiser:
    """Changes one environment's model at the start of each episode.

    - ``name``: the environment, for errors.
    - ``derive``: recomputes the constants of the model after a change, such as inverse weights; it
      may overwrite its second argument.

    Raises:
        RandomiseError: if a key of ``ranges`` cannot be applied to the model.
    """

    def __init__(
        self,
        name: str,
        ranges: Randomise,
        model: mujoco.MjModel,
        derive: Callable[[mujoco.MjModel, mujoco.MjData], None] = mujoco.mj_setConst,
    ) -> None:
        self._name, self._ranges, self._model, self._derive = name, ranges, model, derive
        self._data = mujoco.MjData(model)
        self._rng = np.random.default_rng()
        self._objects = objects_of(model)
        # Bodies and geoms of each object.
        self._bodies = [model.body_rootid == body for body in self._objects]
        self._geoms = [mask[model.geom_bodyid] for mask in self._bodies]
        self._servos = position_servos(model)
        self._nominal = {field: getattr(model, field).copy() for field in CHANGED}
        self._bottoms = [self._bottom(geoms) for geoms in self._geoms]
        self._check()

    def _check(self) -> None:
        model, objects = self._model, self._objects
        disabled = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT.value
        collides = not disabled and np.any(model.geom_contype | model.geom_conaffinity)
        damped = np.any(model.dof_damping) or self._servos.size
        meshes = [np.isin(model.geom_type[geoms], UNSCALABLE).any() for geoms in self._geoms]
        no_object = "" if objects.size else "its model has no object, which is a free body"
        for key, reason in (
            ("friction", "" if collides else "its model has no contacts"),
            ("damping", "" if damped else "no joint of its model is damped"),
            ("object_size", no_object or ("an object of it is a mesh" if any(meshes) else "")),
            ("start_pose", no_object),
        ):
            if reason and self._ranges.changes(key):
                raise RandomiseError.of(key, self._name, reason)

    def seed(self, seed: int) -> None:
        """Starts the stream of draws anew."""
        self._rng = np.random.default_rng([STREAM, seed])

    def draw(self) -> None:
        """Draws the model of an episode."""
        model, nominal, ranges = self._model, self._nominal, self._ranges
        # Always all of them, so that the draws of a key do not depend on the others.
        mass = self._rng.uniform(*ranges.mass, model.nbody)
        friction = self._rng.uniform(*ranges.friction)
        damping = self._rng.uniform(*ranges.damping, model.njnt)
        sizes = self._rng.uniform(*ranges.object_size, len(self._objects))
        self._offsets = self._rng.uniform(*ranges.start_pose, (len(self._objects), 2))
        self._sizes = sizes
        model.body_mass[:] = nominal["body_mass"] * mass
        model.body_inertia[:] = nominal["body_inertia"] * mass[:, None]
        model.geom_friction[:] = nominal["geom_friction"] * friction
        model.pair_friction[:] = nominal["pair_friction"] * friction
        model.dof_damping[:] = nominal["dof_damping"] * damping[model.dof_jntid]
        servos = self._servos
        servo_factors = damping[model.actuator_trnid[servos, 0]]
        model.actuator_biasprm[servos, 2] = nominal["actuator_biasprm"][servos, 2] * servo_factors
        for index, size in enumerate(sizes):
            self._resize(index, size)
        self._derive(model, self._data)

    def _resize(self, index: int, size: float) -> None:
        """Scales an object about the origin of its body."""
        model, nominal, bodies = self._model, self._nominal, self._bodies[index]
        for field in ("geom_size", "geom_pos", "geom_rbound", "geom_aabb"):
            getattr(model, field)[self._geoms[index]] = nominal[field][self._geoms[index]] * size
        model.body_ipos[bodies] = nominal["body_ipos"][bodies] * size
        model.body_inertia[bodies] *= size**2
        children = bodies.copy()
        children[self._objects[index]] = False
        model.body_pos[children] = nominal["body_pos"][children] * size
        for body in np.flatnonzero(bodies):
            first = model.body_bvhadr[body]
            boxes = slice(first, first + model.body_bvhnum[body])
            model.bvh_aabb[boxes] = nominal["bvh_aabb"][boxes] * size

    @property
    def moves_objects(self) -> bool:
        """Whether :meth:`place` changes a state."""
        return self._ranges.changes("object_size") or self._ranges.changes("start_pose")

    def place(self, qpos: NDArray[np.float64]) -> None:
        """Moves the objects of a start state, after :meth:`draw`.

        A larger object starts higher, so that it does not start in the table.
        """
        if not self.moves_objects:
            return
        for index, body in enumerate(self._objects):
            first = self._model.jnt_qposadr[self._model.body_jntadr[body]]
            qpos[first : first + 2] += self._offsets[index]
            qpos[first + 2] -= (self._sizes[index] - 1.0) * self._bottoms[index]

    def _bottom(self, geoms: NDArray[np.bool_]) -> float:
        """Returns the lowest point of an upright object, relative to its body [m]."""
        model, lowest = self._model, 0.0
        for geom in np.flatnonzero(geoms):
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
            up = rotation[6:]
            centre, half = np.split(model.geom_aabb[geom], 2)
            lowest = min(lowest, model.geom_pos[geom, 2] + up @ centre - np.abs(up) @ half)
        return lowest


def objects_of(model: mujoco.MjModel) -> NDArray[np.intp]:
    """Finds the bodies that move freely, can be touched and are no robot: they have no joints."""
    touchable = (model.geom_contype | model.geom_conaffinity) != 0

    def is_object(body: int) -> bool:
        own = model.body_rootid == body
        return (
            model.body_jntnum[body] == 1
            and model.jnt_type[model.body_jntadr[body]] == mujoco.mjtJoint.mjJNT_FREE.value
            and model.body_jntnum[own].sum() == 1
            and touchable[own[model.geom_bodyid]].any()
        )

    return np.array([body for body in range(1, model.nbody) if is_object(body)], np.intp)


def position_servos(model: mujoco.MjModel) -> NDArray[np.intp]:
    """Finds the actuators of joints whose servo has a gain on position, and one on velocity."""
    on_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT.value
    affine = model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE.value
    gains = (model.actuator_biasprm[:, 1:3] != 0.0).all(axis=1)
    return np.flatnonzero(on_joint & affine & gains)


def randomise_batch(env: object, ranges: Randomise) -> None:
    """Randomises the environments of a batch.

    Raises:
        RandomiseError: if a key cannot be applied, as to a user's own ``SegmentEnv``.
    """
    from dmprl.mujoco_batch import BatchSegmentEnv  # that module imports this one

    if not isinstance(env, BatchSegmentEnv):
        name, reason = env.spec()["id"], "it is a SegmentEnv, whose model is its own"
        raise RandomiseError.of(ranges.of_model(), name, reason)
    env.randomise(ranges)
