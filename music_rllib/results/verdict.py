"""What may be said in words. A winner is named only where the evidence is there."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from music_rllib.results.analysis import ALL_TASKS, Final, Scope
from music_rllib.results.statistics import Estimate, seeds_to_decide

__all__ = ["interval_text", "p_text", "verdict"]

POWER = 0.8


def verdict(scope: Scope, difference: float) -> list[str]:
    """Sentences about one scope: who is ahead, or why nobody is, and what would tell.

    Args:
        scope: with its comparisons.
        difference: in success rate, which the reader would want to be able to see.
    """
    where = "over all tasks together" if scope.name == ALL_TASKS else f"on {scope.name}"
    if not scope.finals:
        return [f"No condition has finished {where}: there is nothing to compare yet."]
    if not scope.compared:
        return [
            f"Nothing is ranked {where}: no trial of the search has finished on fresh seeds. On "
            "those that they are chosen by, trials are not compared: the best is so by luck, too."
        ]
    if len(scope.compared) == 1:
        only = scope.compared[0]
        return [f"Only one condition has finished {where}, so nothing is compared: {_said(only)}."]
    return [_ranking(scope, where), *_how_many_seeds(scope, difference)]


def _ranking(scope: Scope, where: str) -> str:
    best = max(scope.compared, key=lambda final: float(final.estimate.value))
    own = [pair for pair in scope.comparisons if best in (pair.first, pair.second)]
    open_pairs = [pair for pair in own if not pair.decided]
    if not open_pairs:
        worst = max(pair.p_value for pair in own)
        return (
            f"{best.condition.label} is ahead {where}: {_said(best)}. Its interval overlaps with "
            f"no other, and so large a gap comes by chance with {p_text(worst)} at most "
            f"(permutation test, Holm's correction)."
        )
    lonely = [final for final in scope.compared if final.seeds < 2]
    if lonely:
        every = len(lonely) == len(scope.compared)
        have = "has" if every or len(lonely) == 1 else "have"
        which = "every condition" if every else _names(lonely)
        return (
            f"No winner {where}: {which} {have} a single seed, so there is no interval and no "
            f"evidence. Highest so far is {_said(best)}."
        )
    rivals = [pair.second if pair.first is best else pair.first for pair in open_pairs]
    if any(pair.overlaps for pair in open_pairs):
        overlapping = [r for r, pair in zip(rivals, open_pairs, strict=True) if pair.overlaps]
        reason = f"the interval overlaps with that of {_names(overlapping)}"
    else:
        p_value = max(pair.p_value for pair in open_pairs)
        reason = (
            f"although the intervals do not overlap, from so few seeds the gap to "
            f"{_names(rivals)} may be chance ({p_text(p_value)}, permutation test)"
        )
    return f"No winner {where}: {_said(best)} is highest, but {reason}."


def _how_many_seeds(scope: Scope, difference: float) -> list[str]:
    """Where something is undecided: the seeds that would likely decide it."""
    if all(pair.decided for pair in scope.comparisons):
        return []
    seeds = min(final.seeds for final in scope.compared)
    if scope.spread is None:
        return ["How many seeds would decide it can be estimated from two seeds on."]
    if scope.spread == 0:
        return [
            "All seeds ended alike, so their spread, and the seeds needed, cannot be estimated."
        ]
    needed = seeds_to_decide(difference, scope.spread, tasks=scope.tasks, power=POWER)
    if needed is None:
        outcome = "more than 1000 seeds per condition would be needed"
    elif needed <= seeds:
        outcome = f"the {seeds} seeds per condition that there are would mostly show it"
    else:
        outcome = (
            f"about {needed} seeds per condition would show it with {POWER * 100:.0f} % chance, "
            f"{needed - seeds} more than now"
        )
    return [
        f"Seeds of the same condition differ by {scope.spread:.2f} (standard deviation). For a "
        f"difference of {difference:.2f} in success rate, {outcome} (t test, one comparison)."
    ]


def interval_text(estimate: Estimate) -> str:
    """`0.62 to 0.81`, or that there is none."""
    if not estimate.has_interval:
        return "no interval"
    return f"{float(estimate.lower):.2f} to {float(estimate.upper):.2f}"


def p_text(p_value: float) -> str:
    """`p = 0.03`."""
    return "p < 0.001" if p_value < 0.001 else f"p = {p_value:.2g}"


def _said(final: Final) -> str:
    seeds = "1 seed" if final.seeds == 1 else f"{final.seeds} seeds"
    return (
        f"{final.condition.label} with {float(final.estimate.value):.2f} "
        f"({interval_text(final.estimate)}, {seeds})"
    )


def _names(finals: Iterable[Final]) -> str:
    return _and([final.condition.label for final in finals])


def _and(words: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))
