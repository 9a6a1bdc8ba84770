"""Turns Tune's callbacks into events of nodes, for the scheduler and the listeners."""

from __future__ import annotations

import re
import traceback
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ray import cloudpickle
from ray.tune import Callback
from ray.tune.experiment import Trial

from music_rllib.experiment.plan import Node
from music_rllib.experiment.scheduler import Failure, Listener, Scheduler
from music_rllib.redaction import redact
from music_rllib.store.history import from_json_lines
from music_rllib.store.node_store import NodeStore
from music_rllib.store.storage import StorageError
from music_rllib.training.failure_reason import cause_of
from music_rllib.training.hang_watch import RECORD
from music_rllib.training.job import NodeJob
from music_rllib.training.worker import CAUSE, LEFT, NOTES, PAUSED, REPORTS, TRACEBACK

RESTARTS = 3
"""Restarts of a run whose worker dies, until it has passed the step of its last death. A run that
raises an error fails at once."""

_COLOR = re.compile(r"\x1b\[[0-9;]*m")


class TuneEvents(Callback):
    """Updates the scheduler when Tune's trials change, and passes the events to the listeners.

    The folder `failures` receives the tracebacks of failed runs. Tune calls it with keywords only.
    """

    def __init__(
        self, scheduler: Scheduler, store: NodeStore, listeners: Iterable[Listener], failures: Path
    ) -> None:
        self._scheduler = scheduler
        self._store = store
        self._listeners = list(listeners)
        self._failures = failures
        self._deaths: dict[str, list[str]] = {}
        """Tracebacks of a node's workers that died since it last made progress."""
        self._reached: dict[str, int] = {}
        self._died_at: dict[str, int] = {}
        """Largest reported env steps of a node; the same when its worker last died."""

    def __getstate__(self) -> dict[str, Any]:
        # Tune pickles its callbacks into a snapshot that is never read.
        return {}

    def on_step_end(self, **_: Any) -> None:
        for listener in self._listeners:
            listener.tick()

    def on_trial_start(self, *, trial: Trial, **_: Any) -> None:
        for listener in self._listeners:
            listener.started(self._node(trial))

    def on_trial_result(self, *, trial: Trial, result: dict[str, Any], **_: Any) -> None:
        node = self._node(trial)
        reports = from_json_lines(result[REPORTS].encode())
        for listener in self._listeners:
            for note in result[NOTES]:
                listener.noted(node, redact(note))
            if reports:
                listener.reported(node, reports)
        if reports:
            self._note_progress(trial, node.key, reports[-1].env_steps)

    def on_trial_complete(self, *, trial: Trial, **_: Any) -> None:
        """The trial ended: it failed, paused, published its result, or left it to others."""
        try:
            self._complete(self._node(trial), trial)
        finally:
            _free(trial)

    def _complete(self, node: Node, trial: Trial) -> None:
        if (cause := trial.last_result.get(CAUSE)) is not None:
            self._fail(node, cause, trial.last_result[TRACEBACK])
            return
        if (reached := trial.last_result.get(PAUSED)) is not None:
            self._scheduler.pause(node.key, reached)
            for listener in self._listeners:
                listener.paused(node)
            return
        if (holder := trial.last_result.get(LEFT)) is not None:
            # The next worker finds the lease of a dead one on another machine, and leaves the run.
            if len(deaths := self._deaths.get(node.key, [])) > RESTARTS:
                self._fail(node, cause_of(None, deaths[-1]), deaths[-1])
                return
            self._scheduler.leave(node.key)
            for listener in self._listeners:
                listener.left(node, holder)
            return
        try:
            result = self._store.result(node.key)
        except (StorageError, OSError) as error:
            self._fail(node, str(error), str(error))
            return
        assert result is not None, "a run publishes its result"
        self._scheduler.finish(node.key)
        for listener in self._listeners:
            listener.finished(node, result)

    def _note_progress(self, trial: Trial, key: str, steps: int) -> None:
        """Forget the deaths of a run that has passed the step of the last one.

        A long run on machines that can be reclaimed may lose many workers.
        """
        if key in self._deaths and steps > self._died_at[key]:
            del self._deaths[key]
            trial.run_metadata.num_failures = 0
        self._reached[key] = max(steps, self._reached.get(key, 0))

    def on_trial_error(self, *, trial: Trial, **_: Any) -> None:
        """The trial's worker died or never started, and is not restarted."""
        error = _error_of(trial)
        text = "".join(traceback.format_exception(error)) if error else _text_of(trial)
        text = _COLOR.sub("", text)
        self._fail(self._node(trial), cause_of(error, text), text)

    def on_trial_recover(self, *, trial: Trial, **_: Any) -> None:
        """The trial's worker died, and another worker resumes the run."""
        text, node = _COLOR.sub("", _text_of(trial)), self._node(trial)
        deaths = self._deaths.setdefault(node.key, [])
        deaths.append(text)
        self._died_at[node.key] = self._reached.get(node.key, 0)
        cause = redact(cause_of(_error_of(trial), text)).splitlines()[0]
        text = (
            f"{cause} Another worker resumes from the last checkpoint "
            f"({len(deaths)} of {RESTARTS} times)."
        )
        if len(deaths) > RESTARTS:
            return  # it fails
        if self._store.work_folder(node.key).folder.read(RECORD) is not None:
            text = "its environment hangs, so its worker was ended; the next worker names the call"
        for listener in self._listeners:
            listener.noted(node, text)

    def _fail(self, node: Node, cause: str, text: str) -> None:
        """Write the traceback `text` to a file, fail the node, and skip its dependants."""
        # An environment's message may hold a password.
        cause, text = redact(cause), redact(text)
        # A file name has at most 255 bytes; the key distinguishes shortened labels.
        label = re.sub(r"[^A-Za-z0-9._=,-]+", "_", node.label)[:150]
        log = self._failures / f"{label}-{node.key}.txt"
        try:
            log.parent.mkdir(parents=True, exist_ok=True)
            log.write_text(f"{node.label} (node {node.key})\n\n{text}\n", encoding="utf-8")
        except OSError as error:  # possibly the reason of the failure
            cause += f"\n(the traceback could not be written: {error})"
        dependants = self._scheduler.fail(node.key)
        for listener in self._listeners:
            listener.failed(node, Failure(cause, log))
            for dependant in dependants:
                listener.skipped(dependant, node)

    def _node(self, trial: Trial) -> Node:
        return self._scheduler.node(NodeJob.from_tune(trial.config).key)


def _error_of(trial: Trial) -> BaseException | None:
    """The exception, from a file that this process has just written."""
    try:
        error = cloudpickle.loads(Path(trial.pickled_error_file).read_bytes())
    except Exception:
        # Not every exception can be pickled; its text is always available.
        return None
    return error if isinstance(error, BaseException) else None


def _text_of(trial: Trial) -> str:
    """The traceback that Tune has written to a file."""
    try:
        return Path(trial.error_file).read_text(encoding="utf-8")
    except OSError as error:
        return f"The cause is unknown: {error}"


def _free(trial: Trial) -> None:
    """Free the reports and the actor's facts of an ended trial, which Tune keeps unread."""
    metadata = trial.run_metadata
    trial._default_result_or_future = None
    metadata.metric_analysis, metadata.metric_n_steps = {}, {}
    metadata.last_result = {**metadata.last_result, REPORTS: "", NOTES: []}
