"""Which conditions a hypothesis is about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from music_rllib import names
from music_rllib.config.analysis import Hypothesis
from music_rllib.results.conditions import ENTROPIC_INDEX, Condition, Stage
from music_rllib.results.data import Sweep

__all__ = ["alike_in_the_rest", "in_words", "matching"]

_TAGS = {
    "tac.entropic_index": names.TAG_ENTROPIC_INDEX,
    "tac.alpha": names.TAG_ALPHA,
    "music.mi_reward_weight": names.TAG_MI_REWARD_WEIGHT,
}
"""Settings that may be schedules: a tag says each in words."""
_WORDS = {
    "tac.entropic_index": ENTROPIC_INDEX,
    "tac.alpha": "α",
    "music.mi_reward_weight": "MI weight",
}


def in_words(side: Mapping[str, str]) -> str:
    """One side of a hypothesis as labels have it: `q = 1.5, α = 0.1`."""
    return ", ".join(f"{_word(name)} = {value}" for name, value in side.items())


def _word(name: str) -> str:
    """Parts of a setting go by its word: `tac.alpha.value` is α."""
    found = (word for whole, word in _WORDS.items() if f"{name}.".startswith(f"{whole}."))
    return next(found, name)


def matching(
    sweep: Sweep, stages: Mapping[str, Stage], side: Mapping[str, str], stage: str
) -> list[Condition]:
    """Conditions that have all settings of one side; of a search those on fresh seeds."""
    found = stages.get(side.get("stage", stage))
    if found is None:
        return []
    wanted = [(name, value) for name, value in side.items() if name != "stage"]
    return [one for one in found.compared if all(_has(sweep, one, name, v) for name, v in wanted)]


def _has(sweep: Sweep, condition: Condition, name: str, value: str) -> bool:
    run = sweep.runs[condition.runs[0]]
    known = (run.params.get(name), run.tags.get(_TAGS.get(name, "")))
    return any(_same(value, one) for one in known if one is not None)


def _same(one: str, other: str) -> bool:
    try:
        return float(one) == float(other)
    except ValueError:
        return one == other


def alike_in_the_rest(
    first: Sequence[Condition], second: Sequence[Condition], hypothesis: Hypothesis
) -> list[tuple[Condition, Condition]] | str:
    """Pairs of conditions that differ only in what the hypothesis names.

    One against one is a pair, whatever else they differ in: each value of q may have been given
    its own α.

    Returns:
        Or in words why there are none.
    """
    for side, text in ((first, hypothesis.first), (second, hypothesis.second)):
        if not side:
            return f"no run of {in_words(text)} has begun that may be compared"
    if len(first) == len(second) == 1:
        return [(first[0], second[0])]
    named = {_word(name) for name in (*hypothesis.first, *hypothesis.second)}
    rests = [{_rest(one, named): one for one in side} for side in (first, second)]
    pairs = [(one, rests[1][rest]) for rest, one in rests[0].items() if rest in rests[1]]
    if not pairs or len(rests[0]) < len(first) or len(rests[1]) < len(second):
        return (
            f"{len(first)} and {len(second)} conditions have these settings, and no pairs of them "
            "are alike in the rest: it must name more"
        )
    return pairs


def _rest(condition: Condition, named: set[str]) -> tuple[tuple[str, str], ...]:
    settings = ((ENTROPIC_INDEX, condition.entropic_index), *condition.others)
    return tuple(pair for pair in settings if pair[0] not in named)
