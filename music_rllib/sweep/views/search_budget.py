"""The most that the search of a stage trains."""

from __future__ import annotations

from dataclasses import dataclass

from music_rllib.config.schema import Stage
from music_rllib.config.search_check import most_env_steps


@dataclass(frozen=True, kw_only=True)
class SearchBudget:
    """Upper bounds over all studies and tasks: trials may be stopped early, and points repeat."""

    trial_runs: int
    """Runs by which the trials are chosen."""
    trial_env_steps: int
    """Env steps of one of these runs."""
    fresh_runs: int
    """Runs of the final ranking, on fresh seeds."""
    fresh_env_steps: int
    """Env steps of one of these runs."""

    @property
    def runs(self) -> int:
        """All runs."""
        return self.trial_runs + self.fresh_runs

    @property
    def env_steps(self) -> int:
        """Env steps of all runs together."""
        return self.trial_runs * self.trial_env_steps + self.fresh_runs * self.fresh_env_steps


def search_budget(stage: Stage, seeds: int) -> SearchBudget:
    """The budget of a searched stage in a sweep with this number of seeds."""
    search = stage.search
    assert search is not None
    env_steps = most_env_steps(search, stage.points)
    fresh_runs, fresh_env_steps = 0, env_steps
    runs_per_seed = len(search.compared()) * len(stage.tasks)
    if (final := search.final) is not None:
        finalists = min(final.most(len(search.points_to_evaluate)), search.count)
        fresh_runs = finalists * final.seeds * runs_per_seed
        fresh_env_steps = final.env_steps or env_steps
    return SearchBudget(
        trial_runs=search.count * seeds * runs_per_seed,
        trial_env_steps=env_steps,
        fresh_runs=fresh_runs,
        fresh_env_steps=fresh_env_steps,
    )
