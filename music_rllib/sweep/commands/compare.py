"""`compare`: the conditions of a stage side by side, with intervals."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from music_rllib.command_line import Json, console_for, print_json
from music_rllib.errors import BadInputError
from music_rllib.sweep.commands.arguments import Place, StageName, Storage

if TYPE_CHECKING:
    from music_rllib.results.analysis import FinalScores, Scope
    from music_rllib.results.conditions import Condition
    from music_rllib.results.statistics import Estimate

EXAMPLES = """\
Examples:
  music-rllib compare results/smoke
  music-rllib compare results/smoke --metric evaluation/object_displacement
  music-rllib compare results/search --stage finetune --json

The answer comes first: conditions by the area under their learning curves (the
mean over the budget), seed by seed if they share seeds, as superior, worse,
equivalent within a margin or undecided (docs/comparing_q.md). Comparisons that
the sweep's 'analysis' planned before the runs are kept apart from all others.

Tables of final values follow, without a test: the mean over the seeds that have
finished on every task with its 95 % interval (docs/reports.md), the difference
from the best mean, and the probability that a run of the best ends better. Runs
on the fresh seeds of a search are never mixed with those that chose its trials.
The report has the same numbers.
"""


def compare(
    sweep: Place,
    storage: Storage = None,
    stage: StageName = None,
    metric: Annotated[
        str | None,
        typer.Option(
            metavar="METRIC",
            help="A run's last value of it. Without it: what a searched stage's objective reads, "
            "else each task's own, evaluation/success_rate, or evaluation/episode_return without "
            "success.",
        ),
    ] = None,
    minimize: Annotated[
        bool,
        typer.Option(
            "--minimize",
            help="The metric is better where it is lower, as that of an objective that says so is.",
        ),
    ] = False,
    json: Json = False,
) -> int:
    """Values of q, or whatever varies, with 95 % intervals."""
    from music_rllib import names
    from music_rllib.experiment.environments import mixed
    from music_rllib.experiment.location import find_sweep
    from music_rllib.labels import ShortLabels
    from music_rllib.results.analysis import stage_scopes
    from music_rllib.results.answer import answer, study_data
    from music_rllib.results.conditions import find_stages
    from music_rllib.results.read import read_stored
    from music_rllib.results.study import study_of
    from music_rllib.search.ranking import measure_of
    from music_rllib.sweep.views.compare import compare_view

    location = find_sweep(sweep, storage)
    config = location.config()
    settings = config.stage(stage)
    metrics = {task.primary_metric for each in config.stages for task in each.tasks}
    metrics |= {names.EVAL_EPISODES, *names.ENTROPIES, *filter(None, [metric])}
    if settings.search is not None:
        metrics.add(settings.search.objectives[0].metric)
    read = read_stored(location, metrics=metrics)
    stored, opened = read.sweep, read.opened
    if metric is not None and metric not in stored.history and any(opened.finished):
        results = opened.results().values()
        known = sorted({name for result in results for name in result.metrics})
        raise BadInputError(f"--metric must be one of {', '.join(known)}, got {metric!r}")
    measure = measure_of(settings, stored)
    # Where no metric is given and nothing is searched, each task has its own.
    given, metric = metric, metric or (measure.metric if settings.search else None)
    maximised = not minimize and (measure.maximised or metric != measure.metric)
    study = study_of(stored, settings.name, metric=given, maximised=maximised or given is None)
    found = next((one for one in find_stages(stored) if one.name == settings.name), None)
    short = ShortLabels.of(run.name for run in stored.runs)
    groups: list[dict[str, Any]] = []
    if found is not None:
        planned = {
            condition: {
                "values": dict(opened.plan.node(stored.runs[condition.runs[0]].node_key).values),
                "seeds": len({stored.runs[run].seed for run in condition.runs}),
            }
            for condition in found.conditions
        }
        entropies = {name: stage_scopes(stored, found, name) for name in names.ENTROPIES}
        for scope in stage_scopes(stored, found, metric):
            groups += _groups(settings.name, scope, planned, maximised, _entropies(entropies))
    document = {
        "sweep": location.name,
        "stage": settings.name,
        "metric": metric or measure.metric,
        "direction": "maximize" if maximised else "minimize",
        "groups": groups,
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
    if json:
        print_json(document)
    else:
        console_for().print(compare_view(document))
    return 0


Entropies = Mapping[tuple[str, "Condition"], dict[str, dict[str, Any]]]
"""Scope and condition to each entropy's value and interval at the end."""


def _entropies(scopes: Mapping[str, Iterable[Scope]]) -> Entropies:
    entropies: dict[tuple[str, Condition], dict[str, dict[str, Any]]] = {}
    for metric, of_metric in scopes.items():
        for scope in of_metric:
            for final in scope.finals:
                value = {"value": final.value, "interval": _ends(final.estimate)}
                entropies.setdefault((scope.name, final.condition), {})[metric] = value
    return entropies


def _ends(estimate: Estimate) -> list[float]:
    return [float(estimate.lower), float(estimate.upper)]


def _groups(
    stage: str,
    scope: Scope,
    planned: Mapping[Condition, Mapping[str, Any]],
    maximised: bool,
    entropies: Entropies,
) -> Iterator[dict[str, Any]]:
    """The conditions that are compared in a scope, and those of the search apart from them."""
    from music_rllib.sweep.views.compare import IN_THE_SEARCH

    fresh = any(final.condition.is_fresh for final in scope.compared)
    searched = [final for final in scope.finals if final not in scope.compared]
    groups = ((scope.compared, "on fresh seeds" if fresh else ""), (searched, IN_THE_SEARCH))
    for finals, part in groups:
        if finals:
            yield {
                "part": part,
                "tasks": scope.name,
                "metric": scope.metric,
                "conditions": [
                    {
                        "stage": stage,
                        "values": planned[final.condition]["values"],
                        "planned": planned[final.condition]["seeds"] * scope.tasks,
                        **row,
                    }
                    for final, row in _rows(scope, finals, maximised, entropies)
                ],
            }


def _rows(
    scope: Scope,
    finals: Sequence[FinalScores],
    maximised: bool,
    entropies: Entropies,
) -> Iterator[tuple[FinalScores, dict[str, Any]]]:
    """Conditions with the best first, each with its difference from the best."""
    from music_rllib.results.statistics import difference

    ordered = sorted(finals, key=lambda final: final.value, reverse=maximised)
    best = ordered[0]
    for final in ordered:
        condition = final.condition
        row = {
            "label": condition.short_label,
            "on_fresh_seeds": condition.is_fresh,
            "value": final.value,
            "interval": _ends(final.estimate),
            "seeds": final.scores.mean(axis=1).tolist(),
            "runs": final.runs,
            "gap": None,
            "gap_interval": None,
            "best_is_better_with": None,
            "entropies": entropies.get((scope.name, condition), {}),
        }
        pair = next((p for p in scope.differences if {p.first, p.second} == {best, final}), None)
        if pair is not None:
            gap = difference(best.estimate, final.estimate)
            higher = pair.improvement
            row |= {
                "gap": float(gap.value),
                "gap_interval": _ends(gap),
                "best_is_better_with": higher if (pair.first is best) == maximised else 1 - higher,
            }
        yield final, row
