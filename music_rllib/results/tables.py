"""The tables of a report."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from music_rllib import names
from music_rllib.results.analysis import StageAnalysis
from music_rllib.results.answer import (
    claim_rows,
    interval_in_words,
    mean_rows,
    not_excluded,
    p_in_words,
    verdict_in_words,
)
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import FEWEST_FOR_INTERVAL, SHOW_SEEDS_BELOW, Estimate
from music_rllib.results.study import Study
from music_rllib.results.table import (
    DASH,
    Code,
    Difference,
    Seconds,
    Share,
    Table,
    estimate_of,
    to_csv,
)

UNFOLDED_ROWS = 30
"""Largest number of trials that the page shows unfolded."""

Entry = Mapping[str, Any]
"""A search in `search.json`, or one of its studies, trials or ranked settings."""


# Comparisons of conditions ----------------------------------------------------------------------


def study_tables(study: Study) -> list[Table]:
    """The comparisons, planned ones first, and the primary metric of each condition."""
    kind = study.means[0].measure.kind_in_words if study.means else "area under the curve"
    claims = (*study.planned, *study.unplanned)
    measures = " or ".join(dict.fromkeys(claim.measure.words for claim in claims))
    comparisons = Table(
        name="comparisons",
        title=f"Comparisons by the {kind}",
        header=("Task", "Pair", "Difference", "Interval", "p", "Verdict", "Planned", "Seeds"),
        rows=[
            (
                claim.task,
                f"{claim.first} against {claim.second}",
                Difference(claim.contrast.difference.value),
                interval_in_words(claim),
                p_in_words(claim).removeprefix("p = ") or None,
                f"{verdict_in_words(claim)}{not_excluded(claim)}",
                "yes" if claim.planned else "no",
                " and ".join(map(str, dict.fromkeys(claim.contrast.seeds))),
            )
            for claim in claims
        ],
        note=f"Differences in {measures}. Seeds are compared in pairs (Student's t-test) if both "
        "conditions have the same seeds, otherwise with Welch's t-test. Equivalence is tested with "
        "two one-sided tests (TOST). p-values are adjusted (Holm) for the planned comparisons, or "
        "for all comparisons if there is no plan. A failed run counts with the worst value.",
    )
    means = Table(
        name="area_under_curve",
        title=f"{kind.capitalize()} of each condition",
        header=("Task", "Condition", "Measure", "Mean", "Each seed", "Finished", "Runs"),
        rows=[
            (
                mean.task,
                mean.condition.short_label,
                mean.measure.words,
                mean.estimate,
                sorted(mean.scores.by_seed.values()),
                mean.scores.finished,
                mean.runs,
            )
            for mean in study.means
        ],
        note="The area under the learning curve is the mean over the budget (trapezoidal rule). A "
        "failed run counts with the worst value.",
    )
    return [comparisons, means]


def study_files(study: Study) -> Iterator[tuple[str, str]]:
    """Names and contents of the CSV files of a study, with the fields of `compare --json`."""
    yield "area_under_curve", to_csv(mean_rows(study))
    yield "comparisons", to_csv(claim_rows(study))


def performance_tables(analyses: Sequence[StageAnalysis]) -> list[Table]:
    """Final values, entropies, times to a threshold and differences of all stages."""
    scopes = [(one, scope) for one in analyses for scope in one.scopes]
    return [
        Table(
            name="final",
            title="Final values",
            header=("Stage", "Task", "Condition", "Metric", "Mean", "Each seed", "Seeds", "Runs"),
            rows=[
                (
                    analysis.stage.name,
                    scope.name,
                    final.condition.label,
                    names.word_of(scope.metric),
                    final.estimate,
                    sorted(final.scores.mean(axis=1).tolist()),
                    final.seeds,
                    final.runs,
                )
                for analysis, scope in scopes
                for final in scope.finals
            ],
            note="Mean of the last evaluation of finished runs; over all tasks, of the seeds that "
            f"have finished on each task. With {SHOW_SEEDS_BELOW} or more seeds, single seeds are "
            "not listed.",
        ),
        Table(
            name="entropies",
            title="Final entropies of the policies",
            header=("Stage", "Task", "Condition", "Shannon entropy (nats)", "S_q"),
            rows=[
                (analysis.stage.name, scope, condition.label, found.shannon, found.tsallis)
                for analysis in analyses
                for (scope, condition), found in analysis.entropies.items()
                if any(found)
            ],
            note="Entropies of the policy over all action dimensions, means over finished runs. If "
            "the Shannon entropies of two values of q differ, their results may differ because of "
            "it and not because of q. S_q is computed with each run's own q: its values at "
            "different q are not comparable.",
        ),
        _thresholds(analyses),
        Table(
            name="differences",
            title="Differences of the final values",
            header=("Stage", "Task", "Pair", "Difference", "Probability of improvement"),
            rows=[
                (
                    analysis.stage.name,
                    scope.name,
                    f"{pair.first.condition.label} against {pair.second.condition.label}",
                    pair.gap,
                    Share(pair.improvement),
                )
                for analysis, scope in scopes
                for pair in scope.differences
            ],
            note="Difference of the means, without a test. "
            "Probability of improvement: a run of the first condition ends higher than a run of "
            "the second (ties count half).",
        ),
    ]


def _thresholds(analyses: Sequence[StageAnalysis]) -> Table:
    return Table(
        name="steps_to_threshold",
        title="Environment steps to a success rate",
        header=(
            *("Stage", "Task", "Condition", "Success rate", "Reached", "Runs", "Median steps"),
            "Each run",
        ),
        rows=[
            (
                analysis.stage.name,
                time.task,
                time.condition.label,
                Share(time.threshold),
                int(time.reached.sum()),
                len(time.steps),
                time.median,
                [
                    f"{'' if reached else '>'}{steps:,.0f}"
                    for steps, reached in sorted(zip(time.steps, time.reached, strict=True))
                ],
            )
            for analysis in analyses
            for time in sorted(analysis.times, key=lambda time: (time.threshold, time.task))
        ],
        note="First evaluation at or above the success rate. Runs that did not reach it are "
        "censored at their last evaluation (Kaplan-Meier median). The interval is computed from "
        f"the order of the runs and needs at least {FEWEST_FOR_INTERVAL} of them.",
    )


# Runs -------------------------------------------------------------------------------------------


def budget_table(sweep: Sweep, analyses: Sequence[StageAnalysis]) -> Table:
    """Environment steps and training time of each stage."""
    rows = []
    for stage in (analysis.stage for analysis in analyses):
        seconds = [s for run in stage.runs if (s := sweep.runs[run].seconds) is not None]
        rows.append(
            (
                stage.name,
                len(stage.runs),
                sum(sweep.last_step(run) for run in stage.runs),
                sum(sweep.runs[run].budget or 0 for run in stage.runs) or None,
                Seconds(sum(seconds)) if seconds else None,
                Seconds(statistics.median(seconds)) if seconds else None,
            )
        )
    return Table(
        title="Budget and training time",
        header=(
            "Stage",
            "Runs",
            "Steps done",
            "Steps planned",
            "Training time, all runs",
            "Median",
        ),
        rows=rows,
        note="Environment steps. Training time (h:min:s) excludes interruptions; running runs are "
        "not counted.",
    )


def runs_table(sweep: Sweep) -> Table:
    """Every run of the sweep, with its last evaluation and its entropies."""
    return Table(
        name="runs",
        title=f"All {len(sweep.runs)} runs",
        folded=True,
        header=(
            *("Run", "Stage", "Task", "q", "Seed", "State", "Steps", "Budget", "Training time"),
            *("Success rate", "Return", "Shannon entropy", "S_q", "Cause of failure", "Key"),
        ),
        rows=[
            (
                run.name,
                run.stage,
                run.task,
                run.entropic_index,
                run.seed,
                state_in_words(run.status),
                sweep.last_step(position),
                run.budget,
                None if run.seconds is None else Seconds(run.seconds),
                sweep.final(position, names.EVAL_SUCCESS),
                sweep.final(position, names.EVAL_RETURN),
                *(sweep.final(position, metric) for metric in names.ENTROPIES),
                run.failure,
                Code(run.run_id),
            )
            for position, run in enumerate(sweep.runs)
        ],
    )


def failures_table(sweep: Sweep) -> Table:
    """The failed and the damaged runs, with the causes."""
    return Table(
        title="Failed runs",
        header=("Run", "Steps", "Cause"),
        rows=[
            (run.name, sweep.last_step(position), Code(run.failure or "no cause was recorded"))
            for position, run in enumerate(sweep.runs)
            if run.status == "FAILED" or (run.status == "KILLED" and run.failure)
        ],
    )


def origin_table(sweep: Sweep, command: str) -> Table:
    """The storage, the code and the versions that the numbers come from."""
    prefix = names.TAG_VERSION_PREFIX
    versions = sorted(
        f"{tag.removeprefix(prefix)} {value}"
        for tag, value in sweep.tags.items()
        if tag.startswith(prefix)
    )
    return Table(
        title="Origin",
        header=("Item", "Value"),
        rows=[
            ("Read from", Code(sweep.source)),
            ("Git commit", Code(sweep.tags.get(names.TAG_GIT_COMMIT, "unknown"))),
            ("Versions", ", ".join(versions) or "unknown"),
            ("Command of this report", Code(command)),
        ],
    )


def state_in_words(status: str) -> str:
    """A word for the status of a run or a sweep."""
    return {"KILLED": "stopped", "SCHEDULED": "waiting"}.get(status, status.lower())


# Searches ---------------------------------------------------------------------------------------
_TRIALS = {"judged": "scored", "pruned": "stopped early", "failed": "failed"}
"""Word for each state of a trial in `search.json`."""


def search_in_words(search: Entry) -> str:
    """A sentence with the search's mode, sampler, objectives and numbers of trials."""
    states = [trial["state"] for study in search["arms"] for trial in study["trials"]]
    counts = ", ".join(
        f"{states.count(state)} {word}" for state, word in _TRIALS.items() if state in states
    )
    aims = " and ".join(f"{aim['direction']} {aim['name']}" for aim in search["objectives"])
    return f"{search['mode'].capitalize()} ({search['sampler']}): {aims}; trials: {counts}."


def search_tables(search: Entry) -> Iterator[Table]:
    """The ranking on fresh seeds, the importance of each setting, and every trial."""
    trials = [trial for study in search["arms"] for trial in study["trials"]]
    settings = list(dict.fromkeys(name for trial in trials for name in trial["values"]))
    aims = [aim["name"] for aim in search["objectives"]]
    yield Table(
        title="Ranking on fresh seeds",
        note="These settings were trained again with seeds that the search did not use, so that "
        "selection does not bias them. Last column: the probability that a run of the best "
        "setting ends higher than a run of this one.",
        header=(
            *("Rank", "Trial", *settings, *aims, "Seeds"),
            *("In the search", "Probability that the best is better"),
        ),
        rows=[
            (
                place,
                _setting(row["trial"]),
                *(_setting(row["values"].get(name)) for name in settings),
                *_objectives(row, "fresh", len(aims)),
                len(row["scores"][0]) if row.get("scores") else None,
                f"failed: {row['failure']}"
                if "failure" in row
                else [value for value in row.get("searched") or () if value is not None],
                None if (better := row.get("best_is_better_with")) is None else Share(better),
            )
            for place, row in enumerate(search["ranking"] or (), start=1)
        ],
    )
    for study in search["arms"]:
        values = ", ".join(f"{name} = {_setting(value)}" for name, value in study["values"].items())
        yield Table(
            title=f"Importance of the settings{values and f' at {values}'}",
            note="Share of the objective's variance over the trials (functional ANOVA).",
            header=("Setting", "Share"),
            rows=[(name, Share(share)) for name, share in (study["importance"] or {}).items()],
        )
    yield Table(
        title="Trials",
        note="Each trial on the seeds of the search: selection biases the best one upwards.",
        header=("Trial", *settings, "State", *aims, "Why it was stopped"),
        folded=len(trials) > UNFOLDED_ROWS,
        rows=[
            (
                trial["number"],
                *(_setting(trial["values"].get(name)) for name in settings),
                _TRIALS.get(trial["state"], trial["state"]),
                *_objectives(trial, "objective", len(aims)),
                trial["reason"] or "",
            )
            for trial in trials
            if trial["state"] != "waiting"
        ],
    )


def _setting(value: object) -> str:
    return DASH if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _objectives(row: Entry, field: str, count: int) -> Iterator[Estimate | None]:
    """The estimate of each objective; None where it is unknown."""
    for aim in range(count):
        value = (row.get(field) or [None] * count)[aim]
        ends = (row.get("interval") or [(None, None)] * count)[aim]
        low, high = (np.nan if end is None else end for end in ends)
        yield None if value is None else estimate_of(value, low, high)
