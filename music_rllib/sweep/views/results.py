"""The results of runs and searches after a sweep, as tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Set
from typing import Any

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from music_rllib import names
from music_rllib.command_line import clock, new_table, percent
from music_rllib.envs.tasks import Task
from music_rllib.experiment.plan import Plan, short
from music_rllib.experiment.scheduler import Status
from music_rllib.names import ShortLabels
from music_rllib.results.statistics import with_interval
from music_rllib.store.history import RunResult

_STYLES = {Status.FAILED: "red", Status.SKIPPED: "yellow", Status.WAITING: "yellow"}
_STATES = {Status.STARTED: "interrupted", Status.WAITING: "not started"}


def results_table(
    plan: Plan, status: Callable[[str], Status], results: Mapping[str, RunResult]
) -> Table:
    """One row for each run: its last metrics and its state.

    Args:
        plan: The sweep's plan.
        status: Node key to the status of the node.
        results: Node key to the result, or to the progress of an unfinished run.
    """
    metrics = _metric_columns({node.run.task.primary_metric for node in plan.nodes})
    if any(names.SHANNON_ENTROPY in result.metrics for result in results.values()):
        metrics |= {names.SHANNON_ENTROPY: "entropy,\nnats"}
    heads = ("run", *metrics.values(), "env steps", "time", "state")
    table = new_table(f"Results of {plan.name}", heads, left=("run", "state"))
    label = ShortLabels.of(run.label for run in plan.runs)
    for run in plan.runs:
        if run.part:  # the run of a search: the table of trials has it
            continue
        result, state = results.get(run.key), status(run.key)
        cells = ["-"] * (len(metrics) + 2)
        if result is not None:
            numbers = (measured(metric, result.metrics.get(metric)) for metric in metrics)
            cells = [*numbers, f"{result.env_steps:,}", clock(result.seconds)]
        name = _STATES.get(state, str(state))
        table.add_row(label(run.label), *cells, name, style=_STYLES.get(state))
    return table


def _metric_columns(primary: Set[str]) -> dict[str, str]:
    """The evaluation metrics for these primary metrics, with the heads of their columns."""
    of_success = {names.EVAL_SUCCESS: "success", names.EVAL_SUCCESS_ANY: "at any\nstep"}
    of_return = {names.EVAL_RETURN: "return"}
    if names.EVAL_RETURN not in primary:
        return of_success
    return of_return if primary == of_return.keys() else of_success | of_return


def search_views(searches: Iterable[Mapping[str, Any]]) -> list[RenderableType]:
    """Tables of trials, the importance of settings, and the final ranking of searches."""
    views: list[RenderableType] = []
    for search in searches:
        for arm in search["arms"]:
            views.append(_trials_table(search, arm))
            if arm["importance"]:
                shares = [f"{name} {percent(share)}" for name, share in arm["importance"].items()]
                views.append(Text(f"Share of the variance explained (fANOVA): {', '.join(shares)}"))
        if search["ranking"]:
            views.append(_ranking_table(search))
    return views


def _trials_table(search: Mapping[str, Any], arm: Mapping[str, Any]) -> Table:
    fixed = ", ".join(f"{name} = {short(value, name)}" for name, value in arm["values"].items())
    title = (
        f"Trials of {search['stage']}{f' with {fixed}' if fixed else ''}: "
        f"{arm['judged']} scored, {arm['pruned']} stopped early, {arm['failed']} failed"
    )
    if arm["front"]:
        title += "; the Pareto front in bold"
    settings = dict.fromkeys(
        name for trial in arm["trials"] for name in trial["values"] if name not in arm["values"]
    )
    objectives = [objective["name"] for objective in search["objectives"]]
    heads = ("trial", *settings, *objectives, "state", "why")
    table = new_table(title, heads, left=("state", "why"))
    for trial in arm["trials"]:
        if trial["state"] == "waiting":
            continue
        values = trial["objective"] or [None] * len(objectives)
        intervals = trial.get("interval") or [None] * len(values)
        best = trial["number"] in (arm["best"], *arm["front"])
        table.add_row(
            str(trial["number"]),
            *setting_cells(settings, trial["values"]),
            *(with_interval(v, i) for v, i in zip(values, intervals, strict=True)),
            trial["state"],
            trial["reason"] or "",
            style={"failed": "red", "pruned": "dim"}.get(trial["state"], "bold" if best else None),
        )
    return table


def _ranking_table(search: Mapping[str, Any]) -> Table:
    """The final ranking on fresh seeds."""
    settings = dict.fromkeys(name for row in search["ranking"] for name in row["values"])
    objectives = [
        head
        for objective in search["objectives"]
        for head in (f"{objective['name']}\non fresh seeds, 95% CI", "in the\nsearch")
    ]
    table = new_table(
        f"Ranking of {search['stage']} on fresh seeds. The values 'in the search' are biased "
        "upwards by the choice of the trials",
        ("rank", "trial", *settings, *objectives, "P(best is\nbetter)"),
    )
    for rank, row in enumerate(search["ranking"], 1):
        values = setting_cells(settings, row["values"])
        if "failure" in row:
            table.add_row("-", str(row["trial"]), *values, row["failure"], style="red")
            continue
        numbers = [
            text
            for fresh, ends, searched in zip(
                row["fresh"], row["interval"], row["searched"], strict=True
            )
            for text in (with_interval(fresh, ends), f"{searched:.3g}")
        ]
        chance = percent(row.get("best_is_better_with"))
        table.add_row(str(rank), str(row["trial"]), *values, *numbers, chance)
    return table


def setting_cells(settings: Iterable[str], values: Mapping[str, Any]) -> list[str]:
    """A cell for each setting: its value, or `-` if it has none."""
    return [short(values[name], name) if name in values else "-" for name in settings]


def measured(metric: str, value: float | None) -> str:
    """`35 %` for a rate, `-5.2` for another metric, or `-` for None."""
    return percent(value) if value is None or metric in names.EVAL_RATES else f"{value:.4g}"


def evaluation_text(task: Task, metrics: Mapping[str, float]) -> str:
    """A run's last evaluation by its task's primary metric: `success 35 % (any step 40 %)`."""
    metric = task.primary_metric
    text = f"{names.word_of(metric)} {measured(metric, metrics.get(metric))}"
    if metric != names.EVAL_SUCCESS:
        return text
    return f"{text} (any step {percent(metrics.get(names.EVAL_SUCCESS_ANY))})"
