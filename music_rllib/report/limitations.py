"""What a report cannot say, and why: everything that is not there, in words."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from music_rllib import names
from music_rllib.labels import ShortLabels, in_runs
from music_rllib.results.analysis import StageAnalysis
from music_rllib.results.data import Sweep

__all__ = ["missing", "planned_runs"]

SHOWN = 5
_STATES = {
    "RUNNING": "still running (or killed without a word)",
    "SCHEDULED": "waiting to begin",
    "KILLED": "stopped before the end; the same command continues",
    "FAILED": "failed; see below",
}


def missing(
    sweep: Sweep, analyses: Sequence[StageAnalysis], undelivered: int, *, live: bool = False
) -> list[str]:
    """One sentence for each thing that is missing; nothing of what a `live` sweep has yet to do."""
    if live:
        return _missing_evidence(sweep, analyses)
    return [
        *_missing_runs(sweep),
        *_missing_evidence(sweep, analyses),
        *_missing_records(sweep, undelivered),
    ]


def planned_runs(config: str) -> tuple[str, ...] | None:
    """Names of the runs that a sweep's configuration asks for.

    Returns:
        None where that cannot be told here: the configuration is one of another version, or starts
        from files that are not on this machine.
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
    return tuple(node.label for node in plan.nodes)


def _missing_runs(sweep: Sweep) -> list[str]:
    notes = []
    if not sweep.runs:
        notes.append("No run has begun, so there is nothing to draw or compare.")
    planned = None if sweep.config is None else planned_runs(sweep.config)
    known = {run.name for run in sweep.runs}
    waiting = [name for name in planned or () if name not in known]
    if waiting:
        short = ShortLabels.of(planned or ())
        notes.append(f"{in_runs(len(waiting))} not begun: {_some([*map(short, waiting)])}.")
    states = Counter(run.status for run in sweep.runs)
    notes += [f"{in_runs(states[s])} {words}." for s, words in _STATES.items() if states[s]]
    return notes


def _missing_evidence(sweep: Sweep, analyses: Sequence[StageAnalysis]) -> list[str]:
    notes = []
    unevaluated = [
        f"{task} ({names.word_of(metric)})"
        for task in dict.fromkeys(run.task for run in sweep.runs)
        if (metric := sweep.primary_metric(task))
        and not any(len(sweep.series(i, metric)[0]) for i in sweep.on(task))
    ]
    if unevaluated:
        notes.append(f"Nothing was evaluated yet on {_some(unevaluated)}.")
    for analysis in analyses:
        stage = analysis.stage
        unfinished = [c.label for c in stage.conditions if not _finished(sweep, c.runs)]
        if unfinished and len(unfinished) < len(stage.conditions):
            notes.append(f"Stage {stage.name}: no run of {_some(unfinished)} has finished.")
    return notes


def _missing_records(sweep: Sweep, undelivered: int) -> list[str]:
    notes = []
    if sweep.config is None:
        notes.append(
            "The configuration is not in MLflow (or its artefacts are not reachable from here), so "
            "it is not known which runs are still to come."
        )
    if undelivered:
        notes.append(
            f"Not everything of {in_runs(undelivered)} has reached MLflow yet; send it with "
            "`python -m music_rllib.tracking deliver` and the sweep's folder, then report again."
        )
    return notes


def _finished(sweep: Sweep, runs: Iterable[int]) -> bool:
    return any(sweep.runs[run].status == "FINISHED" for run in runs)


def _some(labels: Sequence[str]) -> str:
    more = len(labels) - SHOWN
    return "; ".join(labels[:SHOWN]) + (f"; and {more} more" if more > 0 else "")
