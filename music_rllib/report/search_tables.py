"""The results of a sweep's searches as tables of text, from the entries of `search.json`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from music_rllib.report.pieces import DASH, TextTable

Entry = Mapping[str, Any]
"""A search in `search.json`, or one of its arms, trials or ranked settings."""


def search_in_words(search: Entry) -> str:
    """A sentence with the search's mode, sampler, objectives and numbers of trials."""
    states = [trial["state"] for arm in search["arms"] for trial in arm["trials"]]
    counts = ", ".join(
        f"{states.count(state)} {state}"
        for state in ("judged", "pruned", "failed")
        if state in states
    )
    aims = " and ".join(f"{aim['direction']} {aim['name']}" for aim in search["objectives"])
    return f"{search['mode'].capitalize()} ({search['sampler']}): {aims}; trials: {counts}."


def search_tables(search: Entry) -> Iterator[TextTable]:
    """The ranking on fresh seeds, the importance of each setting, and every trial."""
    trials = [trial for arm in search["arms"] for trial in arm["trials"]]
    settings = list(dict.fromkeys(name for trial in trials for name in trial["values"]))
    aims = [aim["name"] for aim in search["objectives"]]
    if search["ranking"]:
        yield _ranking(search["ranking"], settings, aims)
    for arm in search["arms"]:
        if arm["importance"]:
            yield _importance(arm)
    yield TextTable(
        title="Trials",
        note="Each on the search's own seeds: the best of them is so by luck, too.",
        header=("Trial", *settings, "State", *_with_intervals(aims), "Why it was stopped"),
        rows=[
            (
                str(trial["number"]),
                *(_text(trial["values"].get(name)) for name in settings),
                trial["state"],
                *_values(trial.get("objective"), trial.get("interval"), len(aims)),
                trial["reason"] or "",
            )
            for trial in trials
            if trial["state"] != "waiting"
        ],
    )


def _ranking(ranking: Sequence[Entry], settings: Sequence[str], aims: Sequence[str]) -> TextTable:
    return TextTable(
        title="Ranking on fresh seeds",
        note="Settings trained again with seeds that the search has not seen, so that no choice "
        "flatters them. The last column: the chance that a run of the best one ends above a run of "
        "this one.",
        header=(
            *("Rank", "Trial", *settings, *_with_intervals(aims)),
            *("Seeds", "When chosen", "Best is better with"),
        ),
        rows=[
            (
                str(place),
                _text(row["trial"]),
                *(_text(row["values"].get(name)) for name in settings),
                *_values(row.get("fresh"), row.get("interval"), len(aims)),
                *_seeds_and_chance(row),
            )
            for place, row in enumerate(ranking, start=1)
        ],
    )


def _importance(arm: Entry) -> TextTable:
    values = ", ".join(f"{name} = {_text(value)}" for name, value in arm["values"].items())
    return TextTable(
        title=f"Importance of the settings{values and f' at {values}'}",
        note="Share of the objective's variance over the judged trials (functional ANOVA).",
        header=("Setting", "Share"),
        rows=[(name, _percent(share)) for name, share in arm["importance"].items()],
    )


def _seeds_and_chance(row: Entry) -> tuple[str, str, str]:
    """A ranked setting's number of seeds, its objectives in the search, and its chance to lose."""
    if "failure" in row:
        return "", "", f"failed: {row['failure']}"
    better = row.get("best_is_better_with")
    chosen = ", ".join(_number(value) for value in row.get("searched") or ())
    chance = DASH if better is None else _percent(better)
    return str(len(row["scores"][0])), chosen or DASH, chance


def _with_intervals(aims: Sequence[str]) -> Iterator[str]:
    for aim in aims:
        yield from (aim, "95 % interval")


def _values(
    values: Sequence[float | None] | None, intervals: Sequence[Any] | None, count: int
) -> Iterator[str]:
    """The value and the interval of each of `count` objectives; empty texts where unknown."""
    for aim in range(count):
        yield _number(values[aim]) if values else ""
        low, high = intervals[aim] if intervals else (None, None)
        yield "" if low is None or high is None else f"{_number(low)} to {_number(high)}"


def _number(value: float | None) -> str:
    return DASH if value is None else f"{value:.2f}" if abs(value) < 100 else f"{value:,.0f}"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _text(value: object) -> str:
    if value is None:
        return DASH
    return f"{value:.4g}" if isinstance(value, float) else str(value)
