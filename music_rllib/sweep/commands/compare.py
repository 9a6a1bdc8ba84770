"""`compare`: conditions side by side, with intervals."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from music_rllib.sweep.frame import (
    BadInputError,
    Commands,
    add_json,
    add_place,
    console_for,
    print_json,
)

__all__ = ["register"]

EPILOG = """\
examples:
  python -m music_rllib.sweep compare results/smoke
  python -m music_rllib.sweep compare results/smoke --metric evaluation/object_displacement
  python -m music_rllib.sweep compare results/search --stage finetune --json

Each row is the interquartile mean over tasks and seeds with its 95 % stratified-bootstrap interval.
Runs on the fresh seeds of a search's final ranking are never mixed with those its trials were
chosen by. A condition is said to be ahead only where its interval overlaps with no other and a
permutation test (Holm's correction) gives p < 0.05 against each: three seeds are never enough.
"""


def register(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "compare",
        help="values of q, or whatever a sweep varies, side by side with intervals",
        description="What a sweep varies, such as q, side by side with 95 % intervals.",
        epilog=EPILOG,
    )
    add_place(parser)
    parser.add_argument("--stage", help="Of which stage; the last one by default.")
    parser.add_argument(
        "--metric",
        help="A run's last value of it. Without it: what a searched stage's objective reads, else "
        "evaluation/success_rate, or evaluation/episode_return where tasks have no success.",
    )
    parser.add_argument(
        "--minimize",
        action="store_true",
        help="The metric is better where it is lower, as that of an objective that says so is.",
    )
    add_json(parser)
    parser.set_defaults(execute=_execute)


def _execute(arguments: argparse.Namespace) -> int:
    from music_rllib.sweep.compare_view import compare_view
    from music_rllib.sweep.conditions import compared, conditions
    from music_rllib.sweep.find import find_sweep
    from music_rllib.sweep.judgement import measure_of

    found = find_sweep(arguments.sweep, arguments.storage)
    sweep = found.open()
    stages = {stage.name: stage for stage in sweep.config.stages}
    stage = arguments.stage or list(stages)[-1]
    if stage not in stages:
        raise BadInputError(f"--stage must be one of {', '.join(stages)}, got {stage!r}")
    results = sweep.results()
    measure = measure_of(stages[stage], sweep.plan, results)
    metric = arguments.metric or measure.metric
    maximised = not arguments.minimize and (measure.maximised or metric != measure.metric)
    everything = conditions(sweep.plan, results, metric)
    of_stage = [one for one in everything if one.stage == stage]
    if not of_stage and results and arguments.metric is not None:
        known = sorted({name for result in results.values() for name in result.metrics})
        if arguments.metric not in known:
            raise BadInputError(
                f"--metric must be one of {', '.join(known)}, got {arguments.metric!r}"
            )
    groups: list[dict[str, Any]] = []
    for part, title in (("", ""), ("final", "on fresh seeds"), ("search", "in the search")):
        rows = compared([one for one in of_stage if one.part == part], maximised=maximised)
        if rows:
            groups.append({"part": title, "conditions": rows, "verdict": verdict(rows, part)})
    document = {
        "sweep": found.name,
        "stage": stage,
        "metric": metric,
        "direction": "maximize" if maximised else "minimize",
        "groups": groups,
    }
    if arguments.json:
        print_json(document)
    else:
        console_for(arguments).print(compare_view(document))
    return 0


def verdict(rows: Sequence[dict[str, Any]], part: str) -> str:
    """What intervals and permutation tests allow to be said."""
    from music_rllib.results.statistics import SIGNIFICANCE

    if part == "search":
        return "Trials were chosen by these runs, so their order is biased: fresh seeds count."
    if len(rows) < 2:
        return "There is nothing to compare it with."
    if min(row["runs"] for row in rows) < 2:
        return "A condition with a single run has no interval: nothing can be said yet."
    if any(row["overlaps_best"] for row in rows[1:]):
        return "Intervals overlap with that of the first: no winner. More seeds may tell."
    p_values = [row["p_value"] for row in rows[1:]]
    if any(p is None for p in p_values):
        return "Not every condition has finished on the same tasks: no winner yet."
    if max(p_values) >= SIGNIFICANCE:
        return (
            "No intervals overlap with that of the first, but from so few seeds the gap may be "
            f"chance (p = {max(p_values):.2g}, permutation test): no winner. More seeds may tell."
        )
    return (
        f"{rows[0]['label']} is ahead: its interval overlaps with no other, and so large a gap "
        f"comes by chance with p = {max(p_values):.2g} at most (permutation test)."
    )
