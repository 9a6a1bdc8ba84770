"""Named, validated settings of MUSIC (paper III-A)."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from music_rllib.schedules import AdaptiveSchedule, StrictModel, bounded


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
        if not self.task_reward and self.estimator == "none":
            raise ValueError("task_reward: false without an estimator leaves no reward at all")
        return self
