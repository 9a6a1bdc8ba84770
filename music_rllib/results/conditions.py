"""Which runs are compared: those that differ in their seed only are one condition.

A run's settings are its params in MLflow. What varies between a stage's runs on the same task tells
its conditions apart, and so does what they start from. Runs are grouped by that and not by the
number of their trial, which changes when a sweep is extended.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from music_rllib import names
from music_rllib.results.data import RunRecord, Sweep

__all__ = ["SIDE_BY_SIDE", "Condition", "Stage", "find_stages", "side_by_side", "stage_by_stage"]

Values = tuple[tuple[str, str], ...]
"""(setting, value) pairs."""

ENTROPIC_INDEX = "q"
SIDE_BY_SIDE = "stages side by side"
SEEDS, FRESH, SEARCHED = "seeds", "fresh", "search"
"""Of a search: the seeds that trials were chosen by, and those of the ranking at its end."""
_WITHOUT_TASK_REWARD = ("music-u",)
# Settings that may be schedules, and so several params: a tag says each in words.
_IN_WORDS = {
    "tac.entropic_index": (ENTROPIC_INDEX, names.TAG_ENTROPIC_INDEX),
    "tac.alpha": ("α", names.TAG_ALPHA),
    "music.mi_reward_weight": ("MI weight", names.TAG_MI_REWARD_WEIGHT),
}


@dataclass(frozen=True, kw_only=True)
class Condition:
    """Runs that differ in their task and seed only."""

    entropic_index: str
    """In words; what its colour depends on. Empty: of several."""
    others: Values
    """What else tells it from the stage's other conditions."""
    runs: tuple[int, ...]
    """Positions in `Sweep.runs`."""

    @property
    def label(self) -> str:
        """`q = 1.5, α = 0.1`."""
        pairs = ((ENTROPIC_INDEX, self.entropic_index), *self.others)
        return ", ".join(f"{name} = {value}" for name, value in pairs if value)


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One stage's conditions, by rising q, on its tasks."""

    name: str
    variant: str
    tasks: tuple[str, ...]
    seeds: tuple[str, ...]
    conditions: tuple[Condition, ...]
    runs: tuple[int, ...]

    @property
    def compared(self) -> tuple[Condition, ...]:
        """Conditions that may be held against each other: of a search those on fresh seeds.

        The best of its trials is so by selection, too, on the seeds that it was chosen by.
        """
        if not any(name == SEEDS for one in self.conditions for name, _ in one.others):
            return self.conditions
        return tuple(one for one in self.conditions if (SEEDS, FRESH) in one.others)

    @property
    def has_task_reward(self) -> bool:
        """Whether success is its aim."""
        return self.variant not in _WITHOUT_TASK_REWARD


def side_by_side(stages: Sequence[Stage]) -> Stage | None:
    """All conditions that train for the task as those of one stage; None if one stage has them."""
    compared = [stage for stage in stages if stage.has_task_reward]
    if len(compared) < 2:
        return None
    return Stage(
        name=SIDE_BY_SIDE,
        variant=" and ".join(dict.fromkeys(stage.variant for stage in compared)),
        tasks=tuple(dict.fromkeys(task for stage in compared for task in stage.tasks)),
        seeds=tuple(sorted({seed for stage in compared for seed in stage.seeds}, key=_number)),
        runs=tuple(run for stage in compared for run in stage.runs),
        conditions=tuple(
            replace(condition, others=(("stage", stage.name), *condition.others))
            for stage in compared
            for condition in stage.conditions
        ),
    )


def stage_by_stage(sweep: Sweep, stages: Sequence[Stage]) -> Stage | None:
    """Each stage that trains for the task as one condition: its runs of what all of them have.

    So on each task stages are compared over the same q and settings; None where they have none in
    common.
    """
    together = side_by_side(stages)
    compared = [stage for stage in stages if stage.has_task_reward]
    cells = [
        {
            (sweep.runs[run].task, condition.label)
            for condition in stage.conditions
            for run in condition.runs
        }
        for stage in compared
    ]
    if together is None or not (shared := set.intersection(*cells)):
        return None
    conditions = [
        Condition(
            entropic_index="",
            others=(("stage", stage.name),),
            runs=tuple(
                run
                for one in stage.conditions
                for run in one.runs
                if (sweep.runs[run].task, one.label) in shared
            ),
        )
        for stage in compared
    ]
    return replace(together, conditions=tuple(conditions))


def find_stages(sweep: Sweep) -> list[Stage]:
    """The sweep's stages, in the order in which their first runs began."""
    stages: dict[str, list[int]] = {}
    for position, run in enumerate(sweep.runs):
        stages.setdefault(run.stage, []).append(position)
    settings = _all_settings(sweep.runs)
    varying = {
        name: _varying([(sweep.runs[run].task, settings[run]) for run in runs])
        for name, runs in stages.items()
    }
    by_key = {run.node_key: position for position, run in enumerate(sweep.runs)}

    def told_apart_by(run: int) -> Values:
        """What varies in the run's own stage and, named after it, in its source's."""
        record = sweep.runs[run]
        own = tuple((n, settings[run][n]) for n in varying[record.stage] if n in settings[run])
        if part := record.tags.get(names.TAG_PART):
            own += ((SEEDS, FRESH if part.startswith("final") else SEARCHED),)
        source = by_key.get(record.tags.get(names.TAG_SOURCE_NODE, ""))
        if source is None or source == run:
            return own
        stage = sweep.runs[source].stage
        return (*own, *((_of(stage, name), value) for name, value in told_apart_by(source)))

    return [
        _stage(sweep.runs, name, runs, {run: told_apart_by(run) for run in runs})
        for name, runs in stages.items()
    ]


def _of(stage: str, setting: str) -> str:
    return setting if ":" in setting else f"{stage}: {setting}"


def _stage(
    records: Sequence[RunRecord], name: str, runs: Sequence[int], values: Mapping[int, Values]
) -> Stage:
    groups: dict[tuple[str, Values], list[int]] = {}
    for run in runs:
        chosen = dict(values[run])
        q = chosen.pop(ENTROPIC_INDEX, records[run].entropic_index)
        groups.setdefault((q, tuple(chosen.items())), []).append(run)
    ordered = sorted(groups.items(), key=lambda item: _order(item[0]))
    return Stage(
        name=name,
        variant=records[runs[0]].variant,
        tasks=tuple(dict.fromkeys(records[run].task for run in runs)),
        seeds=tuple(sorted({records[run].seed for run in runs}, key=_number)),
        runs=tuple(runs),
        conditions=tuple(
            Condition(entropic_index=q, others=others, runs=tuple(members))
            for (q, others), members in ordered
        ),
    )


def _varying(runs: Sequence[tuple[str, Mapping[str, str]]]) -> list[str]:
    """Settings with more than one value on the same task, from (task, settings) pairs."""
    seen: dict[tuple[str, str], set[str]] = {}
    for task, settings in runs:
        for name, value in settings.items():
            seen.setdefault((task, name), set()).add(value)
    return sorted({name for (_, name), values in seen.items() if len(values) > 1})


def _all_settings(records: Sequence[RunRecord]) -> list[dict[str, str]]:
    """Each run's settings; one in words that stands for several things is told in full."""
    both = [_settings(record) for record in records]
    meanings: dict[tuple[str, str], set[str]] = {}
    for settings in both:
        for name, (words, full) in settings.items():
            meanings.setdefault((name, words), set()).add(full)
    return [
        {
            name: words if len(meanings[name, words]) == 1 else f"{words} ({full})"
            for name, (words, full) in settings.items()
        }
        for settings in both
    ]


def _settings(run: RunRecord) -> dict[str, tuple[str, str]]:
    """In words and in full: what may tell conditions apart, not the seed nor the task itself."""
    settings: dict[str, tuple[str, str]] = {}
    for param, value in sorted(run.params.items()):
        if param == "seed" or param.startswith("task."):
            continue
        whole = next((p for p in _IN_WORDS if param == p or param.startswith(f"{p}.")), None)
        if whole is None:
            settings[param] = (value, value)
            continue
        name, tag = _IN_WORDS[whole]
        part = f"{param.removeprefix(whole).removeprefix('.')} {value}".strip()
        _, before = settings.get(name, ("", ""))
        settings[name] = (run.tags.get(tag, value), f"{before}, {part}".removeprefix(", "))
    return settings


def _order(key: tuple[str, Values]) -> tuple[object, ...]:
    q, others = key
    return (_number(q), tuple((name, _number(value)) for name, value in others))


def _number(text: str) -> tuple[float, str]:
    """Numbers by size, a schedule by its first value, other words last."""
    try:
        return float(text.split(" ")[0]), text
    except ValueError:
        return float("inf"), text
