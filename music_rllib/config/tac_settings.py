"""Named, validated settings of TAC. Declared once here; YAML and `TACConfig` both use them."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    model_serializer,
    model_validator,
)

from music_rllib.functional.entropy_scale import matched_alpha, normalised_alpha
from music_rllib.schedules import (
    QUANTITIES,
    AdaptiveSchedule,
    Linear,
    Measured,
    Piecewise,
    Schedule,
    bounded,
    extremes,
    value_at,
)


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


PositiveSchedule = Annotated[Schedule, bounded(">= 0", lambda alpha: alpha >= 0)]


class LearnedAlpha(_Frozen):
    """Entropy coefficient learned towards a target entropy (Haarnoja et al. 2018b, eq. 18)."""

    learned: Literal[True]
    """Says that alpha is learned."""
    initial: float = Field(0.2, gt=0)
    """Alpha at first."""
    target_entropy: float | Literal["auto"] = "auto"
    """Target for S_q of the policy. `auto`: the S_q of a density of e per action dimension, which
    is SAC's usual minus-the-number-of-dimensions at q = 1."""
    target_shannon: float | None = None
    """In place of `target_entropy`: target for the policy's Shannon entropy in nats, over all
    action dimensions. The same at every q, so that policies of different q are equally random."""
    target_width: float | None = Field(None, gt=0)
    """In place of `target_entropy`: target for the geometric mean of the policy's standard
    deviations, before tanh. The same at every q."""
    lr: float = Field(3e-4, gt=0)
    """Adam's step size for log alpha."""

    @model_validator(mode="after")
    def _one_target(self) -> Self:
        given = [
            name
            for name in ("target_entropy", "target_shannon", "target_width")
            if getattr(self, name) != type(self).model_fields[name].default
        ]
        if len(given) > 1:
            raise ValueError(f"only one target can be given, got {' and '.join(given)}")
        return self

    @model_serializer(mode="wrap")
    def _without_what_is_not_given(self, dump: Any) -> dict[str, Any]:
        """Keys of runs that use no such target are those of before there were any."""
        return {name: value for name, value in dump(self).items() if value is not None}


class MatchedAlpha(_Frozen):
    """Entropy coefficient that weighs the entropy of every q alike at a reference width."""

    value: PositiveSchedule = 0.2
    """Alpha at q = 1."""
    matched_width: float = Field(gt=0)
    """Standard deviation of the policy, before tanh, at which every q exerts the pressure
    `alpha dS_q / d ln sigma` of q = 1 (docs/comparing_q.md)."""

    def scaled(self, alpha: float, q: float, actions: int, form: str) -> float:
        """Alpha at q, for so many action dimensions."""
        return matched_alpha(alpha, q, self.matched_width, actions, form)


class NormalisedAlpha(_Frozen):
    """Entropy coefficient of S_q as a share of the largest that it can be."""

    value: PositiveSchedule = 0.2
    """Alpha at q = 1."""
    normalised: Literal[True]
    """Divides S_q by that of the uniform policy, relative to q = 1. It raises alpha for q > 1, and
    so makes the pressures on narrow policies more unequal than one alpha does."""

    def scaled(self, alpha: float, q: float, actions: int, form: str) -> float:
        """Alpha at q, for so many action dimensions."""
        return normalised_alpha(alpha, q, actions, form)


class GaussianNoise(_Frozen):
    """Behaviour of the original MUSIC: tanh(mean) plus noise, some actions uniformly random."""

    kind: Literal["gaussian_noise"]
    """Says which kind of behaviour this is."""
    std: float = Field(0.2, ge=0)
    """Standard deviation in units of the action space scaled to [-1, 1]."""
    random_share: float = Field(0.3, ge=0, le=1)
    """Share of actions drawn uniformly instead."""


_KINDS_OF_ALPHA: dict[str, type[BaseModel]] = {
    "learned": LearnedAlpha,
    "matched_width": MatchedAlpha,
    "normalised": NormalisedAlpha,
}
"""By the key that only they have."""


def _alpha_kind(value: object) -> str:
    for key, kind in _KINDS_OF_ALPHA.items():
        if (isinstance(value, dict) and key in value) or type(value) is kind:
            return key
    return "scheduled"


Alpha = Annotated[
    Annotated[PositiveSchedule, Tag("scheduled")]
    | Annotated[LearnedAlpha, Tag("learned")]
    | Annotated[MatchedAlpha, Tag("matched_width")]
    | Annotated[NormalisedAlpha, Tag("normalised")],
    Discriminator(_alpha_kind),
]
"""Entropy coefficient: a constant or a schedule, as it is or scaled for each q, or learned."""


def alpha_at(
    settings: TACSettings, q: float, env_steps: int, total_env_steps: int, actions: int
) -> float:
    """The entropy coefficient after `env_steps`; a learned one's first.

    Args:
        q: entropic index at that time.
        actions: action dimensions of the task; they count for `entropy_form: joint` only.
    """
    alpha = settings.alpha
    if isinstance(alpha, LearnedAlpha):
        return alpha.initial
    if not isinstance(alpha, MatchedAlpha | NormalisedAlpha):
        return value_at(alpha, env_steps, total_env_steps)
    value = value_at(alpha.value, env_steps, total_env_steps)
    return alpha.scaled(value, q, actions, settings.entropy_form)


def _behaviour_kind(value: object) -> str:
    return "gaussian_noise" if isinstance(value, dict | GaussianNoise) else "policy"


Behaviour = Annotated[
    Annotated[Literal["policy"], Tag("policy")] | Annotated[GaussianNoise, Tag("gaussian_noise")],
    Discriminator(_behaviour_kind),
]
"""How training episodes are acted."""


class TACSettings(_Frozen):
    """Settings of the Tsallis actor-critic (paper III-B, Fig. 3)."""

    entropic_index: Annotated[AdaptiveSchedule, bounded("> 0", lambda q: q > 0)] = 1.0
    """q of ln_q. 1 is SAC, 2 the sparse Tsallis entropy. At one `alpha` a larger q keeps policies
    broader, since its pressure grows as they narrow."""
    alpha: Alpha = 0.2
    """Entropy coefficient: a constant, a schedule, `{learned: true, ...}`, or, to compare q at
    equal pressure, `{value: ..., matched_width: ...}` (docs/comparing_q.md). Higher values explore
    longer, and slow the end of learning."""
    entropy_form: Literal["per_dimension", "joint"] = "per_dimension"
    """ln_q summed over action dimensions (the TAC authors), or of the joint density (the paper),
    whose pressure on a narrow policy grows with their number where q > 1."""
    policy: Literal["stochastic", "deterministic"] = "stochastic"
    """Squashed Gaussian, or tanh(mean) only: with `bootstrap: critics` that is DDPG."""
    bootstrap: Literal["value", "critics"] = "value"
    """What follows a transition is worth: the averaged value network (the paper), or averaged
    critics at the policy's next action (SAC with twin targets; with one critic, DDPG)."""
    policy_critic: Literal["first", "min"] = "min"
    """Which critic the policy improves on: Q1 (the TAC authors) or min(Q1, Q2) (SAC practice),
    which is less drawn to what one of them overrates."""
    hidden_sizes: tuple[Annotated[int, Field(gt=0)], ...] = Field((256, 256, 256), min_length=1)
    """Hidden layers (ReLU) of policy, value and critics. 3 x 256 takes three times as long as
    3 x 128."""
    log_std_bounds: tuple[float, float] = (-20.0, 2.0)
    """Range of the policy's log standard deviation. A higher lower end keeps noise in the actions
    until the end."""
    log_std_form: Literal["clamp", "tanh"] = "clamp"
    """How it gets there: cut off at the bounds, so that it begins near 0; or tanh, scaled to them,
    so that it begins in their middle (TAC-2020: [-20, 2], original MUSIC's SAC: [-5, 2])."""
    lr: float = Field(1e-3, gt=0)
    """Adam's step size for policy, value and critics. Larger learns sooner, or not at all."""
    gamma: float = Field(0.99, ge=0, lt=1)
    """Discount. The agent looks about 1 / (1 - gamma) steps ahead."""
    tau: float = Field(0.005, gt=0, le=1)
    """Moving-average ratio of the target networks. Larger passes values on sooner, and less
    steadily."""
    target_update_interval: int = Field(1, gt=0)
    """Gradient updates between two moves of the target networks."""
    target_bounds: tuple[float, float] | None = None
    """Critic targets are clipped to this range (original MUSIC: plus/minus 4/(1-gamma)). Values
    can't run away then; too narrow a range cuts off true ones, of which a sweep warns."""
    batch_size: int = Field(256, gt=0)
    """Transitions per update. More: less noise in each, and longer ones."""
    replay_ratio: float = Field(1.0, gt=0)
    """Gradient updates per environment step. More learns more from each step, and takes longer:
    updates are most of a run's time."""
    precision: Literal["float32", "bf16"] = "float32"
    """Of the hidden layers' products while learning; weights, outputs and acting stay float32.
    `bf16` is refused on hardware without it."""
    random_steps: int = Field(1_000, ge=0)
    """First environment steps: uniformly random actions, and no updates before they are over. More
    has seen more when learning begins, later."""
    normalise_observations: bool = True
    """Running mean and standard deviation of observations and goals in front of every network, so
    that inputs of small numbers (metres, here) count as much as large ones."""
    observation_clip: float = Field(5.0, gt=0)
    """Normalised observations are clipped to plus/minus this."""
    normaliser_epsilon: float = Field(1e-2, gt=0)
    """Smallest standard deviation that the normaliser divides by. Larger leaves what hardly varies
    small; smaller blows its noise up."""
    behaviour: Behaviour = "policy"
    """Acting during training: sample the policy, or the original MUSIC's noise."""
    action_l2: float = Field(0.0, ge=0)
    """Weight of the policy's mean squared action, in [-1, 1], in its loss (original MUSIC: 1.0).
    Higher: gentler actions, which may be too gentle to push with."""
    max_episode_steps: int | None = Field(None, gt=0)
    """Truncate episodes here; needed where the environment has no time limit of its own."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        low, high = self.log_std_bounds
        if low >= high:
            raise ValueError(f"log_std_bounds must be increasing, got {low:g}, {high:g}")
        if self.target_bounds is not None and self.target_bounds[0] >= self.target_bounds[1]:
            raise ValueError(f"target_bounds must be increasing, got {list(self.target_bounds)}")
        return self

    @model_validator(mode="after")
    def _target_fits_every_q(self) -> Self:
        if not isinstance(self.alpha, LearnedAlpha) or self.alpha.target_entropy == "auto":
            return self
        low, high = extremes(self.entropic_index)
        if low != high:
            raise ValueError(
                "alpha.target_entropy must be auto where entropic_index is a schedule (a value of "
                f"S_q means another width at each q), got {self.alpha.target_entropy:g}; "
                "target_shannon and target_width hold for every q"
            )
        return self

    @model_validator(mode="after")
    def _deterministic_is_whole(self) -> Self:
        if self.policy == "stochastic":
            return self
        if self.alpha != 0.0:
            raise ValueError(
                f"alpha must be 0 for policy: deterministic (it has no entropy), got {self.alpha}"
            )
        if self.bootstrap != "critics":
            raise ValueError("bootstrap must be 'critics' for policy: deterministic, got 'value'")
        if self.behaviour == "policy":
            raise ValueError(
                "behaviour must be gaussian_noise for policy: deterministic, which would not "
                "explore, got 'policy'"
            )
        return self


def in_words(
    value: float | Linear | Piecewise | Measured | LearnedAlpha | MatchedAlpha | NormalisedAlpha,
) -> str:
    """A constant, a schedule or a coefficient in a few characters: `1.5`, `1 to 2`, `learned`."""
    match value:
        case MatchedAlpha():
            return f"{in_words(value.value)} matched at {value.matched_width:g}"
        case NormalisedAlpha():
            return f"{in_words(value.value)} normalised"
        case Linear():
            return f"{value.start:g} to {value.end:g}"
        case Measured():
            quantity = QUANTITIES[value.follows]
            return f"{' to '.join(f'{point:g}' for _, point in value.points)} by {quantity}"
        case Piecewise():
            return " to ".join(f"{point:g}" for _, point in value.points)
        case LearnedAlpha(target_shannon=float(nats)):
            return f"learned, {nats:g} nats"
        case LearnedAlpha(target_width=float(width)):
            return f"learned, width {width:g}"
        case LearnedAlpha():
            return "learned"
        case _:
            return f"{float(value):g}"
