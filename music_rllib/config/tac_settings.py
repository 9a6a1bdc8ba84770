"""Settings of TAC, declared once for YAML files and for `TACConfig`."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Discriminator, Field, Tag, model_serializer, model_validator

from music_rllib.functional.entropy_scale import matched_alpha, normalised_alpha
from music_rllib.intrinsic.settings import MusicSettings
from music_rllib.schedules import (
    QUANTITIES,
    AdaptiveSchedule,
    Linear,
    Measured,
    Piecewise,
    Schedule,
    StrictModel,
    bounded,
    extremes,
    value_at,
)

PositiveSchedule = Annotated[Schedule, bounded(">= 0", lambda alpha: alpha >= 0)]


class LearnedAlpha(StrictModel):
    """Entropy coefficient learned towards a target entropy (Haarnoja et al. 2018b, eq. 18)."""

    learned: Literal[True]
    """Selects a learned alpha."""
    initial: float = Field(0.2, gt=0)
    """Initial alpha."""
    target_entropy: float | Literal["auto"] = "auto"
    """Target for S_q of the policy. `auto`: the S_q of a density of e per action dimension; at
    q = 1 this is minus the number of dimensions, as usual in SAC."""
    target_shannon: float | None = None
    """Instead of `target_entropy`: target for the policy's Shannon entropy in nats, over all action
    dimensions. It is the same at every q, so that policies of different q are equally random."""
    target_width: float | None = Field(None, gt=0)
    """Instead of `target_entropy`: target for the geometric mean of the policy's standard
    deviations, before tanh. It is the same at every q."""
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
    def _without_missing_targets(self, dump: Any) -> dict[str, Any]:
        """Omit missing targets, so that runs without them keep their older node keys."""
        return {name: value for name, value in dump(self).items() if value is not None}


class MatchedAlpha(StrictModel):
    """Entropy coefficient with the same entropy pressure for every q at a reference width."""

    value: PositiveSchedule = 0.2
    """Alpha at q = 1."""
    matched_width: float = Field(gt=0)
    """Standard deviation of the policy, before tanh, at which every q has the pressure
    `alpha dS_q / d ln sigma` of q = 1 (docs/comparing_q.md)."""

    def scaled(self, alpha: float, q: float, actions: int, form: str) -> float:
        return matched_alpha(alpha, q, self.matched_width, actions, form)


class NormalisedAlpha(StrictModel):
    """Entropy coefficient of S_q as a share of its largest possible value."""

    value: PositiveSchedule = 0.2
    """Alpha at q = 1."""
    normalised: Literal[True]
    """Divides S_q by the S_q of the uniform policy, relative to q = 1. This raises alpha for q > 1,
    so that the pressures on narrow policies differ more than with one alpha."""

    def scaled(self, alpha: float, q: float, actions: int, form: str) -> float:
        return normalised_alpha(alpha, q, actions, form)


class GaussianNoise(StrictModel):
    """Behavior of the original MUSIC: tanh(mean) plus noise, with some uniformly random actions."""

    kind: Literal["gaussian_noise"]
    """The kind of behavior."""
    std: float = Field(0.2, ge=0)
    """Standard deviation in units of the action space scaled to [-1, 1]."""
    random_share: float = Field(0.3, ge=0, le=1)
    """Share of actions that are random instead (`tac.random_actions`)."""


class ColoredNoise(StrictModel):
    """Samples of the policy with noise that is correlated over the steps of an episode.

    Eberhard et al. 2023, "Pink Noise Is All You Need". Each action alone has the policy's
    distribution.
    """

    kind: Literal["colored_noise"]
    """The kind of behavior."""
    exponent: float = Field(1.0, ge=0, le=2)
    """Power of the noise over frequency f is f^-exponent: 0 is white noise, as with `policy`, 1
    pink noise, 2 Brownian noise. Higher values keep a direction for longer."""
    random_share: float = Field(0.0, ge=0, le=1)
    """Share of actions that are random instead (`tac.random_actions`)."""


def _alpha_kind(value: object) -> str | None:
    """Tag of the member of `Alpha` that `value` should be, by the key that only it has."""
    if isinstance(value, str):  # such as "auto", which other libraries have
        return None
    kinds = {"learned": LearnedAlpha, "matched_width": MatchedAlpha, "normalised": NormalisedAlpha}
    for key, kind in kinds.items():
        if (isinstance(value, dict) and key in value) or isinstance(value, kind):
            return kind.__name__
    return "Schedule"


Alpha = Annotated[
    Annotated[PositiveSchedule, Tag("Schedule")]
    | Annotated[LearnedAlpha, Tag("LearnedAlpha")]
    | Annotated[MatchedAlpha, Tag("MatchedAlpha")]
    | Annotated[NormalisedAlpha, Tag("NormalisedAlpha")],
    Discriminator(
        _alpha_kind,
        custom_error_type="alpha",
        custom_error_message="must be a number, a schedule, or {learned: true}",
    ),
]
"""Entropy coefficient: a constant or a schedule, unchanged or scaled for each q, or learned."""


def alpha_at(
    settings: TACSettings, q: float, env_steps: int, total_env_steps: int, actions: int
) -> float:
    """The entropy coefficient after `env_steps`; the initial one if it is learned.

    Args:
        q: entropic index at that time.
        actions: action dimensions of the task, used with `entropy_form: joint` only.
    """
    alpha = settings.alpha
    if isinstance(alpha, LearnedAlpha):
        return alpha.initial
    if not isinstance(alpha, MatchedAlpha | NormalisedAlpha):
        return value_at(alpha, env_steps, total_env_steps)
    value = value_at(alpha.value, env_steps, total_env_steps)
    return alpha.scaled(value, q, actions, settings.entropy_form)


def _behaviour_kind(value: object) -> str:
    kind = value.get("kind") if isinstance(value, dict) else getattr(value, "kind", None)
    if kind == "colored_noise":
        return "colored_noise"
    return "gaussian_noise" if isinstance(value, dict | GaussianNoise) else "policy"


Behaviour = Annotated[
    Annotated[Literal["policy"], Tag("policy")]
    | Annotated[GaussianNoise, Tag("gaussian_noise")]
    | Annotated[ColoredNoise, Tag("colored_noise")],
    Discriminator(_behaviour_kind),
]
"""Method of choosing actions during training."""


class TACSettings(StrictModel):
    """Settings of the Tsallis actor-critic (paper III-B, Fig. 3)."""

    entropic_index: Annotated[AdaptiveSchedule, bounded("> 0", lambda q: q > 0)] = 1.0
    """q of ln_q: 1 is SAC, 2 the sparse Tsallis entropy. At the same `alpha`, a larger q keeps
    policies broader, because its pressure grows as they narrow."""
    alpha: Alpha = 0.2
    """Entropy coefficient: a constant, a schedule, `{learned: true, ...}`, or, to compare q at
    equal pressure, `{value: ..., matched_width: ...}` (docs/comparing_q.md). Higher values explore
    longer and converge more slowly."""
    entropy_form: Literal["per_dimension", "joint"] = "per_dimension"
    """ln_q summed over action dimensions (the TAC authors), or of the joint density (the paper).
    The pressure of the joint form on a narrow policy grows with the number of dimensions if
    q > 1."""
    policy: Literal["stochastic", "deterministic"] = "stochastic"
    """Squashed Gaussian, or only tanh(mean), which is DDPG with `bootstrap: critics`."""
    bootstrap: Literal["value", "critics"] = "value"
    """Value of the next state: the target value network (the paper), or target critics at the
    policy's next action (SAC with twin targets; with one critic, DDPG)."""
    policy_critic: Literal["first", "min", "mean"] = "min"
    """Critic in the policy's loss: Q1 (the TAC authors), the smallest one (usual in SAC), which
    exploits the overestimates of one critic less, or their mean (REDQ, TQC)."""
    critics: int | None = Field(None, gt=0)
    """Number of critics. null: 2, or 1 for `policy: deterministic` (DDPG). An update's time grows
    with it."""
    target_critics: int | None = Field(None, gt=0)
    """Critics whose smallest value is used in targets, drawn at random for each update (REDQ: 2
    of 10). Fewer of them underestimate less. null: all."""
    quantiles: int = Field(0, ge=0)
    """Quantiles of the return that each critic estimates (TQC: 25). 0: critics estimate its mean.
    Needs `bootstrap: critics`."""
    dropped_quantiles: int = Field(0, ge=0)
    """Largest quantiles per critic that targets leave out (TQC: 2). Larger values overestimate
    less."""
    policy_delay: int = Field(1, gt=0)
    """Updates of the critics for each update of the policy and of a learned alpha (TD3: 2, REDQ:
    20). Larger values save time and let critics settle."""
    hidden_sizes: tuple[Annotated[int, Field(gt=0)], ...] = Field((256, 256, 256), min_length=1)
    """Hidden layers (ReLU) of policy, value and critics. 3 x 256 takes nearly four times as long as
    3 x 128."""
    layer_norm: Literal["none", "critics", "all"] = "none"
    """Layer normalization before each ReLU of the critics, or of all networks, without affine
    parameters. It bounds what critics extrapolate to new actions (RLPD), so that they stay sound
    at a higher `replay_ratio`."""
    log_std_bounds: tuple[float, float] = (-20.0, 2.0)
    """Range of the policy's log standard deviation. A higher lower bound keeps noise in the actions
    until the end."""
    log_std_form: Literal["clamp", "tanh"] = "clamp"
    """Limits log standard deviations to that range: clipped at the bounds, so that they begin near
    0; or by a tanh scaled to the bounds, so that they begin in the middle (TAC-2020: [-20, 2],
    original MUSIC's SAC: [-5, 2])."""
    lr: float = Field(1e-3, gt=0)
    """Adam's step size for policy, value and critics. Larger values learn in fewer steps, or
    diverge."""
    gamma: float = Field(0.99, ge=0, lt=1)
    """Discount factor: the horizon is about 1 / (1 - gamma) steps."""
    tau: float = Field(0.005, gt=0, le=1)
    """Moving-average ratio of the target networks. Larger values follow the networks faster and
    less smoothly."""
    target_update_interval: int = Field(1, gt=0)
    """Gradient updates between two updates of the target networks."""
    target_bounds: tuple[float, float] | None = None
    """Range to which critic targets are clipped (original MUSIC: plus/minus 4/(1-gamma)). It keeps
    values from diverging, and must contain all reachable values."""
    batch_size: int = Field(256, gt=0)
    """Transitions per update. Larger values make updates less noisy and slower."""
    replay_ratio: float = Field(1.0, gt=0)
    """Gradient updates per environment step. Larger values learn more from each step and take
    longer: updates are most of a run's time."""
    random_steps: int = Field(1_000, ge=0)
    """First environment steps, with random actions. Larger values give the first updates
    more varied data, but later."""
    random_actions: Literal["uniform", "wide"] = "uniform"
    """Distribution of these and of other random actions: uniform, or tanh of a normal number with
    standard deviation 3, which is mostly near a bound and moves farther (docs/lab/learner_screen.md
    has the effect)."""
    warmup_steps: int | None = Field(None, ge=0)
    """Environment steps before the first update, which `replay_ratio` does not count. null:
    `random_steps`. 0: updates also follow random episodes, as in TAC-2020."""
    normalise_observations: bool = True
    """Whether observations and goals are normalized by their running mean and standard deviation,
    so that small inputs count as much as large inputs."""
    observation_clip: float = Field(5.0, gt=0)
    """Normalized observations are clipped to plus/minus this value."""
    normaliser_epsilon: float = Field(1e-2, gt=0)
    """Smallest standard deviation that the normalizer divides by. Larger values keep inputs small
    that hardly vary; smaller values amplify their noise."""
    behaviour: Behaviour = "policy"
    """Actions during training: samples of the policy, with independent or correlated noise, or
    actions with the original MUSIC's noise."""
    action_l2: float = Field(0.0, ge=0)
    """Weight of the policy's mean squared action, in [-1, 1], in its loss (original MUSIC: 1.0).
    Higher values make actions smaller, possibly too small to push an object."""
    max_episode_steps: int | None = Field(None, gt=0)
    """Steps after which episodes are truncated; required if the environment has no time limit. In a
    sweep, episodes have at most the task's `horizon`, also if this is larger."""

    @property
    def critic_count(self) -> int:
        return self.critics or (1 if self.policy == "deterministic" else 2)

    @property
    def steps_before_updates(self) -> int:
        """Environment steps without updates."""
        return self.random_steps if self.warmup_steps is None else self.warmup_steps

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        low, high = self.log_std_bounds
        if low >= high:
            raise ValueError(f"log_std_bounds must be increasing, got {low:g}, {high:g}")
        if self.target_bounds is not None and self.target_bounds[0] >= self.target_bounds[1]:
            raise ValueError(f"target_bounds must be increasing, got {list(self.target_bounds)}")
        return self

    @model_validator(mode="after")
    def _critics_fit(self) -> Self:
        if self.target_critics is not None and self.target_critics > self.critic_count:
            raise ValueError(
                f"target_critics must be <= critics ({self.critic_count}), "
                f"got {self.target_critics}"
            )
        if self.quantiles and self.bootstrap == "value":
            raise ValueError(
                "bootstrap must be 'critics' with quantiles (a value network has no distribution), "
                "got 'value'"
            )
        if self.dropped_quantiles and self.dropped_quantiles >= self.quantiles:
            raise ValueError(
                f"dropped_quantiles must be < quantiles ({self.quantiles}), "
                f"got {self.dropped_quantiles}"
            )
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
        if not isinstance(self.behaviour, GaussianNoise):
            raise ValueError(
                "behaviour must be gaussian_noise for policy: deterministic, which would not "
                f"explore, got {getattr(self.behaviour, 'kind', self.behaviour)!r}"
            )
        return self


def setting_text(value: AdaptiveSchedule | Alpha) -> str:
    """Short text for a constant, a schedule or a coefficient: `1.5`, `1 to 2`, `learned`."""
    match value:
        case MatchedAlpha():
            return f"{setting_text(value.value)} matched at {value.matched_width:g}"
        case NormalisedAlpha():
            return f"{setting_text(value.value)} normalised"
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


_DIVERGED = 2.0
"""Critic means above this multiple of the reachable return count as diverged. Of 446 runs on Fetch,
one reached 13.9; all others stayed below 0.97."""


class Range(NamedTuple):
    """Smallest and largest value."""

    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.low:.4g} to {self.high:.4g}"


def reward_of_step(task: Range, music: MusicSettings) -> Range:
    """Range of a step's reward: the task's, plus an intrinsic reward in weight times [-1, 0]."""
    low, high = task if music.task_reward else Range(0.0, 0.0)
    weight = extremes(music.mi_reward_weight)[1] if music.estimator != "none" else 0.0
    return Range(low - weight, high)


def have_diverged(
    means: NDArray[np.float64], bonuses: NDArray[np.float64], reward: Range, gamma: float
) -> NDArray[np.bool_]:
    """Whether critics are above `_DIVERGED` times every reachable return.

    Args:
        means: [N] means of the critics, in the order of time.
        bonuses: [N] α S_q of the policy at the same times. Its largest absolute value so far
            counts, because it has no bound and critics follow it late.
        reward: Range of a step's reward.
        gamma: Discount.

    Returns:
        [N]; False where a mean is NaN, and before the first bonus that is not NaN.
    """
    step = max(abs(reward.low), abs(reward.high))
    reached = (step + np.fmax.accumulate(np.abs(bonuses))) / (1.0 - gamma)
    return np.asarray(np.abs(means) > _DIVERGED * reached)
