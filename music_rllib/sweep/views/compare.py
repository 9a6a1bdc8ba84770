"""The answer of `compare`, as plain data and as tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from music_rllib import names
from music_rllib.command_line import new_table, percent
from music_rllib.errors import BadInputError
from music_rllib.experiment.environments import mixed
from music_rllib.experiment.sweep_files import SweepLocation
from music_rllib.names import ShortLabels, symbol
from music_rllib.results.analysis import FinalScores, Scope, stage_scopes
from music_rllib.results.answer import answer, study_data
from music_rllib.results.conditions import Condition, find_stages
from music_rllib.results.read import StoredSweep, read_stored
from music_rllib.results.statistics import SHOW_SEEDS_BELOW, Estimate, difference, with_interval
from music_rllib.results.study import study_of
from music_rllib.search.best import ranking_metric
from music_rllib.sweep.views.results import setting_cells

IN_THE_SEARCH = "in the search"
"""Part of a group of trials on the seeds that they were chosen by."""


def compare_document(
    location: SweepLocation, stage: str | None, metric: str | None, *, minimize: bool
) -> dict[str, Any]:
    """The comparison of a stage's conditions as plain data.

    Args:
        location: The sweep.
        stage: Name of the stage; None: the stage of the analysis, or the last one.
        metric: The compared metric; None: the objective's, or the primary one of each task.
        minimize: Lower values of the metric are better.

    Raises:
        BadInputError: There is no such stage or metric.
    """
    config = location.config()
    settings = config.stage(stage)
    metrics = {task.primary_metric for each in config.stages for task in each.tasks}
    metrics |= {names.EVAL_EPISODES, *names.ENTROPIES, *filter(None, [metric])}
    if settings.search is not None:
        metrics.add(settings.search.objectives[0].metric)
    read = read_stored(location, metrics=metrics)
    stored = read.sweep
    if metric is not None:
        _check_metric(read, metric)
    ranking = ranking_metric(settings, stored)
    shown = metric or (ranking.metric if settings.search else None)
    maximised = not minimize and (ranking.maximised or shown != ranking.metric)
    study = study_of(stored, settings.name, metric=metric, maximised=maximised or metric is None)
    short = ShortLabels.of(run.name for run in stored.runs)
    return {
        "sweep": location.name,
        "stage": settings.name,
        "metric": shown or ranking.metric,
        "direction": "maximize" if maximised else "minimize",
        "groups": list(_groups(read, settings.name, shown, maximised)),
        "answer": answer(stored, study),
        "environments": [
            *mixed(
                (run.task, short(run.name), run.tags.get(names.TAG_ENVIRONMENT, ""))
                for run in stored.runs
                if run.is_finished and run.stage == settings.name
            )
        ],
        **study_data(study),
        "earlier": stored.earlier,
    }


def _check_metric(read: StoredSweep, metric: str) -> None:
    if metric not in read.sweep.history and any(read.opened.finished):
        results = read.opened.results().values()
        known = sorted({name for result in results for name in result.metrics})
        raise BadInputError(f"--metric must be one of {', '.join(known)}, got {metric!r}")


def _groups(
    read: StoredSweep, stage: str, metric: str | None, maximised: bool
) -> Iterator[dict[str, Any]]:
    """The compared conditions of each scope, and the trials of a search apart from them."""
    sweep = read.sweep
    found = next((one for one in find_stages(sweep) if one.name == stage), None)
    if found is None:
        return
    entropies: dict[tuple[str, Condition], dict[str, Any]] = {}
    for name in names.ENTROPIES:
        for scope in stage_scopes(sweep, found, name):
            for final in scope.finals:
                value = {"value": final.value, "interval": _ends(final.estimate)}
                entropies.setdefault((scope.name, final.condition), {})[name] = value
    for scope in stage_scopes(sweep, found, metric):
        fresh = any(final.condition.is_fresh for final in scope.compared)
        searched = [final for final in scope.finals if final not in scope.compared]
        for finals, part in (
            (scope.compared, "on fresh seeds" if fresh else ""),
            (searched, IN_THE_SEARCH),
        ):
            if finals:
                ordered = sorted(finals, key=lambda final: final.value, reverse=maximised)
                rows = [
                    {
                        **_final_row(read, stage, scope, final),
                        **_gap_to(ordered[0], final, scope, maximised),
                        "entropies": entropies.get((scope.name, final.condition), {}),
                    }
                    for final in ordered
                ]
                group = {"part": part, "tasks": scope.name, "metric": scope.metric}
                yield group | {"conditions": rows}


def _final_row(read: StoredSweep, stage: str, scope: Scope, final: FinalScores) -> dict[str, Any]:
    condition, runs = final.condition, read.sweep.runs
    seeds = {runs[run].seed for run in condition.runs}
    return {
        "stage": stage,
        "values": dict(read.opened.plan.node(runs[condition.runs[0]].node_key).values),
        "planned": len(seeds) * scope.tasks,
        "label": condition.short_label,
        "on_fresh_seeds": condition.is_fresh,
        "value": final.value,
        "interval": _ends(final.estimate),
        "seeds": final.scores.mean(axis=1).tolist(),
        "runs": final.runs,
    }


def _gap_to(best: FinalScores, final: FinalScores, scope: Scope, maximised: bool) -> dict[str, Any]:
    """The difference of a condition from the best one; None for the best one itself."""
    pair = next((p for p in scope.differences if {p.first, p.second} == {best, final}), None)
    if pair is None:
        return {"gap": None, "gap_interval": None, "best_is_better_with": None}
    gap, higher = difference(best.estimate, final.estimate), pair.improvement
    return {
        "gap": float(gap.value),
        "gap_interval": _ends(gap),
        "best_is_better_with": higher if (pair.first is best) == maximised else 1 - higher,
    }


def _ends(estimate: Estimate) -> list[float]:
    return [float(estimate.lower), float(estimate.upper)]


def compare_view(document: Mapping[str, Any]) -> RenderableType:
    """The answer, the comparisons, and a table for each group of conditions."""
    earlier = [Text(document["earlier"])] if document["earlier"] else []
    if not document["groups"]:
        text = f"Stage {document['stage']} of {document['sweep']} has no finished run yet."
        return Group(Text(text), *earlier)
    parts: list[RenderableType] = [*map(Text, document["answer"]), *earlier, Text()]
    parts += [Text(line, style="yellow") for line in document["environments"]]
    if document["comparisons"]:
        parts.append(_comparisons_table(document["comparisons"]))
    if document["conditions"]:
        parts.append(_areas_table(document["conditions"]))
    for group in document["groups"]:
        parts.append(_group_table(document["stage"], group))
        if group["part"] == IN_THE_SEARCH:
            parts.append(Text("These runs selected the trials: the best one is biased upwards."))
        if any(row["entropies"] for row in group["conditions"]):
            parts.append(_entropies_table(group))
    return Group(*parts)


def _comparisons_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    task = _task_column(rows)
    heads = ("first - second", *task, "difference", "interval", "p", "verdict", "planned")
    table = new_table("Comparisons", heads, left=heads)
    for row in rows:
        verdict, interval, p_value = row["in_words"]
        table.add_row(
            f"{row['first']} - {row['second']}",
            *(row[name] for name in task),
            f"{row['difference']:+.3g}",
            interval,
            p_value.removeprefix("p = "),
            verdict,
            "yes" if row["planned"] else "no",
        )
    return table


def _areas_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    measure = " or ".join(dict.fromkeys(row["measure"] for row in rows))
    task = _task_column(rows)
    heads = ("condition", *task, "mean, 95% CI", "each seed", "runs")
    table = new_table(f"Compared by: {measure}", heads, left=["condition"])
    for row in rows:
        failed = f", {row['failed']} failed" if row["failed"] else ""
        table.add_row(
            row["condition"],
            *(row[name] for name in task),
            with_interval(row["value"], (row["lower"], row["upper"])),
            _seeds_text(list(row["by_seed"].values())),
            f"{row['seeds']} of {row['runs']}{failed}",
        )
    return table


def _group_table(stage: str, group: Mapping[str, Any]) -> Table:
    rows = group["conditions"]
    title = f"Final {group['metric']} of {stage} on {group['tasks']} {group['part']}".strip()
    settings = list(dict.fromkeys(name for row in rows for name in row["values"]))
    numbers = ("mean, 95% CI", "each seed", "runs", "best - this, 95% CI", "P(best is\nbetter)")
    table = new_table(title, (*_setting_heads(settings), *numbers))
    for row in rows:
        table.add_row(
            *setting_cells(settings, row["values"]),
            with_interval(row["value"], row["interval"]),
            _seeds_text(row["seeds"]),
            f"{row['runs']} of {row['planned']}",
            "" if row["gap"] is None else with_interval(row["gap"], row["gap_interval"]),
            percent(row["best_is_better_with"]),
        )
    return table


def _entropies_table(group: Mapping[str, Any]) -> Table:
    heads = ("condition", "Shannon, nats, 95% CI", "S_q, 95% CI")
    title = f"Entropy of the policies at the end on {group['tasks']}"
    table = new_table(title, heads, left=["condition"])
    for row in group["conditions"]:
        entropies = [row["entropies"].get(metric) for metric in names.ENTROPIES]
        cells = ("-" if e is None else with_interval(e["value"], e["interval"]) for e in entropies)
        table.add_row(row["label"], *cells)
    return table


def _seeds_text(scores: Sequence[float]) -> str:
    """`0.8 0.82 0.84`, the lowest first; empty if there are too many to read."""
    few = len(scores) < SHOW_SEEDS_BELOW
    return " ".join(f"{score:.3g}" for score in sorted(scores)) if few else ""


def _task_column(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The head of the column of tasks, if there are several."""
    return ["task"] if len({row["task"] for row in rows}) > 1 else []


def _setting_heads(settings: Iterable[str]) -> list[str]:
    """Settings by their short names in labels, or by their whole names if those are ambiguous."""
    brief = [symbol(name) for name in settings]
    return brief if len(set(brief)) == len(brief) else list(settings)
