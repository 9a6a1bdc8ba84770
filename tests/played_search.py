"""Searches with a formula instead of training; everything else is real."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from music_rllib import names
from music_rllib.config.run_settings import RunSettings
from music_rllib.experiment.open_sweep import OpenSweep, open_sweep
from music_rllib.experiment.plan import Node, make_plan
from music_rllib.experiment.scheduler import Failure
from music_rllib.search.controller import SearchController
from music_rllib.search.outcome import outcome
from music_rllib.search.searches import open_searches
from music_rllib.store.history import HISTORY, Report, RunResult, last_values, to_json_lines
from music_rllib.store.lease import Lease, LeaseFile
from music_rllib.tune.runner import DagSearcher, SharedRuns
from tests.sweep_files import loaded

Document = dict[str, Any]
Formula = Callable[[RunSettings, float], float]
"""Success rate of a run after a fraction of its budget."""

SPACE: Document = {
    "tac.entropic_index": {"float": [1.0, 2.5], "step": 0.25},
    "tac.alpha": {"float": [0.005, 0.5], "log": True},
}
SEARCH: Document = {"space": SPACE, "trials": 6, "startup_trials": 2, "final": None}


def document(search: Document, **changes: Any) -> Document:
    base: Document = {
        "name": "s",
        "tasks": ["FetchPush"],
        "seeds": [0, 1, 2],
        "defaults": {"env_steps": 4000, "evaluation": {"interval": 1000, "episodes": 2}},
        "stages": [
            {"name": "pretrain", "variant": "music-u"},
            {
                "name": "finetune",
                "variant": "music-r",
                "init_from": "pretrain",
                "search": SEARCH | search,
            },
        ],
    }
    return base | changes


def success(run: RunSettings, share: float) -> float:
    """Best at q = 1.5 and alpha = 0.05, with a spread between seeds."""
    q, alpha = float(run.tac.entropic_index), float(run.tac.alpha)  # type: ignore[arg-type]
    height = 0.9 - 0.5 * abs(q - 1.5) - 0.15 * abs(math.log10(alpha / 0.05))
    return round(share * height + 0.02 * ((7 * run.seed) % 3 - 1), 6)


class Driver:
    """One driver of a sweep; replaces Tune, with runs that end in random order."""

    def __init__(
        self,
        folder: Path,
        content: Document,
        formula: Formula = success,
        seed: int = 0,
        *,
        leases: bool = False,
        change: Callable[[OpenSweep], OpenSweep] = lambda sweep: sweep,
    ) -> None:
        """With `leases`, another driver may compute the same sweep in turn.

        `change` is called with the sweep before it begins.
        """
        folder.mkdir(exist_ok=True)
        config = loaded(folder, content, storage=str(folder / "results"))
        plan = make_plan(config)
        self.sweep: OpenSweep = change(open_sweep(config, plan, config.storage))
        self.computed: list[str] = []
        self.pruned: dict[str, str] = {}
        self.controller = SearchController(
            self.sweep,
            open_searches(self.sweep, alone=True),
            pruned=lambda node, reason: self.pruned.__setitem__(node.label, reason),
        )
        self.controller.recall()
        self._formula = formula
        self._rng = random.Random(seed)
        self._running: list[tuple[Node, int | None]] = []
        self._lease = Lease.of_this_process("a played driver")
        self._shared = SharedRuns(self.sweep, [self.controller]) if leases else None
        if self._shared is not None:
            self._shared._seconds = 0.0

    def play(
        self,
        stop_after: int | None = None,
        slots: int = 2,
        fails: Callable[[Node], bool] = lambda node: False,
    ) -> None:
        """Run to the end, or until `stop_after` pieces of runs have been computed."""
        scheduler = self.sweep.scheduler
        searcher = DagSearcher(
            scheduler, lambda node: {"key": node.key}, self.controller, shared=self._shared
        )
        running = self._running
        self.controller.refresh()
        while stop_after is None or len(self.computed) < stop_after:
            suggestion = None
            if len(running) < slots:
                suggestion = searcher.suggest("t")
            if searcher.over and not running and not isinstance(suggestion, dict):
                return
            if isinstance(suggestion, dict):
                node = scheduler.node(suggestion["key"])
                assert self._shared is None or self._lease_of(node).acquire(self._lease) is None
                running.append((node, scheduler.until(node.key)))
            elif running:
                node, until = running.pop(self._rng.randrange(len(running)))
                self._lease_of(node).release(self._lease.owner)
                if fails(node):
                    scheduler.fail(node.key)
                    self.controller.failed(node, Failure("it failed", self.sweep.folder))
                else:
                    self._compute(node, until)
            else:
                raise AssertionError("it would wait for ever")

    def _lease_of(self, node: Node) -> LeaseFile:
        return self.sweep.store.work_folder(node.key).lease

    def _compute(self, node: Node, until: int | None) -> None:
        self.computed.append(f"{node.key}/{until}")
        budget = node.run.env_steps
        reports = [
            Report(
                env_steps=steps,
                seconds=1.0,
                timestamp_ms=1,
                metrics={
                    names.EVAL_EPISODES: 2.0,
                    names.EVAL_SUCCESS: self._formula(node.run, steps / budget),
                },
            )
            for steps in range(1000, (until or budget) + 1, 1000)
        ]
        self.controller.reported(node, reports)
        if until is not None:
            self.sweep.scheduler.pause(node.key, until)
            self.controller.paused(node)
            return
        result = publish(self.sweep, node, reports)
        self.sweep.scheduler.finish(node.key)
        self.controller.finished(node, result)

    def trials(self, arm: int = 0) -> list[dict[str, Any]]:
        """The storage as plain data, with plain numbers."""
        (found,) = outcome(self.controller)
        trials: list[dict[str, Any]] = json.loads(json.dumps(found["arms"][arm]["trials"]))
        return trials

    def outcome(self) -> dict[str, Any]:
        (found,) = outcome(self.controller)
        return found


def publish(sweep: OpenSweep, node: Node, reports: list[Report]) -> RunResult:
    folder = sweep.folder / "made"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / HISTORY).write_bytes(to_json_lines(reports))
    result = RunResult(
        label=node.label,
        env_steps=reports[-1].env_steps,
        seconds=1.0,
        metrics=last_values(reports),
    )
    sweep.store.publish(node.key, folder, result)
    return result


def searched(folder: Path, search: Document | None = None, **changes: Any) -> Driver:
    driver = Driver(folder, document(search or {}, **changes))
    driver.play()
    return driver


def points(trials: list[dict[str, Any]]) -> list[Mapping[str, Any]]:
    return [trial["values"] for trial in trials]
