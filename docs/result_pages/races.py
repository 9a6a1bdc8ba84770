"""Who gets to a success rate sooner."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

from docs.result_pages.words import THRESHOLD, row, rule, spread
from music_rllib.results.conditions import Stage, find_stages
from music_rllib.results.data import Sweep
from music_rllib.results.time_to_threshold import races


def races_table(sweep: Sweep, *stages: str) -> Iterator[str]:
    """Who gets to the threshold sooner, each condition against each, also between stages."""
    groups: dict[str, Sequence[int]] = {}
    for stage in _some(sweep, stages):
        for condition in stage.conditions:
            several = len(stage.conditions) > 1
            name = f"{stage.name}, {condition.label}" if several else stage.name
            groups[name] = condition.runs
    yield from _races(sweep, lambda _: (groups,))


def effects_table(sweep: Sweep, *stages: str) -> Iterator[str]:
    """The same of each stage over q, and of each q over the stages.

    On each task over the q that all stages have there, and the stages that all q have: otherwise
    what differs would be the stage, too.
    """

    def questions(task: str) -> tuple[Groups, Groups]:
        cells: dict[tuple[str, str], list[int]] = {}
        for stage in _some(sweep, stages):
            for condition in stage.conditions:
                if there := [run for run in condition.runs if sweep.runs[run].task == task]:
                    cells.setdefault((stage.name, condition.entropic_index), []).extend(there)
        return (
            _balanced(cells, lambda stage, q: (stage, f"q = {q}")),
            _balanced(cells, lambda stage, q: (f"q = {q}", stage)),
        )

    yield from _races(sweep, questions)


Groups = dict[str, Sequence[int]]


def _balanced(
    cells: Mapping[tuple[str, str], Sequence[int]], name: Callable[[str, str], tuple[str, str]]
) -> Groups:
    """Runs by the first part of their cell's name, over those second parts that all first have."""
    by_group: dict[str, dict[str, Sequence[int]]] = {}
    for cell, runs in cells.items():
        group, part = name(*cell)
        by_group.setdefault(group, {})[part] = runs
    shared = [
        part
        for part in dict.fromkeys(part for parts in by_group.values() for part in parts)
        if all(part in parts for parts in by_group.values())
    ]
    over = ", ".join(shared)
    return {
        f"{group} ({over})": [run for part in shared for run in parts[part]]
        for group, parts in by_group.items()
        if shared
    }


def _some(sweep: Sweep, stages: Sequence[str]) -> list[Stage]:
    return [stage for stage in find_stages(sweep) if not stages or stage.name in stages]


def _races(sweep: Sweep, questions: Callable[[str], Iterable[Groups]]) -> Iterator[str]:
    """On each task, of each question all pairs of its groups, corrected for their number."""
    yield row("task", "sooner at", "than", "runs", "probability [95 %]", "p", "decided")
    yield rule(7)
    for task in dict.fromkeys(run.task for run in sweep.runs):
        for groups in questions(task):
            for race in races(sweep, task, groups, THRESHOLD):
                yield row(
                    race.task,
                    race.first,
                    race.second,
                    " / ".join(map(str, race.runs)),
                    spread(race.estimate) if race.reached else "not reached by either",
                    f"{race.p_value:.2g}" if race.reached else "",
                    "yes" if race.decided else "no",
                )
