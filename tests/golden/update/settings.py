"""Settings and sizes of a golden case or a benchmark."""

from dataclasses import dataclass, fields


@dataclass(frozen=True)
class Start:
    """Indices of one dimension's y0 and yd0 in an observation.

    y0 = atan2(observation[sin], observation[cos]), or scale * observation[index].
    """

    velocity: int
    cos: int | None = None
    sin: int | None = None
    index: int | None = None
    scale: float = 1.0


@dataclass(frozen=True)
class Settings:
    """The values that an update depends on."""

    algorithm: str
    policy: str
    observation_len: int  # the environment's, without the state (y, yd)
    action_len: int
    control_dt_s: float
    start_sources: tuple[Start, ...] = ()
    batch_size: int = 256
    hidden: tuple[int, ...] = (256, 256)
    critic_hidden: tuple[int, ...] = (256, 256)
    critic_layer_norm: bool = False  # of TQC only, as the next one
    critics: int = 2
    segment_steps: int = 5
    critic: str = "segment"
    start: str = "zero"
    start_velocity: str = "measured"
    goal_range: float = 1.0
    weight_range: float = 1.0
    controller: str = "inverse"
    position_scale: float = 1.0
    rho_range: float = 2.0
    basis_count: int = 5
    alpha_x: float = 1.0
    alpha_y: float = 10.0
    integration_steps: int = 40
    integrator: str = "semi_implicit"
    forcing_scaling: str = "none"
    critic_learning_rate: float = 3e-4
    actor_learning_rate: float = 5e-4
    polyak: float = 5e-3

    @staticmethod
    def from_dict(values):
        """Reads the JSON object of a benchmark; rejects unknown keys."""
        known = {item.name for item in fields(Settings)}
        assert set(values) <= known, f"unknown settings: {sorted(set(values) - known)}"
        values = {key: tuple(v) if isinstance(v, list) else v for key, v in values.items()}
        starts = values.get("start_sources", ())
        return Settings(**{**values, "start_sources": tuple(Start(**start) for start in starts)})

    @property
    def steps(self):
        """K: one step for `mlp`."""
        return 1 if self.policy == "mlp" else self.segment_steps

    @property
    def carries(self):
        """Whether the DMP's (y, yd) belong to the observation."""
        return self.policy == "dmp" and self.start == "carry"

    @property
    def policy_observation_len(self):
        """O, with the state of the DMP or of the last actions."""
        has_state = self.carries or self.start == "action"
        return self.observation_len + (2 * self.action_len if has_state else 0)

    @property
    def critic_action_len(self):
        """The part of a segment's actions and end state in the critic's input."""
        if self.critic == "first":
            return self.action_len
        return self.steps * self.action_len + (2 * self.action_len if self.carries else 0)

    @property
    def omega(self):
        """Natural frequency of the critically damped transformation system."""
        return self.alpha_y / 2
