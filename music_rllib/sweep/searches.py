"""A sweep's searches while it is driven: opened with what earlier results lead to, and closed."""

from __future__ import annotations

from typing import Any

from music_rllib import names
from music_rllib.experiment.plan import Node
from music_rllib.experiment.session import Sweep
from music_rllib.experiment.sweep_files import SEARCH, as_json, keep
from music_rllib.search.controller import SearchController
from music_rllib.search.opening import learnings, open_searches
from music_rllib.search.summary import outcome
from music_rllib.sweep.listeners.mlflow import MlflowListener
from music_rllib.sweep.listeners.screen import Display
from music_rllib.sweep.listeners.state_file import StateFile
from music_rllib.tracking.tracker import Tracker

__all__ = ["begin_searches", "end_searches"]


def begin_searches(
    opened: Sweep, display: Display, mlflow_log: MlflowListener, state_file: StateFile
) -> SearchController:
    """The sweep's searches, as far as earlier results lead."""

    def reused(node: Node) -> None:
        mlflow_log.finished(node)
        state_file.reused(node)

    searches = open_searches(opened)
    for line in learnings(searches):
        display.say(line)
    controller = SearchController(
        opened,
        searches,
        reused=reused,
        pruned=mlflow_log.pruned,
        say=display.say,
    )
    state_file.searches = lambda: outcome(controller, thorough=False)
    controller.recall()
    controller.advance()
    return controller


def end_searches(
    opened: Sweep, controller: SearchController, tracker: Tracker
) -> list[dict[str, Any]]:
    """Keep what came of the searches, in the sweep's folder and in MLflow."""
    controller.stop()
    found = outcome(controller)
    if not found:
        return found
    text = as_json(found)
    tracker.put_sweep_artefact(names.ARTEFACT_SEARCH, text)
    keep(opened, SEARCH, text)
    return found
