"""What a sweep's searches found, as tables of text, from what their driver keeps of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from music_rllib.report.pieces import TextTable

__all__ = ["search_in_words", "search_tables"]

Entry = Mapping[str, Any]
"""One search, one of its arms, trials or ranked settings, as in `search.json`."""
DASH = "–"


def search_in_words(search: Entry) -> str:
    """How it searched, in a sentence."""
    trials = [trial for arm in search["arms"] for trial in arm["trials"]]
    counts = ", ".join(
        f"{count} {state}"
        for state in ("judged", "pruned", "failed")
        if (count := sum(trial["state"] == state for trial in trials))
    )
    aims = " and ".join(f"{one['direction']} {one['name']}" for one in search["objectives"])
    return f"{search['mode'].capitalize()} ({search['sampler']}): {aims}; trials: {counts}."


def search_tables(search: Entry) -> Iterator[TextTable]:
    """The ranking on fresh seeds, what each setting matters, and every trial."""
    settings = _settings(search)
    aims = [one["name"] for one in search["objectives"]]
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
                *_chosen(trial["values"], settings),
                trial["state"],
                *_values(trial.get("objective"), trial.get("interval"), len(aims)),
                trial["reason"] or "",
            )
            for arm in search["arms"]
            for trial in arm["trials"]
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
                *_chosen(row["values"], settings),
                *_values(row.get("fresh"), row.get("interval"), len(aims)),
                *_of_seeds(row),
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


def _of_seeds(row: Entry) -> tuple[str, str, str]:
    if "failure" in row:
        return "", "", f"failed: {row['failure']}"
    better = row.get("best_is_better_with")
    chosen = ", ".join(_number(value) for value in row.get("searched") or ())
    return (
        str(len(row["scores"][0])),
        chosen or DASH,
        DASH if better is None else _percent(better),
    )


def _settings(search: Entry) -> list[str]:
    return list(
        dict.fromkeys(
            name for arm in search["arms"] for trial in arm["trials"] for name in trial["values"]
        )
    )


def _chosen(values: Mapping[str, Any], settings: Iterable[str]) -> Iterator[str]:
    return (_text(values.get(name)) for name in settings)


def _with_intervals(aims: Iterable[str]) -> Iterator[str]:
    for aim in aims:
        yield aim
        yield "95 % interval"


def _values(
    values: Sequence[float | None] | None, intervals: Sequence[Any] | None, count: int
) -> Iterator[str]:
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
