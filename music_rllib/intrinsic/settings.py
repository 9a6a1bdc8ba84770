"""Named, validated settings of MUSIC (paper III-A) and of other intrinsic rewards."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from music_rllib.schedules import AdaptiveSchedule, Plain, StrictModel, bounded

BUILT_IN: Mapping[str, str] = MappingProxyType(
    {
        "displacement": "music_rllib.intrinsic.baselines:Displacement",
        "random": "music_rllib.intrinsic.baselines:RandomBonus",
        "rnd": "music_rllib.intrinsic.novelty:RND",
        "icm": "music_rllib.intrinsic.novelty:ICM",
        "disagreement": "music_rllib.intrinsic.novelty:Disagreement",
        "e3b": "music_rllib.intrinsic.novelty:E3B",
        "diayn": "music_rllib.intrinsic.skills:DIAYN",
        "discern": "music_rllib.intrinsic.skills:DISCERN",
    }
)
"""Values of `intrinsic.reward` and the classes that they stand for."""
SETTINGS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "rnd": ("hidden", "features"),
        "icm": ("hidden", "features"),
        "disagreement": ("models", "hidden"),
        "e3b": ("hidden", "features", "ridge"),
        "diayn": ("skills", "hidden"),
        "discern": ("hidden", "features", "beta"),
    }
)
"""Keyword arguments of these classes, which are numbers; reading them there would load PyTorch."""
COUNTS: Mapping[str, int] = MappingProxyType({"hidden": 1, "features": 1, "models": 2, "skills": 2})
"""Those that are whole numbers, and their smallest values."""
OF_GOALS = frozenset({"diayn", "discern"})
"""Rewards that are constant if all goals are equal."""


def _known_reward(name: str) -> str:
    module, colon, attribute = name.partition(":")
    parts = [*module.split("."), attribute]
    if name not in BUILT_IN and not (colon and all(map(str.isidentifier, parts))):
        known = ", ".join(BUILT_IN)
        raise ValueError(f"must be {known}, or module:Class of your own, got {name!r}")
    return name


class IntrinsicSettings(StrictModel):
    """An intrinsic reward that is added to all others (docs/intrinsic_rewards.md)."""

    reward: Annotated[str, AfterValidator(_known_reward)] | None = None
    """Name of a built-in reward, or `module:Class` of your own; null: none. Built in:
    displacement, random, rnd, icm, disagreement, e3b, diayn, discern."""
    weight: Annotated[AdaptiveSchedule, bounded(">= 0", lambda w: w >= 0)] = 0.1
    """Weight of the reward, which lies in [-1, 0]. A schedule that ends at 0 leaves the optimum of
    the task unchanged at the end. 1 for intrinsic-u."""
    lr: float = Field(1e-3, gt=0)
    """Adam's step size for its networks, which take a step at every fourth update."""
    settings: dict[str, Plain] = Field(default_factory=dict)
    """Keyword arguments of its class, such as `{hidden: 128}`."""
    frozen: bool = False
    """Whether its networks are of another run and not trained; fixed by the variant."""

    @model_validator(mode="after")
    def _settings_of_the_class(self) -> Self:
        if self.reward is not None and self.reward in BUILT_IN:
            known = SETTINGS.get(self.reward, ())
            for name, value in self.settings.items():
                if name not in known:
                    raise ValueError(
                        f"settings of {self.reward} must be among: {', '.join(known) or 'none'}; "
                        f"got {name!r}"
                    )
                if (
                    isinstance(value, bool)
                    or not isinstance(value, int | float)
                    or not 0 < value < math.inf
                ):
                    raise ValueError(f"settings.{name} must be a number > 0, got {value!r}")
                if name in COUNTS:
                    least = COUNTS[name]
                    if value < least or value != int(value):
                        raise ValueError(
                            f"settings.{name} must be a whole number >= {least}, got {value!r}"
                        )
                    self.settings[name] = int(value)  # 1e2 is 100
        return self

    @property
    def identity(self) -> str:
        """The reward and its own settings as text: what determines the shapes of its networks."""
        return f"{self.reward} {json.dumps(self.settings, sort_keys=True)}"

    @property
    def own_module(self) -> str | None:
        """The user's module that it imports."""
        own = self.reward is not None and self.reward not in BUILT_IN
        return str(self.reward).partition(":")[0] if own else None


class MusicSettings(StrictModel):
    """The intrinsic reward, its estimator, and whether goals and task reward are visible."""

    estimator: Literal["none", "trained", "frozen"] = "none"
    """`none`: no mutual information; `trained`: an estimator trained with the policy; `frozen`: an
    estimator of another run, unchanged."""
    mi_reward_weight: Annotated[AdaptiveSchedule, bounded(">= 0", lambda w: w >= 0)] = 0.0
    """Weight of the intrinsic reward in the reward of a minibatch. With a higher weight, objects
    are moved sooner and rest at the goal later: at 1, endless movement is worth as much as rest at
    the goal."""
    task_reward: bool = True
    """Whether the environment's reward counts."""
    goals: Literal["environment", "zero"] = "environment"
    """Desired goals in training: the environment's, or zeros (MUSIC-u). Evaluation always uses the
    environment's."""
    bound: Literal["capped", "moving_average", "nwj", "infonce", "smile"] = "capped"
    """Bound on the information that the estimator increases. `capped`: Donsker-Varadhan with
    statistics in [-1, 1], as in the original; the others have no cap: Donsker-Varadhan with a
    moving average in its gradient (MINE), NWJ, InfoNCE with 5 shuffled pairs, and SMILE."""
    reward_scale: float = Field(5000.0, gt=0)
    """Factor of the bound before it is clipped to [0, 1] and shifted by -1. Higher: the smallest
    influence earns the whole reward; lower: only a large influence earns any."""
    shuffle: Literal["independent", "random"] = "independent"
    """Time shuffle. `independent`: each trajectory has its own permutation, and two frames are
    always swapped. `random`: as in the original, one permutation for 256 rows of a minibatch, the
    share of one of its workers. For two frames it is the identity half of the time."""
    hidden_size: int = Field(128, gt=0)
    """Hidden units of the estimator. More units find subtler dependencies, with more data."""
    lr: float = Field(1e-3, gt=0)
    """Adam's step size for the estimator. A larger one follows new behavior of the policy sooner,
    and makes the reward noisier."""
    prioritise_replay: bool = False
    """MUSIC-p: draw trajectories by the rank of their summed, clipped bounds."""
    batch_trajectories: int = Field(32, gt=0)
    """Trajectories per estimator update; each policy update is followed by one. More trajectories
    make the bound less noisy and updates slower."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.estimator == "none" and self.mi_reward_weight != 0.0:
            raise ValueError(
                "mi_reward_weight needs an estimator (trained or frozen), got estimator: none"
            )
        if self.prioritise_replay and self.estimator == "none":
            raise ValueError("prioritise_replay: true needs an estimator, got estimator: none")
        return self

    def check_rewards(self, intrinsic: IntrinsicSettings) -> None:
        """Raise ValueError without any reward, and for a reward about goals that are all zeros."""
        if self.goals == "zero" and intrinsic.reward in OF_GOALS:
            raise ValueError(
                f"goals: zero (music-u) leaves nothing to intrinsic.reward {intrinsic.reward}, "
                "which is about goals; give it to other stages only"
            )
        if not self.task_reward and self.estimator == "none" and intrinsic.reward is None:
            raise ValueError("task_reward: false without an estimator leaves no reward at all")
