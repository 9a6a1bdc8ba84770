"""Writes the state of a running sweep to `state.json`, and stops the sweep on `stop.json`.

`state.json` is written every few seconds. `status` and the live page read it, on any machine that
reaches the storage. A new `stop.json` in the same folder stops every driver like Ctrl-C. Several
drivers write the same `state.json` in turn.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

from music_rllib.config.run_settings import VARIANTS
from music_rllib.errors import is_stop
from music_rllib.experiment import sweep_files
from music_rllib.experiment.open_sweep import OpenSweep
from music_rllib.experiment.plan import Node
from music_rllib.experiment.record import plan_document
from music_rllib.experiment.scheduler import Failure, Listener, Status
from music_rllib.results.data import LastValues
from music_rllib.search.best import best_so_far, best_text
from music_rllib.store.history import Report, RunResult, last_values
from music_rllib.store.lease import process_start, this_machine
from music_rllib.store.storage import StorageError, is_remote
from music_rllib.store.work_folder import steps_of
from music_rllib.sweep.views.cost import searched_runs
from music_rllib.sweep.views.results import shown_metric

LOCAL_SECONDS, REMOTE_SECONDS = 2.0, 15.0
"""Seconds between two writes of `state.json`, in a folder and in a bucket."""
MOST_FAILURES = 1000
"""Largest number of failures in `state.json`, the newest ones."""


class StateFile(Listener):
    """Keeps `state.json` up to date and checks for `stop.json` in a thread of its own."""

    def __init__(self, sweep: OpenSweep, stop_before: Any = None) -> None:
        """Of a sweep whose driver has begun after the request to stop `stop_before`."""
        self._sweep, self._stop_before = sweep, stop_before
        self.searches: Callable[[], list[dict[str, Any]]] = list
        """Function that returns the results of the sweep's searches so far."""
        self.unfinished: dict[str, RunResult] = {}
        """Node key to the steps, time and last metrics of an unfinished run."""
        self._checkpointed = _checkpointed_steps(sweep)
        self._results: dict[str, RunResult] = {}
        self._last_values = LastValues(sweep.plan)
        self._in_workers: set[str] = set()
        """Keys of nodes whose run a worker has started; other started nodes wait for resources."""
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
        self._next_update = 0.0
        self._written_trials = 0
        """Number of trials in the last `plan.json`."""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="state_file", daemon=True)
        self._interval = REMOTE_SECONDS if is_remote(sweep.storage) else LOCAL_SECONDS

    def __enter__(self) -> Self:
        for node in self._sweep.scheduler.having(Status.REUSED):
            self.reused(node)
        self._update()
        self._write()
        self._thread.start()
        return self

    def __exit__(self, _: object, error: BaseException | None, *rest: object) -> None:
        if self._driver["ended"] is None:
            self.end("stopped" if is_stop(error) else "failed")

    def end(self, outcome: str) -> None:
        """Write the outcome of the sweep: `finished`, `failed` or `stopped`."""
        self._ended.set()
        self._thread.join(timeout=30.0)
        self._driver |= {"ended": time.time(), "outcome": outcome}
        self._update()
        with contextlib.suppress(StorageError):  # the results are safe without it
            self._write()

    def status(self, key: str) -> Status:
        """The node's status; a started node counts as waiting until a worker has begun its run."""
        scheduler = self._sweep.scheduler
        if not scheduler.knows(key):
            return Status.WAITING
        queued = scheduler[key] is Status.STARTED and key not in self._in_workers
        return Status.WAITING if queued else scheduler[key]

    # -- events of the driver's loop ---------------------------------------------------------

    def started(self, node: Node) -> None:
        self._in_workers.add(node.key)

    def paused(self, node: Node) -> None:
        self._in_workers.discard(node.key)

    def left(self, node: Node, holder: str) -> None:
        self._in_workers.discard(node.key)

    def reported(self, node: Node, reports: list[Report]) -> None:
        before = self.unfinished.get(node.key)
        self.unfinished[node.key] = RunResult(
            label=node.label,
            env_steps=reports[-1].env_steps,
            seconds=reports[-1].seconds,
            metrics=(before.metrics if before else {}) | last_values(reports),
        )

    def finished(self, node: Node, result: RunResult) -> None:
        self.unfinished.pop(node.key, None)
        self._results[node.key] = result

    def reused(self, node: Node) -> None:
        """Read the result of a node that the store already had."""
        result = self._sweep.store.result(node.key)
        if result is not None:
            self._results[node.key] = result

    def failed(self, node: Node, failure: Failure) -> None:
        self._failures.append({"run": node.label, "cause": failure.cause, "log": str(failure.log)})

    def tick(self) -> None:
        if (began := time.monotonic()) >= self._next_update:
            self._update()
            # Describing a large sweep takes longer; it must not take more than 3% of the time.
            ended = time.monotonic()
            self._next_update = ended + max(self._interval, 30 * (ended - began))

    def headline(self) -> tuple[list[str], str | None]:
        """A line for each stage and for each study of a search, and the best condition so far."""
        lines = [
            f"{stage['name']}: {_counts_text(stage['runs'])}"
            for stage in self._state["stages"]
            if stage["runs"]
        ]
        lines += [
            f"search of {search['stage']}: {study['judged']} of {len(study['trials'])} trials "
            f"scored, {study['pruned']} stopped early"
            for search in self._state["searches"]
            for study in search["arms"]
        ]
        best = self._state["best"]
        return lines, None if best is None else f"best so far: {best_text(best)}"

    # -- the state ---------------------------------------------------------------------------

    def _update(self) -> None:
        """Describe the sweep. Called only by the driver's loop, which changes the scheduler."""
        sweep = self._sweep
        counts: dict[str, Counter[str]] = {}
        steps_done = steps_left = 0
        running = []
        for node in sweep.plan.nodes:
            status = self.status(node.key)
            counts.setdefault(node.stage, Counter())[str(status)] += 1
            if status in (Status.FINISHED, Status.REUSED):
                steps_done += node.run.env_steps
                continue
            reached = self.unfinished.get(node.key)
            steps = reached.env_steps if reached else self._checkpointed.get(node.key, 0)
            steps_done += steps
            if status in (Status.WAITING, Status.STARTED, Status.PAUSED):
                steps_left += node.run.env_steps - steps
            if status is Status.STARTED:
                metrics = reached.metrics if reached else {}
                metric = shown_metric(node.run, metrics)
                running.append(
                    {
                        "run": node.label,
                        "env_steps": steps,
                        "budget": node.run.env_steps,
                        "metric": metric,
                        "value": metrics.get(metric),
                    }
                )
        trials = Counter(stage for stage, _ in {(run.stage, run.trial) for run in sweep.plan.runs})
        stages = [
            {
                "name": stage.name,
                "variant": stage.variant,
                "trials": trials[stage.name],
                "runs": dict(counts.get(stage.name, {})),
            }
            for stage in sweep.config.stages
        ]
        searches = self.searches()
        # Without the task's reward, success is chance; with a single setting, there is no best.
        rewarded = [s for s in sweep.config.stages if VARIANTS[s.variant].fixed["task_reward"]]
        varied = {s.name for s in rewarded if s.search is not None or trials[s.name] > 1}
        chosen = sweep.config.stage().name  # the stage of `best` comes first, then the last one
        compared = [s for s in rewarded if varied and s.name in {*varied, chosen}]
        compared.sort(key=lambda stage: stage.name == chosen)
        now, to_come = self._last_values.sweep(self._results), self._to_come(searches)
        self._state = {
            "sweep": sweep.config.name,
            "stages": stages,
            "env_steps": {"done": steps_done, "left": steps_left, "to_come": to_come},
            "running": running,
            "best": best_so_far(compared, sweep.plan, now, searches),
            "searches": searches,
            "pruned": [node.key for node in sweep.scheduler.having(Status.PRUNED)],
            "failures": self._failures[-MOST_FAILURES:],
        }

    def _to_come(self, searches: Sequence[Mapping[str, Any]]) -> int:
        """Largest number of environment steps of runs that the searches will still add."""
        config, plan = self._sweep.config, self._sweep.plan
        complete = {one["stage"] for one in searches if one["complete"]}
        steps = 0
        for stage in config.stages:
            asked = [run for run in plan.runs if run.stage == stage.name]
            begun = any(run.part.startswith("final") for run in asked)
            if stage.search is None or begun or stage.name in complete:
                continue  # the runs on fresh seeds come last and all at once
            at_most = sum(one.all_env_steps for one in searched_runs(config, stage))
            # Also the runs that they start from, unless the plan had them before the search.
            keys = {node.key for run in asked for node in plan.chain(run.key)}
            keys = {key for key in keys if not self._sweep.scheduler.is_planned(key)}
            steps += max(0, at_most - sum(plan.node(key).run.env_steps for key in keys))
        return steps

    # -- the thread --------------------------------------------------------------------------

    def _watch(self) -> None:
        """Write the state at each interval; interrupt the process once if `stop.json` exists."""
        interrupted = False
        written = 0.0
        while not self._ended.wait(min(self._interval, 2.0)):
            if not interrupted and self._stop_requested():
                interrupted = True
                os.kill(os.getpid(), signal.SIGINT)
            if time.monotonic() - written >= self._interval:
                with contextlib.suppress(StorageError):  # the next write may succeed
                    self._write()
                written = time.monotonic()

    def _stop_requested(self) -> bool:
        try:
            request = self._sweep.location.read(sweep_files.STOP)
        except StorageError:
            return False
        return request is not None and request != self._stop_before

    def _write(self) -> None:
        state = self._state | {"driver": self._driver | {"heartbeat": time.time()}}
        self._sweep.location.keep(sweep_files.STATE, sweep_files.as_json(state))
        if (trials := len(self._sweep.plan.trials)) != self._written_trials:
            self._written_trials = trials
            plan = sweep_files.as_json(plan_document(self._sweep))
            self._sweep.location.keep(sweep_files.PLAN, plan)


def _counts_text(runs: Mapping[str, int]) -> str:
    """`5 finished (4 reused), 3 waiting`: a reused run is a finished one."""
    reused = runs.get("reused", 0)
    finished = runs.get("finished", 0) + reused
    counts = {name: n for name, n in runs.items() if name not in ("finished", "reused")}
    texts = [f"{finished} finished" + (f" ({reused} reused)" if reused else "")] * (finished > 0)
    return ", ".join([*texts, *(f"{count} {status}" for status, count in counts.items())])


def _checkpointed_steps(sweep: OpenSweep) -> dict[str, int]:
    """Node key to the environment steps in the last checkpoint of an unfinished run."""
    begun = sweep.store.begun()
    nodes = (node for node in sweep.plan.nodes if node.key in begun)
    return {
        node.key: steps_of(checkpoints[-1])
        for node in nodes
        if (checkpoints := sweep.store.work_folder(node.key).names())
    }
