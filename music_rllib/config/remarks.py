"""What a sound configuration may not mean: said before anything starts, and refused nowhere."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping

from music_rllib.config.problems import ConfigError
from music_rllib.config.returns import Range, cut_off
from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Stage, SweepConfig
from music_rllib.envs.tasks import Task

_BEHIND_RETURNS = frozenset(
    f"{section}.{name}"
    for section, names in (
        ("tac", ("gamma", "target_bounds", "alpha", "entropic_index", "policy")),
        ("music", ("mi_reward_weight",)),
    )
    for name in names
)
"""What the returns within reach and their bounds depend on, where it is searched for."""


def remarks(config: SweepConfig) -> list[str]:
    """One line for each thing to be told, with the stages and tasks that it is true of."""
    places: dict[str, list[str]] = {}
    for stage in config.stages:
        for task in stage.tasks:
            runs = [runs[task.name] for runs in _points(stage) if task.name in runs]
            if (text := _of_returns(task, runs)) is not None:
                places.setdefault(text, []).append(f"{stage.name}/{task.name}")
    return [f"{', '.join(where)}: {text}" for text, where in places.items()]


def _of_returns(task: Task, runs: Iterable[RunSettings]) -> str | None:
    """Of the runs whose values are cut off, the one that can reach the widest range."""
    bounded = [run for run in runs if run.tac.target_bounds is not None]
    if task.reward_range is None and any(run.music.task_reward for run in bounded):
        return (
            f"tac.target_bounds may cut off values that can be reached: the rewards of {task.name} "
            f"are not known (environments.{task.name}.reward_range)"
        )
    rewards = Range(*(task.reward_range or (0.0, 0.0)))
    found = [cut for run in bounded if (cut := cut_off(run.tac, run.music, rewards))]
    if not found:
        return None
    return f"tac.{max(found, key=lambda cut: cut.reached.high - cut.reached.low)}"


def _points(stage: Stage) -> Iterator[Mapping[str, RunSettings]]:
    """Task to settings, of all points of a grid; of what is searched, of the ends."""
    yield from (point.runs for point in stage.points)
    if stage.search is None:
        return
    space = {name: dimension.ends() for name, dimension in stage.search.space.items()}
    axes = {
        name: values
        for name, values in (space | stage.search.compare).items()
        if name in _BEHIND_RETURNS
    }
    for values in itertools.product(*axes.values()):
        try:
            yield stage.resolve(dict(zip(axes, values, strict=True))).runs
        except ConfigError:  # a corner that no trial can be at
            continue
