"""Checks before training, so that a sweep does not fail after an hour."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterable
from functools import partial
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from rich.console import Console

from music_rllib.config.problems import shown
from music_rllib.config.run_settings import RunSettings
from music_rllib.envs.fingerprint import Fingerprint, fingerprint_of
from music_rllib.envs.tasks import BUILT_IN_TASKS, folders_for_workers
from music_rllib.errors import BadInputError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.open_sweep import OpenSweep
from music_rllib.experiment.plan import Plan
from music_rllib.runtime.machine import check_reachable, cluster_address
from music_rllib.runtime.machine import memory as memory_of_machine
from music_rllib.runtime.process import early
from music_rllib.store.handoff import HandoffError, open_handoff, read_handoff
from music_rllib.store.node_store import NodeStore
from music_rllib.sweep.views.plan import cluster_answer, cluster_text

if TYPE_CHECKING:
    from music_rllib.envs.probe import Question
    from music_rllib.runtime.ray_cluster import Capacity

_TIMEOUT = "Timeout ("
"""Beginning of the stack that `faulthandler` writes if a call takes too long."""
_HUMAN = "env_kwargs: {render_mode: human} needs a display; leave it out for training"


def check_environments(plan: Plan, hang_minutes: float | None = None) -> list[str]:
    """Play each declared environment in a child process, and check that its task describes it.

    Also play the tasks between which agents are transferred, whose sizes must be equal. One call of
    an environment may take `hang_minutes`; None: no limit. Returns remarks, one line each.

    Raises:
        BadInputError: A task does not fit; with one line per problem, and the remarks.
    """
    runs = [run for run in plan.settings if run.task.name not in BUILT_IN_TASKS]
    # A handoff has the sizes of its task, whose environment need not be installed here.
    transferred = {
        task.name: task
        for source, task in plan.transfers
        for task in (task, *([source.task] if source.task and not source.checkpoint else []))
    }
    if not runs and not transferred:
        return []
    from music_rllib.envs.probe import Question

    left = {name: Question(task=task) for name, task in transferred.items()}
    for run in runs:
        question = left.setdefault(run.task.name, Question(task=run.task))
        if run.replay.hindsight_k > 0:
            episodes = {*question.hindsight, run.replay.hindsight_episodes}
            question.hindsight = tuple(sorted(episodes))
        if run.intrinsic.reward is not None:
            question.rewards = tuple(sorted({*question.rewards, run.intrinsic.reward}))
        question.intrinsic |= run.music.estimator != "none" or run.intrinsic.reward is not None
    problems, remarks, sizes = [], [], {}
    while left:  # the child process ends early at an environment that ends it
        for name, wrong, noteworthy, sizes[name] in _play([*left.values()], hang_minutes):
            human = left.pop(name).task.env_kwargs.get("render_mode") == "human"
            if wrong and human:
                wrong[0] += f" ({_HUMAN})"
            problems += [f"environments.{name}: {line}" for line in wrong]
            remarks += [f"environments.{name}: {line}" for line in noteworthy]
    for source, task in plan.transfers:
        assert source.task is not None
        if source.checkpoint is None:
            theirs = sizes[source.task.name]
        else:
            found = source.checkpoint.manifest.info.spaces
            theirs = [found.observation_size, found.goal_size, len(found.action_low)]
        ours = sizes[task.name]
        if theirs and ours and theirs != ours:
            problems.append(
                f"init_from.task must have observations, goals and actions of the sizes of "
                f"{task.name}, {tuple(ours)}, got {source.task.name} with {tuple(theirs)}"
            )
    if problems:
        raise BadInputError("\n".join((*problems, *(f"also: {line}" for line in remarks))))
    return remarks


def fingerprints(plan: Plan) -> dict[str, Fingerprint]:
    """The fingerprint of each task's environment, by `RunSettings.code`; imports users' modules.

    Raises:
        BadInputError: The module of an environment or of an intrinsic reward can't be imported, or
            the reward's class or settings do not fit.
    """
    found = {}
    for code, run in {run.code: run for run in plan.settings}.items():
        try:
            found[code] = fingerprint_of(run.task.env_id, run.task.env_kwargs, run.own_modules)
        except Exception as error:  # a user's module may raise anything
            own = f" and intrinsic.reward {run.intrinsic.reward}" if run.own_modules else ""
            place = f"environments.{run.task.name}{own}"
            raise BadInputError(f"{place} must be importable: {error}") from error
    own_rewards = {
        run.intrinsic.identity: run.intrinsic for run in plan.settings if run.own_modules
    }
    for settings in own_rewards.values():
        from music_rllib.intrinsic.make import checked_class

        try:
            checked_class(settings)
        except ValueError as error:
            raise BadInputError(str(error)) from error
    return found


def _play(
    questions: list[Question], hang_minutes: float | None
) -> list[tuple[str, list[str], list[str], list[int]]]:
    """Name, problems, remarks and sizes of the tasks that a child process played until it ended."""
    from music_rllib.envs.probe_process import ANSWERS, REQUEST, Request

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
                [sys.executable, "-P", "-m", "music_rllib.envs.probe_process", temporary],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                start_new_session=True,
                env=os.environ | {"PYTHONPATH": path},
            )
        try:
            process.wait()
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # with the processes of the environments
            process.wait()
        lines = [json.loads(line) for line in answers.read_text().split("\n")[:-1]]
        text = errors.read_text(errors="replace")[-(1 << 16) :]
    done = [(name, *found) for kind, name, *found in lines if kind == "done"]
    if len(done) < len(questions):
        name = questions[len(done)].task.name
        calls = [line[2] for line in lines if line[:2] == ["call", name]]
        done.append(
            (name, [_why_it_ended(process.returncode, (calls or ["import"])[-1], text)], [], [])
        )
    return done


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
        HandoffError: One is damaged, or is another one than when the sweep was loaded.
        StorageError: The store can't be written.
    """
    for handoff in plan.imports:
        if store.is_finished(handoff.key):
            continue
        folder, manifest = open_handoff(handoff.folder)
        if manifest.content_hash != handoff.manifest.content_hash:
            raise HandoffError(
                f"{handoff.folder} must not change while the sweep starts, it has: start it again"
            )
        read_handoff(folder, list(manifest.modules), manifest.info.task)
        with TemporaryDirectory() as temporary:
            target = Path(temporary, "handoff")
            target.mkdir()
            for file in ("handoff.json", *(module.file for module in manifest.modules.values())):
                shutil.copyfile(folder / file, target / file)
            store.publish(handoff.key, Path(temporary))


def check_searches(opened: OpenSweep) -> None:
    """Check that the studies of the searches can be opened."""
    if opened.plan.searched:
        from music_rllib.search.searches import check_studies

        check_studies(opened)


def find_cluster(
    console: Console, opened: OpenSweep, wait_minutes: float | None
) -> Capacity | None:
    """Connect to the cluster, and show its room for runs, unless everything is computed.

    Raises:
        ClusterError: It does not answer, or cannot hold a run.
    """
    begun = (opened.folder / sweep_files.CONFIG).is_file()
    address = cluster_address()
    if address is None or (opened.scheduler.complete and (begun or not opened.plan.searched)):
        return None
    if "RAY_JOB_CONFIG_JSON_ENV_VAR" in os.environ:
        return None  # Ray deletes the working folder of a job that disconnects
    check_reachable(address)
    from music_rllib.runtime.ray_cluster import cluster

    say = partial(console.print, style="yellow", soft_wrap=True)
    with cluster(opened.config.resources, wait_minutes, say) as capacity:
        console.print(cluster_text(address, cluster_answer(opened, capacity)), soft_wrap=True)
        if capacity.remark is not None:
            say(capacity.remark)
    early.install()  # Ray has set a handler of its own
    early.check()
    return capacity


def check_demand(sweep: OpenSweep, node_memory: float | None = None) -> None:
    """Check that each unfinished run fits into the memory of this machine, or of a cluster's nodes.

    `node_memory` is that of the largest node in bytes.

    Raises:
        BadInputError: A run does not fit.
    """
    runs = [(node.stage, node.run) for node in sweep.plan.nodes if not sweep.is_finished(node.key)]
    for stage in sweep.plan.searched:
        runs += [(stage.name, run) for run in stage.points[0].runs.values()]
    if node_memory is None:
        check_memory(runs, "this machine", memory_of_machine())
    else:
        check_memory(runs, "the cluster's largest node", node_memory)


def check_memory(runs: Iterable[tuple[str, RunSettings]], place: str, memory: float) -> None:
    """Check that each of `runs`, given with the names of their stages, fits into `memory` bytes.

    Raises:
        BadInputError: A run does not fit; the message names the setting that needs most.
    """
    for stage, run in runs:
        needed = _least_memory(run)
        setting = max(needed, key=lambda name: needed[name])
        if sum(needed.values()) > memory:
            raise BadInputError(
                f"stage {stage}: {setting} must fit into the memory of {place}, "
                f"{memory / 2**30:.1f} GiB, got {shown(attrgetter(setting)(run))}, for which a run "
                f"on {run.task.name} needs at least {needed[setting] / 2**30:.3g} GiB"
            )


def _least_memory(run: RunSettings) -> dict[str, int]:
    """Bytes that a run needs at least, by the setting that causes them.

    An observation counts up to the largest index of the task's agent and surroundings.
    """
    tac, task = run.tac, run.task
    observation = 1 + max((*task.agent_indices, *task.surrounding_indices), default=0)
    row = 4 * (observation + 3)  # with action, reward, and whether the episode ended
    weights = sum(above * below for above, below in pairwise((observation, *tac.hidden_sizes, 1)))
    return {
        # Weights, gradients and Adam's two moments of the policy and the critics.
        "tac.hidden_sizes": 4 * 4 * (1 + tac.critic_count) * weights,
        "tac.batch_size": tac.batch_size * row,
        "replay.capacity": run.replay.capacity * row,
        # An evaluation keeps all of its trajectories until it ends.
        "evaluation.episodes": run.evaluation.episodes * task.horizon * row,
        "num_envs": run.num_envs * 10_000,
    }
