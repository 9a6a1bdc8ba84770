"""What a report cannot show, and which runs are to be taken with care, in sentences."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from music_rllib import names
from music_rllib.experiment.environments import mixed
from music_rllib.labels import ShortLabels, in_runs
from music_rllib.results.analysis import StageAnalysis
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import Array

SHOWN = 5
"""Largest number of labels in a sentence."""
_STATES = {
    "RUNNING": "still running (or killed without a word)",
    "KILLED": "stopped before the end; the same command continues",
    "FAILED": "failed; see below",
}


def missing(sweep: Sweep, analyses: Sequence[StageAnalysis], *, live: bool = False) -> list[str]:
    """A sentence for everything that is missing, without the runs to come of a `live` sweep."""
    runs = [] if live else [*_missing_runs(sweep)]
    earlier = filter(None, [sweep.earlier])
    mixed_environments = _mixed_environments(sweep)
    return [*runs, *earlier, *mixed_environments, *_missing_evidence(sweep, analyses)]


def planned_runs(config: str) -> dict[str, str] | None:
    """Keys and names of the runs that a sweep's configuration plans.

    Returns:
        None if they are unknown: the configuration is from another version, or it starts from
        files that are not on this machine.
    """
    from music_rllib.config.load import load_sweep
    from music_rllib.config.problems import ConfigError
    from music_rllib.experiment.plan import make_plan
    from music_rllib.store.handoff import HandoffError

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sweep.yaml"
        path.write_text(config, encoding="utf-8")
        try:
            plan = make_plan(load_sweep(path))
        except (ConfigError, HandoffError):
            return None
    return {node.key: node.label for node in plan.nodes}


def _missing_runs(sweep: Sweep) -> Iterator[str]:
    if all(run.status == "SCHEDULED" for run in sweep.runs):
        yield "No run has begun, so there is nothing to draw or compare."
    planned = (None if sweep.config is None else planned_runs(sweep.config)) or {}
    # Another version of this package may have named them, or counted their keys, otherwise.
    known = {text for run in sweep.runs for text in (run.node_key, run.name)}
    waiting = [run.name for run in sweep.runs if run.status == "SCHEDULED"]
    # An export has only the runs that have begun.
    waiting += [name for key, name in planned.items() if known.isdisjoint((key, name))]
    if waiting:
        short = ShortLabels.of([*waiting, *(run.name for run in sweep.runs)])
        yield f"{in_runs(len(waiting))} not begun: {_listed([*map(short, waiting)])}."
    # Damaged runs have a cause as well, and a sentence of their own.
    states = Counter(r.status for r in sweep.runs if not (r.status == "KILLED" and r.failure))
    for state, text in _STATES.items():
        if states[state]:
            yield f"{in_runs(states[state])} {text}."


def _mixed_environments(sweep: Sweep) -> Iterator[str]:
    tags = ((run, run.tags.get(names.TAG_ENVIRONMENT, "")) for run in sweep.runs)
    yield from mixed((run.task, run.name, digest) for run, digest in tags if run.is_finished)


def _missing_evidence(sweep: Sweep, analyses: Sequence[StageAnalysis]) -> Iterator[str]:
    unevaluated = [
        f"{task} ({names.word_of(metric)})"
        for task in dict.fromkeys(run.task for run in sweep.runs)
        if (metric := sweep.primary_metric(task))
        and not any(len(sweep.series(i, metric)[0]) for i in sweep.on(task))
    ]
    if unevaluated:
        yield f"Nothing was evaluated yet on {_listed(unevaluated)}."
    for analysis in analyses:
        stage = analysis.stage
        unfinished = [
            condition.label
            for condition in stage.conditions
            if all(sweep.runs[run].status != "FINISHED" for run in condition.runs)
        ]
        if unfinished and len(unfinished) < len(stage.conditions):
            yield f"Stage {stage.name}: no run of {_listed(unfinished)} has finished."


def diverged(sweep: Sweep) -> list[str]:
    """A sentence that names the runs whose critics have diverged, if there are any."""
    short = ShortLabels.of(run.name for run in sweep.runs)
    labels = [short(run.name) for i, run in enumerate(sweep.runs) if _has_diverged(sweep, i)]
    if not labels:
        return []
    return [
        f"The critics of {in_runs(len(labels))} diverged, to values that no reward explains "
        f"({names.Q_MEAN}): {_listed(labels)}. Such a run counts as any other."
    ]


def _has_diverged(sweep: Sweep, run: int) -> bool:
    from music_rllib.config.returns import Range, have_diverged, reward_of_step
    from music_rllib.intrinsic.settings import MusicSettings

    def at_steps(metric: str) -> Array:
        values = dict(zip(*sweep.series(run, metric), strict=True))
        return np.array([values.get(step, 0.0) for step in steps])

    params = sweep.runs[run].params
    steps, means = sweep.series(run, names.Q_MEAN)
    weight = at_steps(names.MI_REWARD_WEIGHT).max(initial=0.0)
    try:
        low, high = map(float, params["task.reward_range"].strip("[]").split(","))
        gamma = float(params["tac.gamma"])
        music = MusicSettings(
            estimator="frozen" if weight else "none",
            mi_reward_weight=weight,
            task_reward=params.get("music.task_reward") != "False",
        )
    except (KeyError, ValueError):
        return False  # nobody knows what can be reached
    if not gamma < 1:
        return False
    bonuses = at_steps(names.ALPHA) * at_steps(names.ENTROPY)
    reward = reward_of_step(Range(low, high), music)
    return bool(have_diverged(means, bonuses, reward, gamma).any())


def _listed(labels: Sequence[str]) -> str:
    more = len(labels) - SHOWN
    return "; ".join(labels[:SHOWN]) + (f"; and {more} more" if more > 0 else "")
