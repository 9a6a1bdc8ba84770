"""Conditions of a sweep: runs that differ in their task and seed only.

Conditions are told apart by the settings that vary between a stage's runs on the same task, and by
those of the runs that they start from. The number of a trial does not count: it changes when a
sweep is extended.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations

from music_rllib import names
from music_rllib.config.schema import Hypothesis, same_value
from music_rllib.results.data import RunRecord, Sweep

Values = tuple[tuple[str, str], ...]
"""(setting, value) pairs."""

ENTROPIC_INDEX = "q"
ALPHA = "α"
ALL_TASKS = "all tasks"
AVERAGED = {*names.EVAL_RATES, *names.ENTROPIES}
"""Metrics with the same unit on every task, which can be averaged over tasks."""
SIDE_BY_SIDE = "stages side by side"
OF_TASK = "q of each task"
"""Label of the only condition of a stage whose tasks have different q."""
SEEDS, FRESH, SEARCHED = "seeds", "fresh", "search"
"""Setting of a search's conditions, and its values: fresh seeds, and the seeds of the trials."""
IN_WORDS = {
    "tac.entropic_index": (ENTROPIC_INDEX, names.TAG_ENTROPIC_INDEX),
    "tac.alpha": (ALPHA, names.TAG_ALPHA),
    "music.mi_reward_weight": ("MI weight", names.TAG_MI_REWARD_WEIGHT),
}
"""Settings that can be schedules and then span several params: label, and tag with the words."""
MOST_CONDITIONS = 6
"""Number of conditions up to which all pairs are compared; otherwise each with a reference."""
_OWN_SETTINGS = "intrinsic.settings."
"""Beginning of the settings of an intrinsic reward. A run has only those that are given."""


@lru_cache(maxsize=1024)  # otherwise a third of the time of `find_stages`
def whole_setting(param: str) -> str:
    """The setting that a param belongs to: `tac.alpha` for `tac.alpha.value`, else `param`."""
    wholes = (setting for setting in IN_WORDS if f"{param}.".startswith(f"{setting}."))
    return next(wholes, param)


@dataclass(frozen=True, kw_only=True)
class Condition:
    """Runs that differ in their task and seed only."""

    entropic_index: str
    """q in words, which decides the color; empty if the runs have several."""
    others: Values
    """Other settings that tell the condition apart in its stage."""
    runs: tuple[int, ...]

    @property
    def is_fresh(self) -> bool:
        return (SEEDS, FRESH) in self.others

    @property
    def label(self) -> str:
        """`q = 1.5, α = 0.1`."""
        pairs = ((ENTROPIC_INDEX, self.entropic_index), *self.others)
        return ", ".join(f"{name} = {value}" for name, value in pairs if value) or OF_TASK

    @property
    def short_label(self) -> str:
        """The label without the seeds of a search, of which only the fresh ones are compared."""
        others = tuple(pair for pair in self.others if pair[0] != SEEDS)
        return replace(self, others=others).label


@dataclass(frozen=True, kw_only=True)
class StageRuns:
    """The runs of one stage as conditions, by increasing q."""

    name: str
    variant: str
    tasks: tuple[str, ...]
    seeds: tuple[str, ...]
    conditions: tuple[Condition, ...]
    runs: tuple[int, ...]

    @property
    def is_search(self) -> bool:
        return any(name == SEEDS for one in self.conditions for name, _ in one.others)

    @property
    def compared(self) -> tuple[Condition, ...]:
        """Conditions that may be compared: in a search, only those on fresh seeds.

        Selection biases the best of a search's trials upwards on the seeds that selected it.
        """
        return tuple(one for one in self.conditions if (SEEDS, SEARCHED) not in one.others)

    @property
    def compared_runs(self) -> list[int]:
        """The runs of `compared`."""
        return [run for condition in self.compared for run in condition.runs]

    @property
    def has_task_reward(self) -> bool:
        return self.variant not in {"music-u", "intrinsic-u"}


def stages_together(stages: Sequence[StageRuns]) -> StageRuns | None:
    """One stage with the conditions of all that train for the task; None for fewer than two."""
    stages = [stage for stage in stages if stage.has_task_reward]
    if len(stages) < 2:
        return None
    return StageRuns(
        name=SIDE_BY_SIDE,
        variant=" and ".join(dict.fromkeys(stage.variant for stage in stages)),
        tasks=tuple(dict.fromkeys(task for stage in stages for task in stage.tasks)),
        seeds=tuple(sorted({seed for stage in stages for seed in stage.seeds}, key=sorting_key)),
        runs=tuple(run for stage in stages for run in stage.runs),
        conditions=tuple(
            replace(condition, others=(("stage", stage.name), *condition.others))
            for stage in stages
            for condition in stage.conditions
        ),
    )


def find_stages(sweep: Sweep) -> list[StageRuns]:
    """The sweep's stages, in the order of their first runs."""
    stages: defaultdict[str, list[int]] = defaultdict(list)
    for position, run in enumerate(sweep.runs):
        stages[run.stage].append(position)
    settings = _all_settings(sweep.runs)
    varying = {
        name: _varying([(sweep.runs[run].task, settings[run]) for run in runs])
        for name, runs in stages.items()
    }
    by_key = {run.node_key: position for position, run in enumerate(sweep.runs)}

    def varied_values(run: int, before: tuple[int, ...] = ()) -> Values:
        """Values that vary in the run's stage, and in the stage of the run that it starts from."""
        record = sweep.runs[run]
        own = tuple((n, settings[run][n]) for n in varying[record.stage] if n in settings[run])
        if part := record.tags.get(names.TAG_PART):
            own += ((SEEDS, FRESH if part.startswith("final") else SEARCHED),)
        source = by_key.get(record.tags.get(names.TAG_SOURCE_NODE, ""))
        if source is None or source in (run, *before):  # a stranger's export can have a cycle
            return own
        stage = sweep.runs[source].stage
        of_source = (
            (name if ":" in name else f"{stage}: {name}", value)
            for name, value in varied_values(source, (run, *before))
        )
        return (*own, *of_source)

    return [
        _stage(sweep.runs, name, runs, {run: varied_values(run) for run in runs})
        for name, runs in stages.items()
    ]


def _stage(
    records: Sequence[RunRecord], name: str, runs: Sequence[int], values: Mapping[int, Values]
) -> StageRuns:
    groups: defaultdict[Values, list[int]] = defaultdict(list)
    for run in runs:
        groups[values[run]].append(run)
    found: list[tuple[tuple[str, Values], list[int]]] = []
    for settings, members in groups.items():
        others = dict(settings)
        of_tasks = {records[run].entropic_index for run in members}  # each task can have its own
        q = others.pop(ENTROPIC_INDEX, of_tasks.pop() if len(of_tasks) == 1 else "")
        found.append(((q, tuple(others.items())), members))
    ordered = sorted(found, key=lambda item: _order(*item[0]))
    return StageRuns(
        name=name,
        variant=records[runs[0]].variant,
        tasks=tuple(dict.fromkeys(records[run].task for run in runs)),
        seeds=tuple(sorted({records[run].seed for run in runs}, key=sorting_key)),
        runs=tuple(runs),
        conditions=tuple(
            Condition(entropic_index=q, others=others, runs=tuple(members))
            for (q, others), members in ordered
        ),
    )


def _order(q: str, others: Values) -> tuple[object, ...]:
    return sorting_key(q), tuple((name, sorting_key(value)) for name, value in others)


def _varying(runs: Sequence[tuple[str, Mapping[str, str]]]) -> list[str]:
    """Settings with more than one value on the same task, from (task, settings) pairs.

    A setting that is a number in one run and a mapping in another has no name in common.
    """
    values: defaultdict[tuple[str, str], set[str]] = defaultdict(set)
    forms: defaultdict[tuple[str, str], set[frozenset[str]]] = defaultdict(set)
    for task, settings in runs:
        parts: defaultdict[str, list[str]] = defaultdict(list)
        for name, value in settings.items():
            values[task, name].add(value)
            parts[_field(name)].append(name)
        for field, own in parts.items():
            forms[task, field].add(frozenset(own))
    varying = {name for (_, name), seen in values.items() if len(seen) > 1}
    for seen in forms.values():
        if not frozenset.intersection(*seen):
            varying |= frozenset.union(*seen)
    alike: defaultdict[tuple[str, str | None], list[frozenset[str]]] = defaultdict(list)
    for task, settings in runs:  # the default of a reward's setting has no value here
        of_run = frozenset(name for name in settings if name.startswith(_OWN_SETTINGS))
        alike[task, settings.get("intrinsic.reward")].append(of_run)
    for given in alike.values():
        varying |= frozenset.union(*given) - frozenset.intersection(*given)
    return sorted(varying)


@lru_cache(maxsize=1024)
def _field(name: str) -> str:
    """The field of a section that a param belongs to: `tac.behaviour` for `tac.behaviour.kind`."""
    return ".".join(name.split(".")[:2])


def _all_settings(records: Sequence[RunRecord]) -> list[dict[str, str]]:
    """The settings of each run; words with several meanings are followed by the full value."""
    of_runs = [_settings(record) for record in records]
    meanings: defaultdict[tuple[str, str], set[str]] = defaultdict(set)
    for settings in of_runs:
        for name, (words, full) in settings.items():
            meanings[name, words].add(full)
    return [
        {
            name: words if len(meanings[name, words]) == 1 else f"{words} ({full})"
            for name, (words, full) in settings.items()
        }
        for settings in of_runs
    ]


def _settings(run: RunRecord) -> dict[str, tuple[str, str]]:
    """Settings that can tell conditions apart, in words and in full; not the seed or the task."""
    words: dict[str, str] = {}
    full: defaultdict[str, list[str]] = defaultdict(list)
    for param, value in sorted(run.params.items()):
        if param != "seed" and not param.startswith("task."):
            whole = whole_setting(param)
            name, tag = IN_WORDS.get(whole, (param, ""))
            words[name] = run.tags.get(tag, value)
            full[name].append(f"{param.removeprefix(whole).removeprefix('.')} {value}".strip())
    return {name: (words[name], ", ".join(full[name])) for name in words}


def sorting_key(text: str) -> tuple[float, str]:
    """Sorting key: numbers by size, a schedule by its first value, other words last."""
    try:
        return float(text.split(" ")[0]), text
    except ValueError:
        return float("inf"), text


# Conditions of a hypothesis -----------------------------------------------------------------------


def settings_in_words(side: Mapping[str, str]) -> str:
    """One side of a hypothesis: `q = 1.5, α = 0.1`."""
    return ", ".join(f"{_label(name)} = {value}" for name, value in side.items())


def _label(name: str) -> str:
    """The label of a setting or of a part of it: `tac.alpha.value` is α."""
    return IN_WORDS.get(whole_setting(name), (name, ""))[0]


def matching(
    sweep: Sweep, stages: Mapping[str, StageRuns], side: Mapping[str, str], stage: str
) -> list[Condition]:
    """Conditions that may be compared and have all settings of one side of a hypothesis."""
    settings = dict(side)
    chosen = stages.get(settings.pop("stage", stage))

    def has_all(condition: Condition) -> bool:
        of_tasks = {sweep.runs[run].task: sweep.runs[run] for run in condition.runs}
        return all(_has(run, *one) for run in of_tasks.values() for one in settings.items())

    return [one for one in (chosen.compared if chosen else ()) if has_all(one)]


def _has(run: RunRecord, name: str, value: str) -> bool:
    _, tag = IN_WORDS.get(name, ("", ""))
    known = [text for text in (run.params.get(name), run.tags.get(tag)) if text is not None]
    return any(same_value(value, text) for text in known)


def pairs_of_hypothesis(
    first: Sequence[Condition], second: Sequence[Condition], hypothesis: Hypothesis
) -> list[tuple[Condition, Condition]] | str:
    """Pairs of conditions that differ only in a hypothesis's settings, or why there are none.

    A single condition on each side is a pair even if other settings differ: each q can have its own
    α.
    """
    for side, settings in ((first, hypothesis.first), (second, hypothesis.second)):
        if not side:
            return f"no run of {settings_in_words(settings)} that may be compared has started"
    if len(first) == len(second) == 1:
        return [(first[0], second[0])]
    named = {_label(name) for name in (*hypothesis.first, *hypothesis.second)}
    firsts, seconds = (
        {_rest(condition, named): condition for condition in side} for side in (first, second)
    )
    pairs = [(one, seconds[rest]) for rest, one in firsts.items() if rest in seconds]
    if not pairs or len(firsts) < len(first) or len(seconds) < len(second):
        return (
            f"{len(first)} and {len(second)} conditions have these settings, and their other "
            "settings form no pairs: the hypothesis must name more settings"
        )
    return pairs


def _rest(condition: Condition, named: set[str]) -> Values:
    """The condition's settings that the hypothesis does not name."""
    settings = ((ENTROPIC_INDEX, condition.entropic_index), *condition.others)
    return tuple(pair for pair in settings if pair[0] not in named)


def pairs_of(conditions: Sequence[Condition]) -> list[tuple[Condition, Condition]]:
    """Pairs of a later condition and an earlier one; of many conditions, each and its reference.

    The reference has the same other settings and q = 1, or the smallest q. If no two conditions
    have the same other settings, it is the first condition with this q.
    """
    if len(conditions) <= MOST_CONDITIONS:
        return [(second, first) for first, second in combinations(conditions, 2)]
    indices = [one.entropic_index for one in conditions]
    reference = "1" if "1" in indices else indices[0]
    references = {one.others: one for one in conditions if one.entropic_index == reference}
    pairs = [(one, references[one.others]) for one in conditions if one.others in references]
    if all(one is other for one, other in pairs):
        first = conditions[indices.index(reference)]
        pairs = [(one, first) for one in conditions]
    return [(one, other) for one, other in pairs if one is not other]
