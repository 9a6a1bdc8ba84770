"""The searches of a sweep that is running: opened before its runs, saved after them."""

from __future__ import annotations

from typing import Any

from music_rllib import names
from music_rllib.experiment.open_sweep import OpenSweep
from music_rllib.experiment.plan import Node
from music_rllib.experiment.sweep_files import SEARCH, as_json
from music_rllib.search.controller import SearchController
from music_rllib.search.outcome import outcome
from music_rllib.search.searches import open_searches, warm_starts
from music_rllib.sweep.listeners.screen import Display
from music_rllib.sweep.listeners.state_file import StateFile
from music_rllib.tracking.listener import MlflowListener
from music_rllib.tracking.tracker import Tracker


def begin_searches(
    opened: OpenSweep, display: Display, mlflow_log: MlflowListener, state_file: StateFile
) -> SearchController:
    """Open the searches, add their earlier trials, and plan the first runs."""

    def reused(node: Node) -> None:
        mlflow_log.finished(node)
        state_file.reused(node)

    searches = open_searches(opened)
    for line in warm_starts(searches):
        display.say(line)
    controller = SearchController(
        opened, searches, reused=reused, pruned=mlflow_log.pruned, say=display.say
    )
    state_file.searches = lambda: outcome(controller, thorough=False)
    controller.recall()
    controller.propose()
    return controller


def end_searches(
    opened: OpenSweep, controller: SearchController, tracker: Tracker
) -> list[dict[str, Any]]:
    """Stop the searches, and save their outcome in the sweep's folder and in MLflow."""
    controller.stop()
    searches = outcome(controller)
    if searches:
        text = as_json(searches)
        tracker.put_sweep_artifact(names.ARTIFACT_SEARCH, text)
        opened.location.keep(SEARCH, text)
    return searches
