"""What a running sweep says about itself, and its ear for being told to stop.

`state.json` is written every few seconds: `status` reads it, from any machine that reaches the
storage. `stop.json` in the same folder asks the driver to stop, as Ctrl-C would.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

from music_rllib.config.run_settings import VARIANTS
from music_rllib.config.schema import Stage
from music_rllib.experiment import sweep_files
from music_rllib.experiment.listener import Failure, Listener
from music_rllib.experiment.plan import Node
from music_rllib.experiment.scheduler import Status
from music_rllib.experiment.session import Sweep, plan_document
from music_rllib.search.ranking import best_in_words, best_so_far
from music_rllib.store.lease import process_start, this_machine
from music_rllib.store.node_store import steps_of
from music_rllib.store.object_folder import StorageError
from music_rllib.store.run_record import Report, RunResult, last_values
from music_rllib.sweep.cost import searched

__all__ = ["StateFile"]

LOCAL_SECONDS, REMOTE_SECONDS = 2.0, 15.0
"""Between two signs of life."""
SHOWN_FAILURES = 20


class StateFile(Listener):
    """Writes how far the sweep is, and looks whether it is told to stop."""

    def __init__(
        self,
        sweep: Sweep,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Speak of `sweep`."""
        self._sweep, self._now = sweep, now
        self.searches: Callable[[], list[dict[str, Any]]] = list
        """Gives what came of the sweep's searches so far."""
        self._progress: dict[str, Report] = {}
        self._metrics: dict[str, dict[str, float]] = {}
        self._spent_before = _checkpointed(sweep)
        """Environment steps in the checkpoints of runs that are not finished, by node key."""
        self._results: dict[str, RunResult] = {}
        self._failures: list[dict[str, str]] = []
        self._driver: dict[str, Any] = {
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "machine": this_machine(),
            "process_started": process_start(os.getpid()),
            "started": time.time(),
            "ended": None,
            "outcome": "running",
        }
        self._state: dict[str, Any] = {}
        self._due = 0.0
        self._planned = -1
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._speak, name="state_file", daemon=True)
        self._interval = REMOTE_SECONDS if sweep_files.is_remote(sweep.storage) else LOCAL_SECONDS

    def __enter__(self) -> Self:
        sweep_files.remove(self._sweep.storage, f"{self._sweep.config.name}/{sweep_files.STOP}")
        for node in self._sweep.scheduler.having(Status.REUSED):
            result = self._sweep.store.result(node.key)
            if result is not None:
                self._results[node.key] = result
        self.update()
        self._write()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._driver["ended"] is None:
            self.end("stopped" if kind is KeyboardInterrupt else "failed")

    def end(self, outcome: str) -> None:
        """Say how the sweep ended: `finished`, `failed` or `stopped`."""
        self._ended.set()
        self._thread.join(timeout=30.0)
        self._driver |= {"ended": time.time(), "outcome": outcome}
        self.update()
        with contextlib.suppress(StorageError):  # the results are safe without it
            self._write()

    # -- listening ---------------------------------------------------------------------------

    def reported(self, node: Node, reports: list[Report]) -> None:
        self._progress[node.key] = reports[-1]
        self._metrics.setdefault(node.key, {}).update(last_values(reports))

    def finished(self, node: Node, result: RunResult) -> None:
        self._forget(node)
        self._results[node.key] = result

    def reused(self, node: Node) -> None:
        """A search asks for what is in the store already."""
        result = self._sweep.store.result(node.key)
        if result is not None:
            self._results[node.key] = result

    def failed(self, node: Node, failure: Failure) -> None:
        self._failures.append({"run": node.label, "cause": failure.cause, "log": str(failure.log)})

    def _forget(self, node: Node) -> None:
        self._progress.pop(node.key, None)
        self._metrics.pop(node.key, None)

    def reached(self) -> dict[str, RunResult]:
        """What unfinished runs have spent and measured, by node key, as far as it is known."""
        labels = {node.key: node.label for node in self._sweep.plan.nodes}
        return {
            key: RunResult(
                label=labels[key],
                env_steps=report.env_steps,
                seconds=report.seconds,
                metrics=self._metrics.get(key, {}),
            )
            for key, report in self._progress.items()
        }

    def tick(self) -> None:
        if self._now() >= self._due:
            began = self._now()
            self.update()
            # A large sweep takes longer to describe: never more than a few per cent of the time.
            self._due = self._now() + max(self._interval, 30 * (self._now() - began))

    def headline(self) -> tuple[list[str], str | None]:
        """Where each stage and search stands, and the best so far, in words."""
        state = self._state
        lines = [
            f"{stage['name']}: "
            + ", ".join(f"{count} {status}" for status, count in stage["runs"].items())
            for stage in state["stages"]
            if stage["runs"]
        ]
        lines += [
            f"search of {search['stage']}: {arm['judged']} of {len(arm['trials'])} trials judged, "
            f"{arm['pruned']} stopped early"
            for search in state["searches"]
            for arm in search["arms"]
        ]
        best = state["best"]
        return lines, None if best is None else f"best so far: {best_in_words(best)}"

    # -- speaking ----------------------------------------------------------------------------

    def update(self) -> None:
        """Describe the sweep anew; only from the driver's loop, as the scheduler may change."""
        self._state = self._describe()

    def _describe(self) -> dict[str, Any]:
        sweep = self._sweep
        counts: dict[str, Counter[str]] = {}
        steps_done = steps_left = 0
        running = []
        for node in sweep.plan.nodes:
            status = (
                sweep.scheduler[node.key] if sweep.scheduler.knows(node.key) else Status.WAITING
            )
            counts.setdefault(node.stage, Counter())[str(status)] += 1
            if status in (Status.FINISHED, Status.REUSED):
                steps_done += node.run.env_steps
                continue
            reached = self._progress.get(node.key)
            steps = self._spent_before.get(node.key, 0) if reached is None else reached.env_steps
            steps_done += steps
            if status in (Status.WAITING, Status.STARTED, Status.PAUSED):
                steps_left += node.run.env_steps - steps
            if status is Status.STARTED:
                metric = node.run.task.primary_metric
                running.append(
                    {
                        "run": node.label,
                        "env_steps": steps,
                        "budget": node.run.env_steps,
                        "metric": metric,
                        "value": self._metrics.get(node.key, {}).get(metric),
                    }
                )
        stages = [
            {
                "name": stage.name,
                "variant": stage.variant,
                "trials": len({run.trial for run in sweep.plan.runs if run.stage == stage.name}),
                "runs": dict(counts.get(stage.name, {})),
            }
            for stage in sweep.config.stages
        ]
        searches = self.searches()
        return {
            "sweep": sweep.config.name,
            "stages": stages,
            "env_steps": {"done": steps_done, "left": steps_left, "to_come": self._to_come()},
            "running": running,
            "best": best_so_far(self._at_the_task(), sweep.plan, self._results, searches),
            "searches": searches,
            "pruned": [node.key for node in sweep.scheduler.having(Status.PRUNED)],
            "failures": self._failures[-SHOWN_FAILURES:],
        }

    def _to_come(self) -> int:
        """Environment steps of runs that the searches have not asked for yet, at most."""
        config, plan = self._sweep.config, self._sweep.plan
        steps = 0
        for stage in config.stages:
            asked = [run for run in plan.runs if run.stage == stage.name]
            if stage.search is None or any(str(run.trial).startswith("final") for run in asked):
                continue  # the runs on fresh seeds are asked for last, and all at once
            at_most = sum(kind.runs * kind.env_steps for kind in searched(config, stage))
            known = sum(node.run.env_steps for node in plan.nodes if node.stage == stage.name)
            steps += max(0, at_most - known)
        return steps

    def _at_the_task(self) -> list[Stage]:
        """Stages that train for the task: MUSIC-u's success is chance."""
        stages = self._sweep.config.stages
        return [stage for stage in stages if VARIANTS[stage.variant].fixed["task_reward"]]

    def _speak(self) -> None:
        pause = min(self._interval, 2.0)
        written = 0.0
        while not self._ended.wait(pause):
            if self._told_to_stop():
                os.kill(os.getpid(), signal.SIGINT)
                return self._only_write()
            if time.monotonic() - written >= self._interval:
                with contextlib.suppress(StorageError):  # next time, perhaps
                    self._write()
                written = time.monotonic()
        return None

    def _only_write(self) -> None:
        while not self._ended.wait(self._interval):
            with contextlib.suppress(StorageError):
                self._write()

    def _told_to_stop(self) -> bool:
        path = f"{self._sweep.config.name}/{sweep_files.STOP}"
        try:
            if sweep_files.read(self._sweep.storage, path) is None:
                return False
            sweep_files.remove(self._sweep.storage, path)
        except StorageError:
            return False
        return True

    def _write(self) -> None:
        state = self._state | {"driver": self._driver | {"heartbeat": time.time()}}
        sweep_files.keep(self._sweep, sweep_files.STATE, sweep_files.as_json(state))
        if (planned := len(self._sweep.plan.trials)) != self._planned:
            self._planned = planned
            sweep_files.keep(
                self._sweep, sweep_files.PLAN, sweep_files.as_json(plan_document(self._sweep))
            )


def _checkpointed(sweep: Sweep) -> dict[str, int]:
    begun = sweep.store.begun()
    nodes = (node for node in sweep.plan.nodes if node.key in begun)
    return {
        node.key: steps_of(checkpoints[-1])
        for node in nodes
        if (checkpoints := sweep.store.work_folder(node.key).names())
    }
