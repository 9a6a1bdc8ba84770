"""Settings of one run, and the variants that fix some of them (MUSIC, paper III-A and its code).

A *run* is one trial on one task with one seed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Any, Literal, NamedTuple, Self

from pydantic import AfterValidator, BaseModel, Field, model_validator

from music_rllib.config.tac_settings import TACSettings
from music_rllib.envs.features import Symmetry
from music_rllib.envs.tasks import Task
from music_rllib.intrinsic.settings import IntrinsicSettings, MusicSettings
from music_rllib.schedules import Schedule, StrictModel, bounded, check_measurable
from music_rllib.store.handoff import Architecture, HandoffInfo, Spaces

Variant = Literal[
    "tac", "music-u", "music-r", "music-f", "music-p", "intrinsic-u", "intrinsic-r"
]  # fmt: skip
StartsFrom = Literal["scratch", "estimator", "agent", "intrinsic"]
"""Source of a variant's network weights: nothing, a trained estimator, a trained agent, or the
networks of an intrinsic reward."""


class VariantRules(NamedTuple):
    """The settings that a variant fixes, and the source of its network weights."""

    fixed: Mapping[str, Any]
    """Fields of `MusicSettings`; a configuration that contradicts them is rejected."""
    without_effect: frozenset[str]
    """Dotted settings without effect: ignored in `defaults`, rejected in a stage."""
    starts_from: StartsFrom = "scratch"
    """The part of the run in `init_from` that is taken over."""

    @property
    def uses_mi(self) -> bool:
        """Whether it uses mutual information, which needs a task with a split."""
        return bool(self.fixed["estimator"] != "none")


_FIXED = ("estimator", "task_reward", "goals")
_OTHER_MUSIC = frozenset(f"music.{name}" for name in MusicSettings.model_fields.keys() - {*_FIXED})
_TRAINING_OF_ESTIMATOR = frozenset({"music.lr", "music.batch_trajectories"})
_N_STEPS = frozenset({"replay.n_steps"})
"""Without effect with an intrinsic reward, which is the reward of one step."""


def _fixed(estimator: str, *, task_reward: bool, goals: str = "environment") -> dict[str, Any]:
    return dict(zip(_FIXED, (estimator, task_reward, goals), strict=True))


VARIANTS: Mapping[Variant, VariantRules] = MappingProxyType(
    {
        "tac": VariantRules(
            fixed=_fixed("none", task_reward=True),
            without_effect=_OTHER_MUSIC,
        ),
        "music-u": VariantRules(
            fixed=_fixed("trained", task_reward=False, goals="zero"),
            # Hindsight would put achieved goals in place of the zeros.
            without_effect=_N_STEPS
            | {"replay.hindsight_k", "replay.hindsight_episodes", "replay.hindsight_goals"},
        ),
        "music-r": VariantRules(
            fixed=_fixed("frozen", task_reward=True),
            without_effect=_TRAINING_OF_ESTIMATOR | _N_STEPS,
            starts_from="estimator",
        ),
        "music-f": VariantRules(
            fixed=_fixed("none", task_reward=True),
            without_effect=_OTHER_MUSIC,
            starts_from="agent",
        ),
        "music-p": VariantRules(
            fixed=_fixed("frozen", task_reward=True)
            | {"mi_reward_weight": 0.0, "prioritise_replay": True},
            without_effect=_TRAINING_OF_ESTIMATOR
            | _N_STEPS
            | {"music.mi_reward_weight", "music.reward_scale"}
            # Replay is by the ranks of the trajectories.
            | {"replay.hindsight_episodes", "replay.priority"}
            | {"replay.priority_exponent", "replay.importance_exponent"},
            starts_from="estimator",
        ),
        "intrinsic-u": VariantRules(
            fixed=_fixed("none", task_reward=False),
            without_effect=_OTHER_MUSIC | _N_STEPS,
        ),
        "intrinsic-r": VariantRules(
            fixed=_fixed("none", task_reward=True),
            without_effect=_OTHER_MUSIC | _N_STEPS | {"intrinsic.lr"},
            starts_from="intrinsic",
        ),
    }
)


def variant_music(variant: Variant, task: Task) -> dict[str, Any]:
    """Fields of `MusicSettings` that the variant sets on a task, below all other layers."""
    music = dict(VARIANTS[variant].fixed)
    if variant == "music-u":
        music["mi_reward_weight"] = 1.0
    elif variant == "music-r":
        music["mi_reward_weight"] = task.mi_reward_weight
    return music


def variant_intrinsic(variant: Variant) -> dict[str, Any]:
    """Fields of `IntrinsicSettings` that the variant sets, below all other layers."""
    frozen = {"frozen": VARIANTS[variant].starts_from == "intrinsic"}
    return frozen | ({"weight": 1.0} if variant == "intrinsic-u" else {})


def contradiction(variant: Variant, fixed: Any, got: Any) -> str:
    """The rule that a setting breaks that contradicts its variant."""
    return f"must be {json.dumps(fixed)} for {variant}, got {json.dumps(got)}"


SECTIONS = ("evaluation", "tac", "music", "intrinsic", "replay")
"""Groups of settings, whose fields layers replace one by one."""
LAYER_KEYS = ("env_steps", "num_envs", *SECTIONS)
"""Keys that `defaults`, a stage, its `per_task` and a grid point can set."""

YOUNGER: tuple[tuple[str, str], ...] = (
    ("tac", "log_std_form"), ("tac", "warmup_steps"), ("tac", "layer_norm"),
    ("tac", "critics"), ("tac", "target_critics"), ("tac", "policy_delay"),
    ("tac", "quantiles"), ("tac", "dropped_quantiles"),
    ("tac", "random_actions"), ("replay", "hindsight_goals"), ("replay", "n_steps"),
    ("replay", "symmetries"),
    ("music", "bound"),
)  # fmt: skip
"""Group and name of settings that are newer than the node keys of finished runs."""


class ReplaySettings(StrictModel):
    """Size of the replay, and hindsight relabeling (Andrychowicz et al. 2017)."""

    capacity: int = Field(1_000_000, gt=0)
    """Number of transitions kept; the oldest trajectories are dropped first. A larger replay keeps
    behavior that the policy no longer shows, and needs memory: 151 bytes per FetchPush
    transition."""
    hindsight_k: float = Field(0.0, ge=0)
    """HER: k relabeled transitions for each unchanged one. 0: off. Without it, a
    policy rarely finds rewards that are given only at a goal."""
    hindsight_goals: Literal["future", "final", "episode"] = "future"
    """HER: goals of relabeled transitions are achieved later in the episode (`future`), at its end
    (`final`), or after any of its steps (`episode`)."""
    hindsight_episodes: Literal["all", "moved"] = "all"
    """HER: `all`: relabeled transitions come from all episodes. `moved`: only from episodes that
    achieve something that their first state does not (`environments.<name>.moved_distance`);
    hindsight teaches nothing about an object at rest. No episode fills more than two fifths of a
    minibatch on average."""
    symmetries: Annotated[
        tuple[Symmetry, ...], AfterValidator(lambda v: tuple(sorted(set(v))))
    ] = ()
    """Symmetries of the task (`environments.<name>.symmetries`) that multiply what each transition
    teaches: half of the drawn transitions are mirrored (`mirror`), all are moved by a random
    distance (`translate`). Learns in fewer steps (docs/algorithms.md)."""
    n_steps: int = Field(1, gt=0)
    """Steps whose rewards a critic's target adds before it bootstraps, fewer at an episode's end.
    Rewards are computed with the relabeled goal. Larger values pass rewards on faster, with a bias:
    the actions after the first one are not the policy's. 1 with an intrinsic reward."""
    priority: Literal["uniform", "td_error"] = "uniform"
    """Transitions are drawn uniformly, or by their TD error (PER, Schaul et al. 2016,
    proportional)."""
    priority_exponent: float = Field(0.6, gt=0)
    """PER: weight of the TD errors (alpha in the paper; 0 would be uniform). Higher values repeat
    surprising transitions more often, including noise."""
    importance_exponent: Annotated[Schedule, bounded("in [0, 1]", lambda b: 0 <= b <= 1)] = 0.4
    """PER: strength of the importance weights that correct its bias (beta; 1 corrects it fully)."""

    def problem(self, music: MusicSettings, intrinsic: IntrinsicSettings) -> str | None:
        """The rule that these settings break with those of intrinsic rewards."""
        if self.n_steps > 1 and (music.estimator != "none" or intrinsic.reward is not None):
            got = self.n_steps
            return f"n_steps must be 1 with an intrinsic reward, which is of one step, got {got}"
        for name, kept in (("priority", "uniform"), ("hindsight_episodes", "all")):
            if music.prioritise_replay and (got := getattr(self, name)) != kept:
                return (
                    f"{name} must be {kept} with music.prioritise_replay, got {got}: only one of "
                    "them can decide what is replayed"
                )
        return None

    @model_validator(mode="after")
    def _one_choice(self) -> Self:
        if self.hindsight_episodes == "moved" and self.priority != "uniform":
            raise ValueError(
                "hindsight_episodes must be all with priority: td_error, got moved: only one of "
                "them can decide what is replayed"
            )
        return self


class Evaluation(StrictModel):
    """Deterministic evaluation episodes during a run."""

    interval: int = Field(5_000, gt=0)
    """Environment steps between two evaluations; the end of a run is always evaluated. Smaller
    values resolve the learning curve better and take more time."""
    episodes: int = Field(20, gt=0)
    """Episodes per evaluation. The standard error of a success rate is at most
    0.5 / sqrt(episodes): 0.11 with 20."""


class RunSettings(StrictModel):
    """Everything that determines the numbers of one run, except its initial weights."""

    task: Task
    variant: Variant
    seed: int = Field(ge=0, lt=2**31)
    env_steps: int = Field(200_000, gt=0)
    """Budget: environment steps of training, over all sub-environments."""
    num_envs: int = Field(4, gt=0)
    """Sub-environments stepped together. Larger values make a step cheaper and updates of the
    policy rarer."""
    evaluation: Evaluation = Evaluation()
    tac: TACSettings = TACSettings()
    music: MusicSettings = MusicSettings()
    intrinsic: IntrinsicSettings = IntrinsicSettings()
    replay: ReplaySettings = ReplaySettings()

    @property
    def architecture(self) -> Architecture:
        """Settings that determine the shapes or the meaning of the networks' arrays."""
        return Architecture(
            hidden_sizes=self.tac.hidden_sizes,
            layer_norm=self.tac.layer_norm,
            critics=self.tac.critics,
            quantiles=self.tac.quantiles,
            policy=self.tac.policy,
            bootstrap=self.tac.bootstrap,
            normalise_observations=self.tac.normalise_observations,
            estimator_hidden_size=self.music.hidden_size,
            estimator_bound=self.music.bound,
            log_std_form=self.tac.log_std_form,
            log_std_bounds=self.tac.log_std_bounds if self.tac.log_std_form == "tanh" else None,
            intrinsic=self.intrinsic.reward and self.intrinsic.identity,
        )

    @property
    def code(self) -> str:
        """Name of the user's code that it depends on: its task, and a reward of the user's own."""
        return " with ".join((self.task.name, *self.own_modules))

    @property
    def own_modules(self) -> tuple[str, ...]:
        """The user's modules that it imports, except the environment's."""
        own = self.intrinsic.own_module
        return () if own is None else (own,)

    def handoff_info(self, node_key: str, env_steps: int, spaces: Spaces) -> HandoffInfo:
        """Describe a handoff of this run after `env_steps`."""
        return HandoffInfo(
            task=self.task,
            variant=self.variant,
            architecture=self.architecture,
            env_steps=env_steps,
            seed=self.seed,
            node_key=node_key,
            spaces=spaces,
            observation_clip=self.tac.observation_clip,
            max_episode_steps=self.tac.max_episode_steps,
        )

    def identity(self) -> dict[str, Any]:
        """Everything that determines the numbers, as plain data.

        Settings of `YOUNGER` are omitted if they have their default, and `intrinsic` without a
        reward: runs that do not use them keep the identity that they had before.
        """
        settings = self.model_dump(mode="json") | {"task": self.task.identity()}
        if self.replay.hindsight_episodes == "moved" and self.task.moved_distance is not None:
            settings["task"]["moved_distance"] = self.task.moved_distance
        settings["tac"]["precision"] = "float32"  # a removed setting
        if self.music.bound == "smile":
            settings["music"]["pairs"] = "not clipped"  # they were, until 2026-11-29
        if self.replay.symmetries:
            symmetries = self.task.symmetries.model_dump(mode="json")
            used = {kind: symmetries[kind] for kind in self.replay.symmetries}
            settings["task"]["symmetries"] = used
        if self.intrinsic.reward is None:
            del settings["intrinsic"]
        for section, name in YOUNGER:
            part: BaseModel = getattr(self, section)
            default = type(part).model_fields[name].get_default(call_default_factory=True)
            if getattr(part, name) == default:
                del settings[section][name]
        return settings

    @model_validator(mode="after")
    def _variant_holds(self) -> Self:
        rules = VARIANTS[self.variant]
        for field, value in rules.fixed.items():
            if getattr(self.music, field) != value:
                rule = contradiction(self.variant, value, getattr(self.music, field))
                raise ValueError(f"music.{field} {rule}")
        if self.variant.startswith("intrinsic-") and self.intrinsic.reward is None:
            raise ValueError(f"intrinsic.reward must be given for {self.variant}, got null")
        self.music.check_rewards(self.intrinsic)
        if self.intrinsic.frozen != (frozen := variant_intrinsic(self.variant)["frozen"]):
            rule = contradiction(self.variant, frozen, self.intrinsic.frozen)
            raise ValueError(f"intrinsic.frozen {rule}")
        moves = "intrinsic.reward displacement" * (self.intrinsic.reward == "displacement")
        if (rules.uses_mi or moves) and not self.task.has_split:
            raise ValueError(
                "task must have agent_indices and surrounding_indices for "
                f"{moves or self.variant}, "
                f"got {self.task.name!r}, which has none"
            )
        return self

    @model_validator(mode="after")
    def _followed_is_measured(self) -> Self:
        adaptive = {
            "tac.entropic_index": self.tac.entropic_index,
            "music.mi_reward_weight": self.music.mi_reward_weight,
            "intrinsic.weight": self.intrinsic.weight,
        }
        success, entropy = self.task.success_key is not None, self.tac.policy == "stochastic"
        check_measurable(adaptive, success=success, entropy=entropy)
        return self

    @model_validator(mode="after")
    def _intrinsic_reward_fits_the_replay(self) -> Self:
        if problem := self.replay.problem(self.music, self.intrinsic):
            raise ValueError(f"replay.{problem}")
        if missing := set(self.replay.symmetries) - set(self.task.symmetries.kinds):
            raise ValueError(
                f"replay.symmetries must be symmetries of the task, got {', '.join(missing)}: "
                f"{self.task.name} has {' and '.join(self.task.symmetries.kinds) or 'none'}"
            )
        return self

    @model_validator(mode="after")
    def _budget_fits(self) -> Self:
        if self.tac.steps_before_updates >= self.env_steps:
            setting = "random_steps" if self.tac.warmup_steps is None else "warmup_steps"
            raise ValueError(
                f"env_steps must be > tac.{setting} ({self.tac.steps_before_updates}), "
                f"or nothing is learned, got {self.env_steps}"
            )
        steps = min(self.tac.max_episode_steps or self.task.horizon, self.task.horizon)
        if self.replay.capacity < self.num_envs * steps:
            raise ValueError(
                "replay.capacity must hold one episode of every sub-environment "
                f"({self.num_envs} x {steps} steps), got {self.replay.capacity}"
            )
        return self


def handed_over(run: RunSettings) -> tuple[str, ...]:
    """Names of the networks whose weights `run` takes over from its source."""
    match VARIANTS[run.variant].starts_from:
        case "scratch":
            return ()
        case "estimator":
            return ("mi_estimator",)
        case "intrinsic":
            return ("intrinsic",)
    modules = ["policy", "critics"]
    modules += ["value", "value_target"] if run.tac.bootstrap == "value" else ["critics_target"]
    if run.tac.policy == "deterministic":
        modules.append("policy_target")
    if run.tac.normalise_observations:
        modules.append("normaliser")
    return tuple(modules)
