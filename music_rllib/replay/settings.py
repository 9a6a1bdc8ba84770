"""Named, validated settings of the trajectory replay."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from music_rllib.schedules import Schedule, bounded


class ReplaySettings(BaseModel):
    """Size of the replay, and hindsight relabelling (Andrychowicz et al. 2017)."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    capacity: int = Field(1_000_000, gt=0)
    """Transitions kept; the oldest trajectories go first. More remembers what the policy no longer
    does, and takes memory: FetchPush 151 bytes each."""
    hindsight_k: float = Field(0.0, ge=0)
    """HER, `future` strategy: k relabelled transitions for each one kept as it was. 0: off. Rewards
    that come only at a goal are hardly ever found without it."""
    hindsight_episodes: Literal["all", "moved"] = "all"
    """HER: relabelled transitions come from all episodes, or only from those that achieve something
    that their first state does not (`environments.<name>.moved_distance`). Where an object rests,
    hindsight has nothing to tell. None of them makes up more than two fifths of a minibatch
    on average."""
    priority: Literal["uniform", "td_error"] = "uniform"
    """Transitions drawn uniformly, or by their TD error (PER, Schaul et al. 2016, proportional)."""
    priority_exponent: float = Field(0.6, gt=0)
    """PER: how strongly TD errors count (alpha in the paper; 0 would be uniform). Higher repeats
    surprises more often, and noise with them."""
    importance_exponent: Annotated[Schedule, bounded("in [0, 1]", lambda b: 0 <= b <= 1)] = 0.4
    """PER: strength of the importance weights that undo its bias (beta; 1 undoes it fully)."""

    @model_validator(mode="after")
    def _one_choice(self) -> Self:
        if self.hindsight_episodes == "moved" and self.priority != "uniform":
            raise ValueError(
                "hindsight_episodes must be all with priority: td_error, got moved: one of them "
                "decides what is replayed"
            )
        return self
