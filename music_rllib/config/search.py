"""The `search` section of a stage in a sweep's YAML file."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Annotated, Any, Literal, Self

from pydantic import Discriminator, Field, JsonValue, Tag, model_validator

from music_rllib.config.layers import varied_by
from music_rllib.config.problems import KeyPath
from music_rllib.config.space import Choice, Dimension, listed
from music_rllib.schedules import StrictModel

FINAL_SEED = 1_000_000
"""First fresh seed of final rankings; the seeds of a search are smaller."""

MOST_SEARCH_POINTS = 100_000
"""Largest grid with `sampler: grid`: more than anyone can train, and quick to list."""


def of_stage(values: Mapping[str, Any], stage: str) -> dict[str, Any]:
    """The dotted settings that have the prefix of `stage`, without the prefix."""
    return {
        name.removeprefix(f"{stage}:"): value
        for name, value in values.items()
        if name.startswith(f"{stage}:")
    }


class Objective(StrictModel):
    """One number of a trial, computed from its runs, that the search maximizes or minimizes."""

    metric: str = "evaluation/success_rate"
    """A metric as MLflow shows it (docs/algorithms.md); `env_steps` for the budget itself."""
    read: Literal["last", "best", "mean", "steps_to"] = "last"
    """A run's number: the metric's last value, its best value, its mean over the run, or the
    environment steps until it reaches `threshold` (the budget if it never does)."""
    threshold: float | None = None
    """Value of the metric for `read: steps_to`."""
    aggregate: Literal["iqm", "mean", "median", "worst_task"] = "iqm"
    """A trial's number from its runs' numbers (seeds times tasks): interquartile mean, mean or
    median over all runs, or the mean over seeds for the worst task."""
    direction: Literal["maximize", "minimize"] | None = None
    """Whether a larger or a smaller number is better; null: minimize with `read: steps_to`,
    otherwise maximize."""

    @model_validator(mode="after")
    def _threshold_belongs(self) -> Self:
        if (self.read == "steps_to") != (self.threshold is not None):
            raise ValueError(
                "threshold must be given with read: steps_to, and only there, "
                f"got read: {self.read}"
            )
        return self

    @property
    def maximised(self) -> bool:
        """Whether a larger number is better."""
        default = "minimize" if self.read == "steps_to" else "maximize"
        return (self.direction or default) == "maximize"

    @property
    def label(self) -> str:
        """The objective in text: `iqm of evaluation/success_rate`."""
        read = {"last": "", "best": "best ", "mean": "mean ", "steps_to": "steps to "}[self.read]
        until = "" if self.threshold is None else f" >= {self.threshold:g}"
        return f"{self.aggregate} of {read}{self.metric}{until}"


def _one_or_several(value: Any) -> str:
    """Tag of the member of `Objectives` that `value` should be."""
    return "several" if isinstance(value, list | tuple) else "one"


Objectives = Annotated[
    Annotated[Objective, Tag("one")]
    | Annotated[list[Objective], Field(min_length=1), Tag("several")],
    Discriminator(_one_or_several),
]


class Rung(StrictModel):
    """A point at which a trial can be pruned."""

    seeds: int | None = Field(None, gt=0)
    """Number of the sweep's first seeds that have run up to this point; null: all."""
    env_steps: int | None = Field(None, gt=0)
    """Environment steps of these runs, rounded up to the next evaluation, and at most those of the
    longest run; null: to the end."""


class Pruning(StrictModel):
    """Successive halving over budgets and seeds; a confidence interval can keep a trial."""

    rungs: tuple[Rung, ...] = Field(min_length=1)
    """Rungs in order; each has at least the seeds and environment steps of the one before."""
    keep: float = Field(0.5, gt=0, lt=1)
    """A trial continues if it is in this best share of the trials that reached the rung, ..."""
    confidence: float = Field(0.9, gt=0, lt=1)
    """... or if its interval at this confidence reaches the best trial's value there."""
    warm_up: int = Field(4, gt=0)
    """Number of first trials that always continue."""


class FinalRanking(StrictModel):
    """Runs of the best trials on fresh seeds, which were not used to select them."""

    trials: int = Field(3, gt=0)
    """Number of best trials; in `compare` mode for each value."""
    baselines: bool = False
    """Whether the evaluated `points_to_evaluate` also run on the fresh seeds, as baselines."""
    seeds: int = Field(5, gt=0)
    """Fresh seeds of each trial."""
    env_steps: int | None = Field(None, gt=0)
    """Budget of these runs; null: the budget of the search's runs."""

    def most(self, points: int) -> int:
        """Largest number of ranked trials, if `points` points were given to evaluate."""
        return self.trials + (points if self.baselines else 0)


class SearchSettings(StrictModel):
    """How the trials of a stage are proposed and evaluated."""

    mode: Literal["search", "compare"] = "search"
    """`search`: find the best point. `compare`: the same search for each value of `compare`, with
    the same number of trials and the same seeds, and then a comparison of these values."""
    space: dict[str, Dimension] = Field(min_length=1)
    """Dotted setting to its range or choices; `STAGE:setting` for a setting of the stage that this
    stage starts from."""
    compare: dict[str, Annotated[list[JsonValue], Field(min_length=2)]] = Field(
        default_factory=dict
    )
    """In `compare` mode: dotted setting to the values that are compared."""
    sampler: Literal["tpe", "random", "grid", "cmaes", "nsga2"] = "tpe"
    """Optuna's TPE, CMA-ES (numbers only) and NSGA-II (several objectives), random, or all points
    of a grid in order, at most 100,000."""
    trials: int | None = Field(None, gt=0)
    """Number of trials, at most the number of points; null with `grid`: all points. Each trial has
    another point."""
    startup_trials: int = Field(5, gt=0)
    """Random trials before TPE or CMA-ES proposes."""
    population: int = Field(10, gt=1)
    """Size of a generation of CMA-ES and NSGA-II."""
    concurrent: int = Field(2, gt=0)
    """Trial n is proposed from the results of the trials up to n minus this number, when they are
    complete. Larger keeps more CPUs busy; smaller uses results earlier. A study is reproducible
    only with the same value."""
    seed: int = Field(0, ge=0, lt=2**31)
    """Seed of the sampler."""
    objective: Objectives = Objective()
    """The number to optimize; a list of several gives a Pareto front."""
    points_to_evaluate: list[dict[str, JsonValue]] = Field(default_factory=list)
    """Points, or parts of points, of the first trials, exactly as written. Each value must be in
    the space, and a setting with `when` needs the settings that it depends on beside it."""
    pruning: Pruning | None = None
    """When trials are pruned; null: every trial runs to its end on all seeds."""
    final: FinalRanking | None = FinalRanking()
    """The final ranking on fresh seeds; null: none, so the best value found is biased upwards."""
    study: str | None = Field(None, min_length=1)
    """Name under which drivers share a study; null: the sweep's name."""
    storage: str | None = Field(None, min_length=1)
    """Optuna's storage: `postgresql://user@host/database` (the password comes from `PGPASSWORD` or
    a password file), or another SQLAlchemy URL; null: a sqlite file in the sweep's folder."""

    @property
    def objectives(self) -> tuple[Objective, ...]:
        """The objectives as a tuple, also if there is only one."""
        return tuple(self.objective) if isinstance(self.objective, list) else (self.objective,)

    @cached_property
    def count(self) -> int:
        """Number of trials of each study, at most the number of points."""
        if self.points is None:
            return self.trials or 0
        return min(self.trials or len(self.points), len(self.points))

    @cached_property
    def points(self) -> list[dict[str, Any]] | None:
        """All points, the last dimension varying fastest.

        None for a continuous space, and for more than `MOST_SEARCH_POINTS`.
        """
        points: list[dict[str, Any]] = [{}]
        for name, dimension in self.space.items():
            exists = [dimension.applies(point) for point in points]
            size = sum((dimension.size or 0) if there else 1 for there in exists)
            if dimension.size is None or size > MOST_SEARCH_POINTS:  # counted before they are made
                return None
            values = dimension.values() or ()
            points = [
                {**point, **extra}
                for point, there in zip(points, exists, strict=True)
                for extra in ([{name: value} for value in values] if there else [{}])
            ]
        return points

    def compared(self) -> list[dict[str, Any]]:
        """Settings of each compared value; one empty mapping in `search` mode."""
        choices = [[(name, value) for value in values] for name, values in self.compare.items()]
        return [dict(pairs) for pairs in itertools.product(*choices)]

    @property
    def stages(self) -> set[str]:
        """Other stages whose settings are part of the search."""
        return {name.partition(":")[0] for name in (*self.space, *self.compare) if ":" in name}

    def examples(self) -> Iterator[tuple[KeyPath, dict[str, Any]]]:
        """Points that are valid if all values are: ends of the space, and compared values.

        Yields:
            The place of the varied setting below `search`, and the point.
        """
        first = {name: dimension.ends()[0] for name, dimension in self.space.items()}
        for name, dimension in self.space.items():
            for value in dimension.ends():
                yield ("space", name), self._existing(first | {name: value}, keep=name)
        for name, values in self.compare.items():
            for position, value in enumerate(values):
                yield ("compare", name, position), {name: value}

    def _existing(self, point: dict[str, Any], keep: str) -> dict[str, Any]:
        """Set the settings that `keep` depends on; return the settings of `point` that apply."""
        todo = [keep]
        while todo:
            for name, wanted in self.space[todo.pop()].when.items():
                point[name] = listed(wanted)[0]
                todo.append(name)
        existing: dict[str, Any] = {}
        for name, dimension in self.space.items():
            if dimension.applies(existing):
                existing[name] = point[name]
        return existing

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        for rule in self._broken_rules():
            raise ValueError(rule)
        return self

    def _broken_rules(self) -> Iterator[str]:
        names = list(self.space)
        for position, (name, dimension) in enumerate(self.space.items()):
            for other, wanted in dimension.when.items():
                if other not in names[:position]:
                    yield f"space.{name}.when must name settings that stand above it, got {other!r}"
                    continue
                # With an empty list or an impossible value, this setting never exists.
                values = listed(wanted)
                if not values or not all(map(self.space[other].contains, values)):
                    yield f"space.{name}.when must hold values of {other}, got {json.dumps(wanted)}"
        yield from self._settings_varied_twice()
        if (self.mode == "compare") != bool(self.compare):
            yield f"compare must be given with mode: compare, and only there, got mode: {self.mode}"
        yield from self._broken_sampler()
        yield from self._broken_pruning()
        if self.trials is not None and len(self.points_to_evaluate) > self.trials:
            yield (
                f"points_to_evaluate must not be more than the trials ({self.trials}), "
                f"got {len(self.points_to_evaluate)}"
            )
        if self.points_to_evaluate and self.sampler == "grid":
            yield "points_to_evaluate must be empty with sampler: grid, got points"

    def _settings_varied_twice(self) -> Iterator[str]:
        varied = {
            f"compare.{name}": {name, *varied_by(name, self.compare[name])} for name in self.compare
        }
        varied |= {
            f"space.{name}": {name, *varied_by(name, at.ends())} for name, at in self.space.items()
        }
        for one, other in itertools.combinations(varied, 2):
            # With `when`, one can exist only where the other lacks the field: the ends show it.
            below = self.space.get(other.removeprefix("space."))
            apart = below is not None and one.removeprefix("space.") in below.when
            if (both := varied[one] & varied[other]) and not apart:
                yield f"{one} must not vary what {other} varies, got {min(both)} in both"

    def _broken_sampler(self) -> Iterator[str]:
        if self.sampler == "grid":
            for name, dimension in self.space.items():
                if dimension.size is None:
                    yield f"space.{name} must have a step to be part of a grid, got none"
            if self.points is None:
                most = f"{MOST_SEARCH_POINTS:,}"
                yield f"space must have at most {most} points with sampler: grid, got more"
        elif self.trials is None:
            yield f"trials must be given with sampler: {self.sampler}, got null"
        if self.sampler == "cmaes" and (
            len(self.objectives) > 1
            or any(isinstance(one, Choice) or one.when for one in self.space.values())
        ):
            yield "sampler must not be cmaes for several objectives, choices and 'when', got cmaes"

    def _broken_pruning(self) -> Iterator[str]:
        if self.pruning is None:
            return
        if len(self.objectives) > 1:
            yield "pruning must be null for several objectives, got rungs"
        before = (0, 0.0)
        for rung in self.pruning.rungs:
            here = (rung.seeds or 10**9, rung.env_steps or float("inf"))
            if here[0] < before[0] or here[1] < before[1] or here == before:
                yield (
                    "pruning.rungs must grow in seeds or env_steps and never shrink, got "
                    f"{rung.model_dump_json(exclude_none=True)} behind a larger one"
                )
            before = here
