"""Named, validated settings of MUSIC (paper III-A)."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from music_rllib.schedules import AdaptiveSchedule, bounded


class MusicSettings(BaseModel):
    """The intrinsic reward, its estimator, and what the agent sees of goals and task reward."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    estimator: Literal["none", "trained", "frozen"] = "none"
    """No mutual information; an estimator trained along; or one that was handed over, unchanged."""
    mi_reward_weight: Annotated[AdaptiveSchedule, bounded(">= 0", lambda w: w >= 0)] = 0.0
    """Weight of the intrinsic reward in the reward of a minibatch. Higher moves things sooner and
    leaves them at the goal later: at 1, moving them for ever is worth as much as rest there."""
    task_reward: bool = True
    """Whether the environment's reward counts."""
    goals: Literal["environment", "zero"] = "environment"
    """Desired goals in training: the environment's, or zeros (MUSIC-u). Evaluation: always real."""
    reward_scale: float = Field(5000.0, gt=0)
    """Factor on the bound before it is clipped to [0, 1] and shifted by -1. Higher: the slightest
    influence earns the whole reward; lower: only much of it earns anything."""
    shuffle: Literal["independent", "random"] = "independent"
    """Time shuffle: every trajectory its own permutation and two frames always swapped; or, as in
    the original, one permutation for 256 rows of a minibatch, the share of one of its workers. On
    two frames it is the identity half of the time."""
    hidden_size: int = Field(128, gt=0)
    """Hidden units of the estimator. More find subtler dependences, on more data."""
    lr: float = Field(1e-3, gt=0)
    """Adam's step size for the estimator. Larger follows the policy's new behaviour sooner, and its
    reward is noisier."""
    prioritise_replay: bool = False
    """MUSIC-p: draw trajectories by the rank of their summed, clipped bounds."""
    batch_trajectories: int = Field(32, gt=0)
    """Trajectories per estimator update; one estimator update follows each policy update. More: a
    steadier bound, and longer updates."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.estimator == "none" and self.mi_reward_weight != 0.0:
            raise ValueError(
                "mi_reward_weight needs an estimator (trained or frozen), got estimator: none"
            )
        if self.prioritise_replay and self.estimator == "none":
            raise ValueError("prioritise_replay: true needs an estimator, got estimator: none")
        if not self.task_reward and self.estimator == "none":
            raise ValueError("task_reward: false without an estimator leaves no reward at all")
        return self
