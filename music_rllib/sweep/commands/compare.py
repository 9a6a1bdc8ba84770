"""`compare`: conditions side by side, with intervals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from music_rllib.command_line import Json, console_for, print_json
from music_rllib.errors import BadInputError
from music_rllib.sweep.cli_helpers import Place, Storage

if TYPE_CHECKING:
    from music_rllib.experiment.plan import Plan
    from music_rllib.results.comparison import Final, Scope
    from music_rllib.results.from_store import Condition
    from music_rllib.store.run_record import RunResult

__all__ = ["EXAMPLES", "compare"]

EXAMPLES = """\
Examples:
  music-rllib compare results/smoke
  music-rllib compare results/smoke --metric evaluation/object_displacement
  music-rllib compare results/search --stage finetune --json

Each row is the mean over the seeds that have finished on every task, with its
95 % interval (docs/reports.md). Runs on the fresh seeds of a search's final
ranking are never mixed with those its trials were chosen by. A condition is
said to be ahead only where an exact permutation test, with Holm's correction
over all pairs, gives p < 0.05 against each other one: three seeds are never
enough. The report says the same.

First comes the answer: conditions by the area under their learning curves (the
mean over the budget), seed by seed where they share seeds, as superior, worse,
equivalent within a margin or undecided (docs/comparing_q.md). What the sweep's
'analysis' planned before the runs is kept apart from what is compared beyond.
"""
IN_THE_SEARCH = "Trials were chosen by these runs, so their order is biased: fresh seeds count."


def compare(
    sweep: Place,
    storage: Storage = None,
    stage: Annotated[
        str | None, typer.Option(metavar="STAGE", help="Of which stage; the last by default.")
    ] = None,
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
    from music_rllib.experiment.location import find_sweep
    from music_rllib.results.claims.answer import answer
    from music_rllib.results.claims.study import study_of
    from music_rllib.results.claims.tables import study_data
    from music_rllib.results.frames.from_storage import results_of
    from music_rllib.results.from_store import conditions, scopes
    from music_rllib.search.ranking import measure_of
    from music_rllib.sweep.views.compare import compare_view

    found = find_sweep(sweep, storage)
    opened = found.open()
    stages = {stage.name: stage for stage in opened.config.stages}
    stage = stage or list(stages)[-1]
    if stage not in stages:
        raise BadInputError(f"--stage must be one of {', '.join(stages)}, got {stage!r}")
    results = opened.results()
    measure = measure_of(stages[stage], opened.plan, results)
    # Without a word about it, each task is judged by its own.
    given, metric = metric, metric or (measure.metric if stages[stage].search else None)
    maximised = not minimize and (measure.maximised or metric != measure.metric)
    found_ = [one for one in conditions(opened.plan, results, metric) if one.stage == stage]
    if not found_ and results and given is not None:
        known = sorted({name for result in results.values() for name in result.metrics})
        if given not in known:
            raise BadInputError(f"--metric must be one of {', '.join(known)}, got {given!r}")
    read = {metric, *(task.primary_metric for one in opened.config.stages for task in one.tasks)}
    stored = results_of(opened, {names.EVAL_EPISODES, *filter(None, read)})
    study = study_of(stored, stage, metric=given, maximised=maximised or given is None)
    entropies = _entropies(opened.plan, results, stage)
    groups = [group for scope in scopes(found_) for group in _groups(scope, maximised, entropies)]
    document = {
        "sweep": found.name,
        "stage": stage,
        "metric": metric or measure.metric,
        "direction": "maximize" if maximised else "minimize",
        "groups": groups,
        "answer": answer(stored, study),
        **study_data(study),
    }
    if json:
        print_json(document)
    else:
        console_for().print(compare_view(document))
    return 0


Entropies = Mapping[tuple[str, str, str], dict[str, dict[str, Any]]]
"""By scope, part and condition: of each entropy, value and interval at the end."""


def _entropies(plan: Plan, results: Mapping[str, RunResult], stage: str) -> Entropies:
    from music_rllib import names
    from music_rllib.results.from_store import conditions, scopes

    found: dict[tuple[str, str, str], dict[str, dict[str, Any]]] = {}
    for metric in names.ENTROPIES:
        of_stage = [one for one in conditions(plan, results, metric) if one.stage == stage]
        for scope in scopes(of_stage):
            for final in scope.finals:
                one, ends = final.condition, final.estimate
                found.setdefault((scope.name, one.part, one.label), {})[metric] = {
                    "value": final.value,
                    "interval": [float(ends.lower), float(ends.upper)],
                }
    return found


def _groups(
    scope: Scope[Condition], maximised: bool, entropies: Entropies
) -> Iterator[dict[str, Any]]:
    """What is compared on a task; apart from it the runs that a search's trials were chosen by."""
    from music_rllib.results.comparison import verdict

    fresh = any(final.condition.part == "final" for final in scope.compared)
    chosen = [final for final in scope.finals if final not in scope.compared]
    parts = (
        (scope.compared, "on fresh seeds" if fresh else "", verdict(scope, maximised=maximised)),
        (chosen, "in the search", [IN_THE_SEARCH]),
    )
    for finals, part, said in parts:
        if finals:
            yield {
                "part": part,
                "tasks": scope.name,
                "metric": scope.metric,
                "conditions": list(_rows(scope, finals, maximised, entropies)),
                "verdict": " ".join(said),
            }


def _rows(
    scope: Scope[Condition],
    finals: Sequence[Final[Condition]],
    maximised: bool,
    entropies: Entropies,
) -> Iterator[dict[str, Any]]:
    """The best first, each with what tells it from the best."""
    from music_rllib.results.statistics import difference

    ordered = sorted(finals, key=lambda final: final.value, reverse=maximised)
    best = ordered[0]
    for final in ordered:
        one, estimate = final.condition, final.estimate
        row = {
            "stage": one.stage,
            "values": dict(one.values),
            "label": one.label,
            "on_fresh_seeds": one.part == "final",
            "value": final.value,
            "interval": [float(estimate.lower), float(estimate.upper)],
            "seeds": final.scores.mean(axis=1).tolist(),
            "runs": final.runs,
            "planned": len(one.seeds) * scope.tasks,
            "gap": None,
            "gap_interval": None,
            "best_is_better_with": None,
            "p_value": None,
            "entropies": entropies.get((scope.name, one.part, one.label), {}),
        }
        pair = next((p for p in scope.comparisons if {p.first, p.second} == {best, final}), None)
        if pair is not None:
            gap = difference(best.estimate, estimate)
            higher = float(pair.estimate.value)
            row |= {
                "gap": float(gap.value),
                "gap_interval": [float(gap.lower), float(gap.upper)],
                "best_is_better_with": higher if (pair.first is best) == maximised else 1 - higher,
                "p_value": pair.p_value,
            }
        yield row
