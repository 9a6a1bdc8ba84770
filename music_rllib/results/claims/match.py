"""Conditions of a sweep that a hypothesis is about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from music_rllib.config.analysis import Hypothesis, parsed
from music_rllib.config.problems import same
from music_rllib.results.conditions import (
    ENTROPIC_INDEX,
    IN_WORDS,
    Condition,
    Stage,
    Values,
    whole_setting,
)
from music_rllib.results.data import RunRecord, Sweep


def in_words(side: Mapping[str, str]) -> str:
    """One side of a hypothesis as labels have it: `q = 1.5, α = 0.1`."""
    return ", ".join(f"{_label(name)} = {value}" for name, value in side.items())


def _label(name: str) -> str:
    """The label of a setting or of a part of it: `tac.alpha.value` is α."""
    return IN_WORDS.get(whole_setting(name), (name, ""))[0]


def matching(
    sweep: Sweep, stages: Mapping[str, Stage], side: Mapping[str, str], stage: str
) -> list[Condition]:
    """Conditions that may be compared and have all settings of one side of a hypothesis."""
    settings = dict(side)
    chosen = stages.get(settings.pop("stage", stage))
    return [
        condition
        for condition in (chosen.compared if chosen else ())
        if all(_has(sweep.runs[condition.runs[0]], *setting) for setting in settings.items())
    ]


def _has(run: RunRecord, name: str, value: str) -> bool:
    _, tag = IN_WORDS.get(name, ("", ""))
    known = (run.params.get(name), run.tags.get(tag))
    return any(_same(value, other) for other in known if other is not None)


def _same(one: str, other: str) -> bool:
    return one == other or same(parsed(one), parsed(other))


def alike_in_the_rest(
    first: Sequence[Condition], second: Sequence[Condition], hypothesis: Hypothesis
) -> list[tuple[Condition, Condition]] | str:
    """Pairs of conditions that differ only in what the hypothesis names.

    One against one is a pair, whatever else they differ in: each value of q may have been given
    its own α.

    Returns:
        The pairs, or in words why there are none.
    """
    for side, settings in ((first, hypothesis.first), (second, hypothesis.second)):
        if not side:
            return f"no run of {in_words(settings)} has begun that may be compared"
    if len(first) == len(second) == 1:
        return [(first[0], second[0])]
    named = {_label(name) for name in (*hypothesis.first, *hypothesis.second)}
    firsts, seconds = (
        {_rest(condition, named): condition for condition in side} for side in (first, second)
    )
    pairs = [(one, seconds[rest]) for rest, one in firsts.items() if rest in seconds]
    if not pairs or len(firsts) < len(first) or len(seconds) < len(second):
        return (
            f"{len(first)} and {len(second)} conditions have these settings, and no pairs of them "
            "are alike in the rest: it must name more"
        )
    return pairs


def _rest(condition: Condition, named: set[str]) -> Values:
    """The condition's settings that the hypothesis does not name."""
    settings = ((ENTROPIC_INDEX, condition.entropic_index), *condition.others)
    return tuple(pair for pair in settings if pair[0] not in named)
