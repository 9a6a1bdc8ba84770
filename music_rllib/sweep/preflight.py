"""Checks before anything is trained, so that a sweep does not fail an hour later."""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.console import Console

from music_rllib.config.run_settings import RunSettings
from music_rllib.envs.fingerprint import Fingerprint, fingerprint_of
from music_rllib.envs.modules import folders_for_workers
from music_rllib.envs.tasks import BUILT_IN_TASKS
from music_rllib.errors import BadInputError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.open_sweep import OpenSweep
from music_rllib.experiment.plan import Plan
from music_rllib.experiment.scheduler import Scheduler, Status
from music_rllib.runtime.machine import check_reachable, cluster_address
from music_rllib.runtime.process import early
from music_rllib.store.handoff import open_handoff, read_handoff
from music_rllib.store.node_store import NodeStore

_TIMEOUT = "Timeout ("
"""Beginning of the stack that `faulthandler` writes where a call takes too long."""
_SLACK = 10.0
"""Seconds that the child process has to end itself where a call takes too long."""
_HUMAN = "env_kwargs: {render_mode: human} needs a display; leave it out for training"


class TaskError(BadInputError, ValueError):
    """A task whose environment can't be made, or is not as the task describes it."""


def check_environments(plan: Plan, hang_minutes: float | None = None) -> list[str]:
    """Play each environment of the user's, and check that its task describes it.

    They are played in a child process, since an environment may abort, end or block its process.

    Args:
        plan: The sweep's plan.
        hang_minutes: Longest duration of one call of an environment; None: no limit.

    Returns:
        Remarks, one line each.

    Raises:
        TaskError: A task does not fit; with one line per problem, and the remarks.
    """
    runs: dict[str, list[RunSettings]] = {}
    for run in plan.settings:
        if run.task.name not in BUILT_IN_TASKS:
            runs.setdefault(run.task.name, []).append(run)
    left: dict[str, dict[str, Any]] = {
        name: {
            "task": of_task[0].task.model_dump(mode="json"),
            "hindsight": sorted(
                {run.replay.hindsight_episodes for run in of_task if run.replay.hindsight_k > 0}
            ),
        }
        for name, of_task in runs.items()
    }
    problems, remarks = [], []
    while left:
        for name, wrong, noteworthy in _play(left, hang_minutes):
            human = left.pop(name)["task"]["env_kwargs"].get("render_mode") == "human"
            if wrong and human:
                wrong[0] += f" ({_HUMAN})"
            problems += [f"environments.{name}: {line}" for line in wrong]
            remarks += [f"environments.{name}: {line}" for line in noteworthy]
    if problems:
        raise TaskError("\n".join((*problems, *(f"also: {line}" for line in remarks))))
    return remarks


def fingerprints(plan: Plan) -> dict[str, Fingerprint]:
    """The fingerprint of each task's environment, by the task's name; imports those of the user.

    Raises:
        TaskError: The module of an environment can't be imported.
    """
    found = {}
    for task in {run.task.name: run.task for run in plan.settings}.values():
        try:
            found[task.name] = fingerprint_of(task.env_id, task.env_kwargs)
        except Exception as error:  # a user's module may raise anything
            raise TaskError(f"environments.{task.name} must be importable: {error}") from error
    return found


def _play(
    left: Mapping[str, Mapping[str, Any]], hang_minutes: float | None
) -> list[tuple[str, list[str], list[str]]]:
    """Task, problems and remarks of those that a child process played until it ended."""
    seconds = None if hang_minutes is None else 60 * hang_minutes
    request = json.dumps({"questions": list(left.values()), "seconds": seconds})
    answers, end = os.pipe()
    # The child finds modules where this process does. -P: not in its current folder only.
    entries = (*sys.path, *folders_for_workers())
    path = os.pathsep.join(str(Path(entry).absolute()) for entry in entries)
    command = [sys.executable, "-P", "-m", "music_rllib.envs.probe", str(end)]
    with subprocess.Popen(  # noqa: S603
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        pass_fds=(end,),
        start_new_session=True,
        env=os.environ | {"PYTHONPATH": path},
    ) as process:
        os.close(end)
        try:
            assert process.stdin is not None
            assert process.stderr is not None
            with contextlib.suppress(BrokenPipeError), process.stdin as stdin:
                stdin.write(request.encode())
            heard, errors = _listen(process, answers, process.stderr.fileno(), seconds)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # with what the environments have started
            os.close(answers)
    lines = [json.loads(line) for line in heard.decode().split("\n")[:-1]]
    done = [tuple(line[1:]) for line in lines if line[0] == "done"]
    if len(done) < len(left):
        name = next(name for name in left if name not in {name for name, *_ in done})
        calls = [line[2] for line in lines if line[0] == "call" and line[1] == name]
        reason = _why_it_ended(process.returncode, calls[-1] if calls else "import", errors)
        done.append((name, [reason], []))
    return done


def _listen(
    process: subprocess.Popen[bytes], answers: int, errors: int, seconds: float | None
) -> tuple[bytes, str]:
    """Answers of the child until it ends, and the last of its standard error."""
    heard, tail, last, ended = b"", b"", time.monotonic(), None
    with selectors.DefaultSelector() as selector:
        selector.register(answers, selectors.EVENT_READ)
        selector.register(errors, selectors.EVENT_READ)
        while True:
            if ended is None and process.poll() is not None:
                ended = time.monotonic()
            events = selector.select(0.2 if ended is None else 0.0)
            for key, _ in events:
                chunk = os.read(key.fd, 1 << 16)
                if not chunk:
                    selector.unregister(key.fd)
                elif key.fd == answers:
                    heard, last = heard + chunk, time.monotonic()
                else:
                    tail = (tail + chunk)[-(1 << 16) :]
            # What an environment has started may write on.
            if ended is not None and (not events or time.monotonic() > ended + 1.0):
                break
            # The child ends itself, unless the environment has seen to it that it does not.
            if seconds is not None and time.monotonic() - last > seconds + _SLACK:
                process.kill()
                tail = _TIMEOUT.encode()
    return heard, tail.decode(errors="replace")


def _why_it_ended(code: int, call: str, errors: str) -> str:
    """The rule that an environment breaks whose process has ended within a call."""
    before = errors.partition("(most recent call first):\n")[0]
    threads = [thread for thread in errors.split("\n\n") if "envs/probe.py" in thread]
    places = [line.strip() for line in "".join(threads[:1]).splitlines() if "  File " in line]
    at = f" at {places[0]}" if places else ""
    if _TIMEOUT in errors:
        return f"{call} must return within resources.hang_minutes, it hangs{at}"
    skipped = ("Fatal Python error", "Thread", "Current thread", " ")
    lines = [line for line in before.splitlines() if line and not line.startswith(skipped)]
    said = f": {lines[-1][-200:]}" if lines and code != -signal.SIGKILL else ""
    if code >= 0:
        return f"{call} must not end its process, which ended with exit code {code}{said}"
    name = signal.Signals(-code).name
    memory = "; the system often does that for lack of memory" if name == "SIGKILL" else ""
    return f"{call} must not end its process, which died of {name}{at}{memory}{said}"


def import_checkpoints(plan: Plan, store: NodeStore) -> None:
    """Put handoffs from outside into the store, where workers on any machine find them.

    Raises:
        HandoffError: One is damaged.
        StorageError: The store can't be written.
    """
    for source in plan.imports:
        if store.is_finished(source.key):
            continue
        assert source.checkpoint is not None
        folder, manifest = open_handoff(source.checkpoint.folder)
        read_handoff(folder, list(manifest.modules), manifest.info.task)
        with TemporaryDirectory() as temporary:
            target = Path(temporary, "handoff")
            target.mkdir()
            for file in ("handoff.json", *(module.file for module in manifest.modules.values())):
                shutil.copyfile(folder / file, target / file)
            store.publish(source.key, Path(temporary))


def verify_inputs(scheduler: Scheduler, store: NodeStore) -> None:
    """Read the finished nodes from which waiting nodes start.

    Raises:
        DamagedError: A node isn't what its manifest says.
    """
    waiting = scheduler.having(Status.WAITING)
    for key in dict.fromkeys(node.input.key for node in waiting if node.input):
        if store.is_finished(key):
            store.verify(key)


def check_searches(opened: OpenSweep) -> None:
    """Check that the studies of the searches can be opened."""
    if opened.plan.searched:
        from music_rllib.search.opening import check_studies

        check_studies(opened)


def check_ray(console: Console, opened: OpenSweep) -> None:
    """Check that Ray answers and can hold a run, unless nothing is left to compute."""
    begun = (opened.folder / sweep_files.CONFIG).is_file()
    if opened.scheduler.complete and (begun or not opened.plan.searched):
        return
    if (address := cluster_address()) is not None:
        check_reachable(address)
    from music_rllib.runtime.ray_cluster import check_fits

    if remark := check_fits(opened.config.resources):
        console.print(remark, style="yellow", soft_wrap=True)
    early.install()  # Ray has set a handler of its own
    early.check()
