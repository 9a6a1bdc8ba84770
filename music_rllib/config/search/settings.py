"""How a stage is searched: the `search` section of a sweep's YAML file."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from functools import cached_property
from typing import Annotated, Any, Literal, Self

from pydantic import Discriminator, Field, JsonValue, Tag, model_validator

from music_rllib.config.search.space import Choice, Dimension, Strict, listed

FINAL_SEED = 1_000_000
"""First of the fresh seeds of the final ranking: no search uses seeds from here on."""

MOST_GRID_POINTS = 100_000
"""Of a search with `sampler: grid`: far more than anyone can train, and still quick to list."""


class Objective(Strict):
    """What makes a trial good: one number from its runs."""

    metric: str = "evaluation/success_rate"
    """A metric as MLflow shows it (docs/algorithms.md); `env_steps` for the budget itself."""
    read: Literal["last", "best", "mean", "steps_to"] = "last"
    """A run's number: the metric's last value, its best one, the mean over the run, or the
    environment steps until it reaches `threshold` (the budget where it never does)."""
    threshold: float | None = None
    """Of `steps_to`."""
    aggregate: Literal["iqm", "mean", "median", "worst_task"] = "iqm"
    """A trial's number from its runs' (seeds times tasks): interquartile mean, mean or median over
    all of them, or the mean over seeds of the task where that is worst."""
    direction: Literal["maximize", "minimize"] | None = None
    """null: maximize, and minimize with `steps_to`."""

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
        """Whether more is better."""
        return (self.direction or ("minimize" if self.read == "steps_to" else "maximize")) == (
            "maximize"
        )

    @property
    def label(self) -> str:
        """`iqm of evaluation/success_rate`."""
        read = {"last": "", "best": "best ", "mean": "mean ", "steps_to": "steps to "}[self.read]
        until = "" if self.threshold is None else f" >= {self.threshold:g}"
        return f"{self.aggregate} of {read}{self.metric}{until}"


def _one_or_several(value: Any) -> str:
    """Which of the two a value claims to be, so that errors speak of that one only."""
    return "several" if isinstance(value, list | tuple) else "one"


Objectives = Annotated[
    Annotated[Objective, Tag("one")] | Annotated[list[Objective], Tag("several")],
    Discriminator(_one_or_several),
]


class Rung(Strict):
    """A point of a trial at which it may be stopped."""

    seeds: int | None = Field(None, gt=0)
    """Its first so many seeds have run, no more than the sweep has; null: all."""
    env_steps: int | None = Field(None, gt=0)
    """Up to so many environment steps, rounded up to the next evaluation, and no more than the
    longest run has; null: to the end."""


class Pruning(Strict):
    """Successive halving over budgets and seeds, with an interval as a second opinion."""

    rungs: tuple[Rung, ...] = Field(min_length=1)
    """In order; each with at least the seeds and steps of the one before."""
    keep: float = Field(0.5, gt=0, lt=1)
    """A trial goes on if it is in this best part of those that have reached the rung, ..."""
    confidence: float = Field(0.9, gt=0, lt=1)
    """... or if its interval at this confidence reaches the best trial's value there."""
    warm_up: int = Field(4, gt=0)
    """The first so many trials always go on."""


class Final(Strict):
    """The best trials once more, on seeds that had no part in choosing them."""

    trials: int = Field(3, gt=0)
    """So many of the best; in `compare` mode so many of each value."""
    baselines: bool = False
    """The `points_to_evaluate` run again as well, whatever they were worth, as far as they were
    judged: what the best ones have to beat."""
    seeds: int = Field(5, gt=0)
    """Fresh seeds for each."""
    env_steps: int | None = Field(None, gt=0)
    """Budget of these runs; null: that of the search's."""

    def most(self, points: int) -> int:
        """Trials in it at most, of a search with so many `points_to_evaluate`."""
        return self.trials + (points if self.baselines else 0)


class WarmStart(Strict):
    """An earlier study to learn from; its trials are not ranked again."""

    study: str
    """Its name, as `music-rllib status` shows it, or the beginning of it."""
    storage: str | None = None
    """Its Optuna storage: a database URL or a sqlite file; null: this search's own."""


class SearchSettings(Strict):
    """How a stage's trials are chosen, and judged."""

    mode: Literal["search", "compare"] = "search"
    """`search`: find the best point. `compare`: the same search for each value of `compare`, with
    the same number of trials and the same seeds, and then those values side by side."""
    space: dict[str, Dimension] = Field(min_length=1)
    """Dotted setting to where it is searched; `STAGE:setting` for one of the stage that this one
    starts from."""
    compare: dict[str, Annotated[list[JsonValue], Field(min_length=2)]] = Field(
        default_factory=dict
    )
    """Of `compare` mode: dotted setting to the values to tell apart."""
    sampler: Literal["tpe", "random", "grid", "cmaes", "nsga2"] = "tpe"
    """Optuna's TPE, CMA-ES (numbers only) and NSGA-II (several objectives), random, or all points
    of a grid in order, at most 100,000."""
    trials: int | None = Field(None, gt=0)
    """Trials to judge; null with `grid`: all points."""
    startup_trials: int = Field(5, gt=0)
    """Random trials before TPE or CMA-ES has something to go by."""
    population: int = Field(10, gt=1)
    """Size of a generation of CMA-ES and NSGA-II."""
    concurrent: int = Field(2, gt=0)
    """Trial n is chosen when all up to n minus this are judged, and by their results alone: more
    keeps more CPUs busy, less learns sooner. Part of what makes a study reproducible."""
    seed: int = Field(0, ge=0, lt=2**31)
    """Of the choice of points."""
    objective: Objectives = Objective()
    """What is optimised; a list of several gives a Pareto front."""
    points_to_evaluate: list[dict[str, JsonValue]] = Field(default_factory=list)
    """Points, or parts of points, that are the first trials, just as written. Each value must be
    one of the space, and one with `when` stand beside what it depends on."""
    pruning: Pruning | None = None
    """null: every trial runs to its end on all seeds."""
    final: Final | None = Final()
    """The ranking at the end; null: none, and the best value found is too good to be true."""
    study: str | None = Field(None, min_length=1)
    """Name under which drivers share a study; null: the sweep's name."""
    storage: str | None = Field(None, min_length=1)
    """Optuna's storage: `postgresql://user@host/database` (the password comes from `PGPASSWORD` or
    a password file), or another SQLAlchemy URL; null: a sqlite file in the sweep's folder."""
    warm_start: WarmStart | None = None
    """null: begin with what is known of the space alone."""

    @property
    def objectives(self) -> tuple[Objective, ...]:
        """One, or several."""
        return tuple(self.objective) if isinstance(self.objective, list) else (self.objective,)

    @cached_property
    def count(self) -> int:
        """Trials of each study."""
        grid = self.grid() if self.sampler == "grid" else []
        return min(self.trials or len(grid), len(grid)) if grid else (self.trials or 0)

    def grid(self) -> list[dict[str, Any]]:
        """All points, the last dimension varying fastest.

        Raises:
            ValueError: There are too many to list.
        """
        points: list[dict[str, Any]] = [{}]
        for name, dimension in self.space.items():
            exists = [dimension.applies(point) for point in points]
            size = sum((dimension.size or 0) if there else 1 for there in exists)
            if size > MOST_GRID_POINTS:  # counted before any of them is made
                raise ValueError(
                    f"space must have at most {MOST_GRID_POINTS:,} points with sampler: grid, "
                    f"got {size:,} up to {name}"
                )
            values = dimension.values() or ()
            points = [
                {**point, **extra}
                for point, there in zip(points, exists, strict=True)
                for extra in ([{name: value} for value in values] if there else [{}])
            ]
        return points

    def arms(self) -> list[dict[str, Any]]:
        """What `compare` tells apart; one empty mapping in `search` mode."""
        choices = [[(name, value) for value in values] for name, values in self.compare.items()]
        return [dict(pairs) for pairs in itertools.product(*choices)]

    def corners(self) -> Iterator[tuple[str, dict[str, tuple[tuple[str | int, ...], Any]]]]:
        """Points that show whether the space's ends are sound: each end once, the rest at first.

        Yields:
            The setting that is at its end, and the point: dotted setting to (place below `search`,
            value).
        """
        middle = {
            name: (("space", name), dimension.ends()[0]) for name, dimension in self.space.items()
        }
        for name, dimension in self.space.items():
            for value in dimension.ends():
                yield name, self._existing(middle | {name: (("space", name), value)}, keep=name)

    def _existing(
        self, point: dict[str, tuple[tuple[str | int, ...], Any]], keep: str
    ) -> dict[str, tuple[tuple[str | int, ...], Any]]:
        """Set what `keep` depends on, and leave out what does not exist then."""
        point = dict(point)
        todo = [keep]
        while todo:
            for name, wanted in self.space[todo.pop()].when.items():
                point[name] = (("space", name), listed(wanted)[0])
                todo.append(name)
        found: dict[str, tuple[tuple[str | int, ...], Any]] = {}
        for name, dimension in self.space.items():
            if dimension.applies({key: value for key, (_, value) in found.items()}):
                found[name] = point[name]
        return found

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
                # An empty list is a mistake too: with either, this setting never exists.
                values = listed(wanted)
                if not values or not all(map(self.space[other].contains, values)):
                    yield f"space.{name}.when must hold values of {other}, got {json.dumps(wanted)}"
        for name in self.compare:
            if name in self.space:
                yield f"compare.{name} must not be in the space too, got it in both"
        if (self.mode == "compare") != bool(self.compare):
            yield f"compare must be given with mode: compare, and only there, got mode: {self.mode}"
        yield from self._broken_sampler()
        yield from self._broken_pruning()
        if self.trials is not None and len(self.points_to_evaluate) > self.trials:
            yield (
                f"points_to_evaluate must not be more than the trials ({self.trials}), "
                f"got {len(self.points_to_evaluate)}"
            )
        for point in self.points_to_evaluate:
            for name in point:
                if name not in self.space:
                    yield f"points_to_evaluate must hold settings of the space, got {name!r}"
            if self.sampler == "grid":
                yield f"points_to_evaluate must be empty with sampler: grid, got {len(point)}"

    def _broken_sampler(self) -> Iterator[str]:
        if self.sampler == "grid":
            for name, dimension in self.space.items():
                if dimension.size is None:
                    yield f"space.{name} must have a step to be part of a grid, got none"
            self.grid()  # which says so if it is too large
        elif self.trials is None:
            yield f"trials must be given with sampler: {self.sampler}, got null"
        if self.sampler == "cmaes":
            for name, dimension in self.space.items():
                if isinstance(dimension, Choice) or dimension.when:
                    yield (
                        f"space.{name} must be a number without 'when' for sampler: cmaes, "
                        "got another"
                    )
        if self.sampler == "cmaes" and len(self.objectives) > 1:
            yield "sampler must be tpe, nsga2, random or grid for several objectives, got cmaes"
        if not self.objectives:
            yield "objective must be given, got an empty list"

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
