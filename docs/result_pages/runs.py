"""Single runs: progress and last values of metrics."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from docs.result_pages.exports import EARLIER
from docs.result_pages.words import (
    THRESHOLD,
    all_of,
    clock,
    natural,
    percent,
    row,
    rule,
    spread,
)
from music_rllib import names
from music_rllib.results import statistics as st
from music_rllib.results.analysis import analyse
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import first_passage, number


def runs_table(sweep: Sweep) -> Iterator[str]:
    """Every run, also failed ones: steps, result, time, versions."""
    yield row(
        "run", "state", "env steps", "last evaluation", f"first ≥ {percent(THRESHOLD)} at", "time"
    )
    yield rule(6)
    for position in sorted(range(len(sweep.runs)), key=lambda i: natural(sweep.runs[i].name)):
        run = sweep.runs[position]
        steps, values = sweep.series(position, names.EVAL_SUCCESS)
        passage = first_passage(steps.astype(float), values, THRESHOLD)
        yield row(
            f"`{run.name}`",
            run.status.lower(),
            f"{sweep.last_step(position):,}",
            _last(sweep, position),
            _first(passage),
            clock(run.seconds),
        )
    yield ""
    yield provenance(sweep)


def _last(sweep: Sweep, run: int) -> str:
    """The last value of the primary metric; empty before the first evaluation."""
    metric = sweep.primary_metric(sweep.runs[run].task)
    value = sweep.final(run, metric)
    if value is None:
        return ""
    return percent(value) if metric == names.EVAL_SUCCESS else number(value)


def _first(passage: tuple[float, bool] | None) -> str:
    """The step of a first passage; empty for a task without a success rate."""
    if passage is None:
        return ""
    steps, reached = passage
    return f"{steps:,.0f}" if reached else "not"


def provenance(sweep: Sweep) -> str:
    """Commits, versions and evaluation episodes of the runs."""
    commits = all_of(
        re.sub(r"^(.{7})[^-]*", r"\1", run.tags.get(names.TAG_GIT_COMMIT, ""))
        for run in sweep.runs
        if run.status != "SCHEDULED"
    )
    versions = sorted(
        {
            f"{tag.removeprefix(names.TAG_VERSION_PREFIX)} {value}"
            for run in sweep.runs
            for tag, value in run.tags.items()
            if tag.startswith(names.TAG_VERSION_PREFIX) and tag != names.TAG_ALGORITHM
        }
    )
    episodes = all_of(run.params.get("evaluation.episodes", "") for run in sweep.runs)
    algorithm = all_of(run.tags.get(names.TAG_ALGORITHM, EARLIER[-1]) for run in sweep.runs)
    return (
        f"{episodes} evaluation episodes; algorithm {algorithm}; commit {commits}; "
        f"{', '.join(versions)}."
    )


def metric_table(sweep: Sweep, *metrics: str) -> Iterator[str]:
    """Last values of metrics, run by run, and their mean with its interval."""
    for position, analysis in enumerate(analyse(sweep)):
        if position:
            yield ""
        seeds = analysis.stage.seeds
        yield row(
            "task", "condition", "metric", *(f"seed {seed}" for seed in seeds), "mean [95% CI]"
        )
        yield rule(len(seeds) + 4)
        for task in analysis.stage.tasks:
            for condition in analysis.stage.conditions:
                runs = {sweep.runs[i].seed: i for i in condition.runs if sweep.runs[i].task == task}
                for metric in metrics:
                    last = [last_value(sweep, runs.get(seed), metric) for seed in seeds]
                    episodes = sweep.episodes(runs.values()) if metric in names.EVAL_RATES else None
                    told = st.estimate(np.array(last)[:, np.newaxis], episodes)
                    numbers = [number(value) if np.isfinite(value) else "" for value in last]
                    yield row(task, condition.label, f"`{metric}`", *numbers, spread(told))


def last_value(sweep: Sweep, run: int | None, metric: str) -> float:
    """The last value of a finished run; NaN otherwise."""
    if run is None or sweep.runs[run].status != "FINISHED":
        return float("nan")
    value = sweep.final(run, metric)
    return float("nan") if value is None else value
