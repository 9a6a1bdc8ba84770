"""Warnings about valid configurations that may not do what their author means."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping

from music_rllib.config.hypotheses import unnamed_differences
from music_rllib.config.problems import ConfigError
from music_rllib.config.returns import Range, cut_off
from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Stage, SweepConfig
from music_rllib.envs.tasks import Task

_CHANGE_RETURNS = (
    "tac.gamma",
    "tac.target_bounds",
    "tac.alpha",
    "tac.entropic_index",
    "tac.policy",
    "music.mi_reward_weight",
)
"""Settings that the reachable returns and their bounds depend on."""


def remarks(config: SweepConfig) -> list[str]:
    """One line for each warning, with the stages and tasks that it is about."""
    places: dict[str, list[str]] = {}
    for stage in config.stages:
        points = list(_points(stage))
        for task in stage.tasks:
            runs = [runs[task.name] for runs in points if task.name in runs]
            if (text := _cut_off_returns(task, runs)) is not None:
                places.setdefault(text, []).append(f"{stage.name}/{task.name}")
    lines = [f"{', '.join(where)}: {text}" for text, where in places.items()]
    lines += [
        f"{stage.name}: search.trials is {search.trials:,}, and the space has {search.count:,} "
        f"points: the search ends after {search.count:,} trials"
        for stage in config.stages
        if (search := stage.search) is not None and (search.trials or 0) > search.count
    ]
    if config.analysis is not None:
        stages = {stage.name: stage for stage in config.stages}
        lines += [
            f"analysis: {hypothesis!r} compares runs that differ in {', '.join(settings)} too"
            for hypothesis, settings in unnamed_differences(config.analysis, stages)
        ]
    return lines


def _cut_off_returns(task: Task, runs: Iterable[RunSettings]) -> str | None:
    """A warning about the run with the widest range of reachable values that are cut off."""
    bounded = [run for run in runs if run.tac.target_bounds is not None]
    if task.reward_range is None and any(run.music.task_reward for run in bounded):
        return (
            f"tac.target_bounds may cut off values that can be reached: the rewards of {task.name} "
            f"are not known (environments.{task.name}.reward_range)"
        )
    rewards = Range(*(task.reward_range or (0.0, 0.0)))
    cuts = [cut for run in bounded if (cut := cut_off(run.tac, run.music, rewards))]
    if not cuts:
        return None
    return f"tac.{max(cuts, key=lambda cut: cut.reached.high - cut.reached.low)}"


def _points(stage: Stage) -> Iterator[Mapping[str, RunSettings]]:
    """Task to settings, for all points of a grid and for the corners of a search's space."""
    yield from (point.runs for point in stage.points)
    if stage.search is None:
        return
    space = {name: dimension.ends() for name, dimension in stage.search.space.items()}
    axes = {
        name: values
        for name, values in (space | stage.search.compare).items()
        if name in _CHANGE_RETURNS
    }
    for values in itertools.product(*axes.values()):
        try:
            yield stage.resolve(dict(zip(axes, values, strict=True))).runs
        except ConfigError:  # no trial can be at this corner
            continue
