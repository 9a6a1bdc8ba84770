"""The tables of a report, `compare` and `run`.

A :class:`Table` is shown on the page and in the console, and is, unrounded, a CSV file.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

from music_rllib import names
from music_rllib.results import statistics as st
from music_rllib.results.analysis import FinalScores, Scope, StageAnalysis
from music_rllib.results.answer import (
    interval_in_words,
    not_excluded,
    p_in_words,
    verdict_in_words,
)
from music_rllib.results.conditions import pairs_of
from music_rllib.results.statistics import FEWEST_FOR_INTERVAL, SHOW_SEEDS_BELOW, Estimate, number
from music_rllib.results.study import Study

DASH = "–"
"""Stands in a table for a missing value."""
LONG = 40
"""Number of letters from which on the text of a cell is wrapped."""


class Share(float):
    """A number that the page shows in percent."""


class Difference(float):
    """A number that the page shows with its sign."""


class Seconds(float):
    """A duration that the page shows as h:min:s."""


class Code(str):
    """A text that the page shows in a fixed-width font."""

    __slots__ = ()


class Cell(NamedTuple):
    """A cell of the page."""

    text: str
    kind: str = ""
    """CSS class: `number` (right-aligned), `long` (wraps over several lines) or empty."""
    code: bool = False


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of the page; one without rows is not shown."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[object]]
    """Texts, numbers, lists (long ones are only in the file), `Share`, `Seconds`, `Code`, None for
    a missing value, and estimates, which take two columns: value and 95% CI."""
    note: str = ""
    name: str = ""
    """Name of its CSV file; empty: it has none."""
    folded: bool = False

    @cached_property
    def _columns(self) -> list[tuple[str, Sequence[Cell]]]:
        """Title and cells of each column on the page, without the stage if there is only one."""
        shown: list[tuple[str, Sequence[Cell]]] = []
        columns = list(zip(*self.rows, strict=True)) or [()] * len(self.header)
        for title, values in zip(self.header, columns, strict=True):
            if title == "Stage" and len(set(values)) < 2 and len(self.header) > 2:
                continue
            if any(isinstance(value, Estimate) for value in values):
                texts, intervals = zip(*map(_estimate, values), strict=True)
                shown += [(title, texts), ("95% CI", intervals)]
            else:
                shown.append((title, [*map(_cell, values)]))
        return shown

    @property
    def heads(self) -> list[tuple[str, str]]:
        """Each column's name on the page, and the kind of its first cell."""
        return [(title, cells[0].kind if cells else "") for title, cells in self._columns]

    @property
    def cells(self) -> list[Sequence[Cell]]:
        return list(zip(*(cells for _, cells in self._columns), strict=True))

    def to_csv(self) -> str:
        """The unrounded values; an estimate has the columns `x`, `x_lower` and `x_upper`."""
        rows: list[dict[str, object]] = []
        for row in self.rows:
            values: dict[str, object] = {}
            for title, value in zip(self.header, row, strict=True):
                column = re.sub(r"\W+", "_", title.lower()).strip("_")
                if isinstance(value, Estimate):
                    values[column] = float(value.value)
                    values[f"{column}_lower"] = float(value.lower)
                    values[f"{column}_upper"] = float(value.upper)
                else:
                    values[column] = value
            rows.append(values)
        return to_csv(rows)


def to_csv(rows: Sequence[Mapping[str, object]]) -> str:
    """Rows below a header; NaN is `nan`, infinity `inf`, and None is empty."""
    buffer = io.StringIO()
    columns = list(dict.fromkeys(name for row in rows for name in row))
    writer = csv.DictWriter(buffer, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _plain(value) for name, value in row.items()} for row in rows)
    return buffer.getvalue()


def _plain(value: object) -> object:
    """`0 1 2` for a list, and `0:0.5 1:0.6` for a mapping; without separators of thousands."""
    if isinstance(value, Mapping):
        return " ".join(f"{key}:{one!r}" for key, one in value.items())
    return (
        " ".join(str(one).replace(",", "") for one in value) if isinstance(value, list) else value
    )


def _cell(value: object) -> Cell:
    if value is None:
        return Cell(DASH)
    if isinstance(value, Code):
        return Cell(value, "long" if len(value) > LONG else "", code=True)
    if isinstance(value, list) and len(value) >= SHOW_SEEDS_BELOW:
        return Cell(DASH)
    if isinstance(value, list):
        return Cell(" ".join(one if isinstance(one, str) else _number(one) for one in value))
    if isinstance(value, float):
        return Cell(_number(value), "number")
    if isinstance(value, int) and not isinstance(value, bool):
        return Cell(f"{value:,}", "number")
    text = str(value)
    return Cell(text, "long" if len(text) > LONG else "")


def _number(value: float) -> str:
    if math.isnan(value):
        return DASH
    if isinstance(value, Share):
        return f"{value:.0%}"
    if isinstance(value, Difference):
        return f"{value:+,.0f}" if abs(value) >= 100 else f"{value:+.3g}"
    if isinstance(value, Seconds):
        minutes, seconds = divmod(round(value), 60)
        return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"
    if 0 < abs(value) < 0.01:
        return f"{value:.2g}"
    return "not reached" if math.isinf(value) else number(value)


def _estimate(value: object) -> tuple[Cell, Cell]:
    """An estimate's value and its 95% CI."""
    if not isinstance(value, Estimate):
        return Cell(DASH, "number"), Cell(DASH)
    mean, low, high = value.numbers
    if value.has_interval and math.isfinite(mean):
        decimals = st.decimals_of(mean, low, high)
        text = f"{round(mean, decimals) + 0.0:,.{decimals}f}"
        return Cell(text, "number"), Cell(st.interval_text(value))
    interval = "no interval" if math.isnan(low) else f"{_number(low)} to {_number(high)}"
    return Cell(_number(mean), "number"), Cell(interval)


UNFOLDED_ROWS = 30
"""Largest number of trials that the page shows unfolded."""

Entry = Mapping[str, Any]
"""A search in `search.json`, or one of its studies, trials or ranked settings."""


# Comparisons of conditions ----------------------------------------------------------------------


def study_tables(study: Study) -> list[Table]:
    """The comparisons, planned ones first, and the primary metric of each condition."""
    claims = (*study.planned, *study.unplanned)
    kinds = [found[0].measure.kind_in_words for found in (claims, study.means) if found]
    kinds = kinds or ["area under the curve"]
    of_area = "The area under the learning curve is the mean over the budget (trapezoidal rule). "
    measures = " or ".join(dict.fromkeys(claim.measure.words for claim in claims))
    comparisons = Table(
        name="comparisons",
        title=f"Comparisons by the {kinds[0]}",
        header=("Task", "Pair", "Difference", "Interval", "p", "Verdict", "Planned", "Seeds"),
        rows=[
            (
                claim.task,
                claim.pair_among(claims),
                Difference(claim.contrast.difference.value),
                interval_in_words(claim),
                p_in_words(claim).removeprefix("p = ") or None,
                f"{verdict_in_words(claim)}{not_excluded(claim)}",
                "yes" if claim.planned else "no",
                " and ".join(map(str, dict.fromkeys(claim.contrast.seeds))),
            )
            for claim in claims
        ],
        note=f"Differences in {measures}. p-values are adjusted (Holm) for planned comparisons, "
        "or for all comparisons if there is no plan. A failed run counts with the worst value.",
    )
    means = Table(
        name="area_under_curve",
        title=f"{kinds[-1].capitalize()} of each condition",
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
        note=f"{of_area if kinds[-1] != 'final value' else ''}A failed run counts with the worst "
        "value.",
    )
    return [comparisons, means]


def performance_tables(analyses: Sequence[StageAnalysis]) -> list[Table]:
    """Final values, entropies, times to a threshold and differences of all stages.

    Success is not listed for stages that train without the task's reward, beside others.
    """
    rewarded = [one for one in analyses if one.stage.has_task_reward] or analyses
    scopes = [(one, scope) for one in rewarded for scope in one.scopes]
    return [
        Table(
            name="final",
            title="Final values",
            header=(
                *("Stage", "Task", "Condition", "Metric", "Mean", "Each seed", "Seeds"),
                "Finished",
            ),
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
        _thresholds(rewarded),
        Table(
            name="differences",
            title="Differences of the final values",
            header=("Stage", "Task", "Pair", "Difference", "Probability of improvement"),
            rows=[
                (
                    analysis.stage.name,
                    scope.name,
                    f"{first.condition.label} against {second.condition.label}",
                    st.difference(first.estimate, second.estimate),
                    Share(st.improvement(first.scores, second.scores)),
                )
                for analysis, scope in scopes
                for first, second in _pairs_of_finals(scope)
            ],
            note="Differences of the means, without a test. Probability of improvement: a run of "
            "the first condition ends higher than a run of the second (ties count half).",
        ),
    ]


def _pairs_of_finals(scope: Scope) -> Iterator[tuple[FinalScores, FinalScores]]:
    finals = {final.condition: final for final in scope.compared}
    return ((finals[one], finals[other]) for one, other in pairs_of(list(finals)))


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
