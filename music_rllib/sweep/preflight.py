"""Checks before training, so that a sweep does not fail after an hour."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from rich.console import Console

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

if TYPE_CHECKING:
    from music_rllib.envs.probe import Question

_TIMEOUT = "Timeout ("
"""Beginning of the stack that `faulthandler` writes if a call takes too long."""
_SLACK = 10.0
"""Seconds that the child process has to end itself if a call takes too long."""
_HUMAN = "env_kwargs: {render_mode: human} needs a display; leave it out for training"


class TaskError(BadInputError, ValueError):
    """A task whose environment can't be made, or is not as the task describes it."""


def check_environments(plan: Plan, hang_minutes: float | None = None) -> list[str]:
    """Play each declared environment in a child process, and check that its task describes it.

    Args:
        plan: The sweep's plan.
        hang_minutes: Maximum duration of one call of an environment; None: no limit.

    Returns:
        Remarks, one line each.

    Raises:
        TaskError: A task does not fit; with one line per problem, and the remarks.
    """
    runs = [run for run in plan.settings if run.task.name not in BUILT_IN_TASKS]
    if not runs:
        return []
    from music_rllib.envs.probe import Question

    left: dict[str, Question] = {}
    for run in runs:
        question = left.setdefault(run.task.name, Question(task=run.task))
        if run.replay.hindsight_k > 0:
            episodes = {*question.hindsight, run.replay.hindsight_episodes}
            question.hindsight = tuple(sorted(episodes))
    problems, remarks = [], []
    while left:  # the child process ends early at an environment that ends it
        for name, wrong, noteworthy in _play([*left.values()], hang_minutes):
            human = left.pop(name).task.env_kwargs.get("render_mode") == "human"
            if wrong and human:
                wrong[0] += f" ({_HUMAN})"
            problems += [f"environments.{name}: {line}" for line in wrong]
            remarks += [f"environments.{name}: {line}" for line in noteworthy]
    if problems:
        raise TaskError("\n".join((*problems, *(f"also: {line}" for line in remarks))))
    return remarks


def fingerprints(plan: Plan) -> dict[str, Fingerprint]:
    """The fingerprint of each task's environment, by the task's name; imports users' modules.

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
    questions: list[Question], hang_minutes: float | None
) -> list[tuple[str, list[str], list[str]]]:
    """Name, problems and remarks of the tasks that a child process played until it ended."""
    from music_rllib.envs.probe import ANSWERS, REQUEST, Request

    seconds = None if hang_minutes is None else 60 * hang_minutes
    # The child searches for modules where this process does. -P: not in the current folder first.
    entries = (*sys.path, *folders_for_workers())
    path = os.pathsep.join(str(Path(entry).absolute()) for entry in entries)
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        answers, errors = folder / ANSWERS, folder / "errors"
        answers.touch()
        request = Request(questions=questions, seconds=seconds)
        (folder / REQUEST).write_text(request.model_dump_json())
        with errors.open("wb") as stderr:
            process = subprocess.Popen(  # noqa: S603
                [sys.executable, "-P", "-m", "music_rllib.envs.probe", temporary],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                start_new_session=True,
                env=os.environ | {"PYTHONPATH": path},
            )
        try:
            hangs = not _ends(process, answers, seconds)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # with the processes of the environments
            process.wait()
        lines = [json.loads(line) for line in answers.read_text().split("\n")[:-1]]
        text = _TIMEOUT if hangs else errors.read_text(errors="replace")[-(1 << 16) :]
    done = [(name, *found) for kind, name, *found in lines if kind == "done"]
    if len(done) < len(questions):
        name = questions[len(done)].task.name
        calls = [line[2] for line in lines if line[:2] == ["call", name]]
        done.append(
            (name, [_why_it_ended(process.returncode, (calls or ["import"])[-1], text)], [])
        )
    return done


def _ends(process: subprocess.Popen[bytes], answers: Path, seconds: float | None) -> bool:
    """Wait for the child; False if a call takes too long and the child does not end itself."""
    while True:
        try:
            process.wait(timeout=0.2)
        except subprocess.TimeoutExpired:
            silent = time.time() - answers.stat().st_mtime
            if seconds is not None and silent > seconds + _SLACK:
                return False
        else:
            return True


def _why_it_ended(code: int, call: str, errors: str) -> str:
    """The rule that an environment broke whose process ended during a call."""
    from music_rllib.training.hang_watch import place_in

    before = errors.partition("(most recent call first):\n")[0]
    place = place_in(errors, "envs/probe.py")
    at = f" at {place}" if place else ""
    if _TIMEOUT in errors:
        return f"{call} must return within resources.hang_minutes, it hangs{at}"
    skipped = ("Fatal Python error", "Thread", "Current thread", " ")
    lines = [line for line in before.splitlines() if line and not line.startswith(skipped)]
    last = f": {lines[-1][-200:]}" if lines and code != -signal.SIGKILL else ""
    if code >= 0:
        return f"{call} must not end its process, which ended with exit code {code}{last}"
    name = signal.Signals(-code).name
    memory = "; the system often does that for lack of memory" if name == "SIGKILL" else ""
    return f"{call} must not end its process, which died of {name}{at}{memory}{last}"


def import_checkpoints(plan: Plan, store: NodeStore) -> None:
    """Copy handoffs from outside into the store, where workers on any machine find them.

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
        DamagedError: A node differs from its manifest.
    """
    waiting = scheduler.having(Status.WAITING)
    for key in dict.fromkeys(node.input.key for node in waiting if node.input):
        if store.is_finished(key):
            store.verify(key)


def check_searches(opened: OpenSweep) -> None:
    """Check that the studies of the searches can be opened."""
    if opened.plan.searched:
        from music_rllib.search.searches import check_studies

        check_studies(opened)


def check_ray(console: Console, opened: OpenSweep) -> None:
    """Check that a cluster answers and can hold a run, unless everything is computed.

    Raises:
        ClusterError: It does not.
    """
    begun = (opened.folder / sweep_files.CONFIG).is_file()
    address, resources = cluster_address(), opened.config.resources
    if address is None or (opened.scheduler.complete and (begun or not opened.plan.searched)):
        return
    check_reachable(address)
    if resources.bundle == {"CPU": 1}:  # every node can hold that
        return
    from music_rllib.runtime.ray_cluster import cluster

    with cluster(resources) as capacity:
        if capacity.remark is not None:
            console.print(capacity.remark, style="yellow", soft_wrap=True)
    early.install()  # Ray has set a handler of its own
    early.check()
