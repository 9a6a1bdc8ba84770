"""Named, validated settings of the trajectory replay."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from music_rllib.schedules import Schedule, StrictModel, bounded


class ReplaySettings(StrictModel):
    """Size of the replay, and hindsight relabeling (Andrychowicz et al. 2017)."""

    capacity: int = Field(1_000_000, gt=0)
    """Number of transitions kept; the oldest trajectories are dropped first. A larger replay keeps
    behavior that the policy no longer shows, and needs memory: 151 bytes per FetchPush
    transition."""
    hindsight_k: float = Field(0.0, ge=0)
    """HER, `future` strategy: k relabeled transitions for each unchanged one. 0: off. Without it, a
    policy rarely finds rewards that are given only at a goal."""
    hindsight_episodes: Literal["all", "moved"] = "all"
    """HER: `all`: relabeled transitions come from all episodes. `moved`: only from episodes that
    achieve something that their first state does not (`environments.<name>.moved_distance`);
    hindsight teaches nothing about an object at rest. No episode fills more than two fifths of a
    minibatch on average."""
    priority: Literal["uniform", "td_error"] = "uniform"
    """Transitions are drawn uniformly, or by their TD error (PER, Schaul et al. 2016,
    proportional)."""
    priority_exponent: float = Field(0.6, gt=0)
    """PER: weight of the TD errors (alpha in the paper; 0 would be uniform). Higher values repeat
    surprising transitions more often, including noise."""
    importance_exponent: Annotated[Schedule, bounded("in [0, 1]", lambda b: 0 <= b <= 1)] = 0.4
    """PER: strength of the importance weights that correct its bias (beta; 1 corrects it fully)."""

    @model_validator(mode="after")
    def _one_choice(self) -> Self:
        if self.hindsight_episodes == "moved" and self.priority != "uniform":
            raise ValueError(
                "hindsight_episodes must be all with priority: td_error, got moved: only one of "
                "them can decide what is replayed"
            )
        return self
