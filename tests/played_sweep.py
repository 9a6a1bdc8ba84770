"""Sweeps whose runs are recorded as if they had been trained."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from music_rllib import names
from music_rllib.experiment.open_sweep import OpenSweep, open_sweep
from music_rllib.experiment.plan import Node, make_plan
from music_rllib.experiment.record import keep_record
from music_rllib.results.analysis_plan import record_plan
from music_rllib.results.read import read_sweep
from music_rllib.results.study import Study, study_of
from music_rllib.store.history import Report
from music_rllib.sweep.listeners.state_file import StateFile
from tests.played_search import publish
from tests.sweep_files import loaded


def document(stages: list[dict[str, Any]] | None = None, **changes: Any) -> dict[str, Any]:
    """A sweep over q with five seeds of 2,000 steps, with these stages and changes."""
    grid = {"tac.entropic_index": [1.0, 2.0]}
    return {
        "name": "s",
        "tasks": ["FetchPush"],
        "seeds": 5,
        "defaults": {"env_steps": 2000, "evaluation": {"interval": 500, "episodes": 20}},
        "stages": stages or [{"name": "her", "variant": "tac", "grid": grid}],
    } | changes


def opened(folder: Path, content: dict[str, Any]) -> OpenSweep:
    """The sweep, recorded in `folder`/results."""
    config = loaded(folder, content, storage=str(folder / "results"))
    sweep = open_sweep(config, make_plan(config), config.storage)
    keep_record(sweep)
    return sweep


def play(sweep: OpenSweep, at_ms: int, before: int = 0, nodes: list[Node] | None = None) -> None:
    """As if all runs, or those of `nodes`, had been trained.

    The reports up to 2,000 steps are of `before` ms: those of runs that this one continues.
    """
    with StateFile(sweep) as state_file:
        for node in sweep.plan.nodes if nodes is None else nodes:
            q = float(node.run.tac.entropic_index)  # type: ignore[arg-type]
            history = [
                Report(
                    env_steps=at,
                    seconds=at / 1e6,
                    timestamp_ms=before if before and at <= 2000 else at_ms,
                    metrics={
                        names.EVAL_SUCCESS: at / 4000 * (1 - 0.2 * q) + 0.01 * node.seed,
                        names.EVAL_EPISODES: 20.0,
                    },
                )
                for at in range(500, node.run.env_steps + 1, 500)
            ]
            result = publish(sweep, node, history)
            last = sweep.store.continuation(node.continuation)
            with last.new_checkpoint(node.run.env_steps):
                pass
            sweep.scheduler.start(node.key)
            sweep.scheduler.finish(node.key)
            state_file.finished(node, result)
        state_file.end("finished")


def planned_and_played(folder: Path, content: dict[str, Any]) -> int:
    """Record the plan of a sweep before its runs; the time of their results in ms."""
    sweep = opened(folder, content)
    ((version,), _) = record_plan(sweep)
    play(sweep, version.recorded_ms + 1)
    return version.recorded_ms + 1


ASKED: dict[str, Any] = {"hypotheses": ["q = 2 worse than q = 1"]}
"""An `analysis` section."""


def over(steps: int, **changes: Any) -> dict[str, Any]:
    """`document` with runs of `steps`."""
    content = document(**changes)
    content["defaults"]["env_steps"] = steps
    return content


def studied(folder: Path) -> Study:
    """The study of the sweep in `folder`."""
    return study_of(read_sweep(str(folder / "results/s")).sweep)


def stages_of(short: int, long: int) -> list[dict[str, Any]]:
    """A stage `short` and a stage `long`, with runs of these steps."""
    base = document()["stages"][0]
    first = base | {"name": "short", "tac": {"lr": 0.002}, "env_steps": short}
    return [first, base | {"name": "long", "env_steps": long}]


def with_alpha_of_each_task(**changes: Any) -> dict[str, Any]:
    """`document` on two tasks, with α = 0.05 on FetchPush and 0.1 on FetchSlide."""
    per_task = {"FetchSlide": {"tac": {"alpha": 0.1}}}
    stage = document()["stages"][0] | {"tac": {"alpha": 0.05}, "per_task": per_task}
    return document([stage], tasks=["FetchPush", "FetchSlide"], **{"analysis": ASKED} | changes)
