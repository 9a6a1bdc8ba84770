"""Checks before anything is trained, so that a sweep does not fail an hour later."""

from __future__ import annotations

import shutil
from collections.abc import Set
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from rich.console import Console

from music_rllib.config.run_settings import RunSettings
from music_rllib.envs.tasks import BUILT_IN_TASKS, Task, beyond_observation, closest
from music_rllib.errors import BadInputError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.plan import Plan
from music_rllib.experiment.scheduler import Scheduler, Status
from music_rllib.experiment.session import Sweep
from music_rllib.runtime.ending import in_time
from music_rllib.runtime.machine import check_reachable, cluster_address
from music_rllib.runtime.signals import early
from music_rllib.store.handoff import open_handoff, read_handoff
from music_rllib.store.node_store import NodeStore

if TYPE_CHECKING:  # the environments are heavy, and most sweeps have none of their own
    from music_rllib.envs.make import Env


class TaskError(BadInputError, ValueError):
    """A task whose environment can't be made, or is not as the task describes it."""


def check_environments(plan: Plan, hang_minutes: float | None = None) -> None:
    """Make each environment of the user's once, and check that its task describes it.

    Args:
        plan: The sweep's plan.
        hang_minutes: The program ends where an environment takes longer; None: it waits.

    Raises:
        TaskError: A task does not fit; with one line per problem.
    """
    runs: dict[str, list[RunSettings]] = {}
    for run in plan.settings:
        if run.task.name not in BUILT_IN_TASKS:
            runs.setdefault(run.task.name, []).append(run)
    problems = []
    for name, of_task in runs.items():
        hindsight = {run.replay.hindsight_episodes for run in of_task if run.replay.hindsight_k > 0}
        rule = f"environments.{name} must be made and played within resources.hang_minutes"
        with in_time(hang_minutes and 60 * hang_minutes, f"{rule}, {hang_minutes}"):
            lines = _problems(of_task[0].task, hindsight)
        problems += [f"environments.{name}: {line}" for line in lines]
    if problems:
        raise TaskError("\n".join(problems))


def _problems(task: Task, hindsight: Set[str]) -> list[str]:
    """How the environment differs from its task.

    Args:
        task: The task.
        hindsight: The `replay.hindsight_episodes` of its runs; empty where none has hindsight.
    """
    from music_rllib.envs.make import make_env

    try:
        env = make_env(task.env_id, **task.env_kwargs)
    except Exception as error:  # a user's environment may raise anything
        return [f"env_id must name an environment that can be made, got {task.env_id!r}: {error}"]
    with closing(env):
        try:
            return _problems_of(task, env, hindsight)
        except Exception as error:
            return [f"env_id must name an environment that can be played, got {error!r}"]


def _problems_of(task: Task, env: Env, hindsight: Set[str]) -> list[str]:
    from music_rllib.envs.make import (
        check_action_space,
        goal_reward_of,
        moved_distance_of,
        observation_sizes,
    )

    try:
        check_action_space(env.action_space)
        size, goal_size = observation_sizes(env.observation_space)
    except ValueError as error:
        return [str(error).removeprefix("environment: ")]
    problems = beyond_observation(task.agent_indices, task.surrounding_indices, size)
    limit = env.spec.max_episode_steps if env.spec is not None else None
    if limit is not None and task.horizon > limit:
        problems.append(
            f"horizon must be <= {limit}, the environment's own limit, got {task.horizon}; "
            f"env_kwargs: {{max_episode_steps: {task.horizon}}} would raise that"
        )
    if task.success_key is not None and task.success_key not in (known := _info_keys(task, env)):
        problems.append(
            f"success_key must be null or a key of info ({', '.join(sorted(known)) or 'none'}), "
            f"got {task.success_key!r}{closest(task.success_key, known)}"
        )
    if hindsight and not goal_size:
        problems.append("must have goals for replay.hindsight_k > 0, its observations have none")
    elif hindsight:
        try:
            reward = goal_reward_of(env)
            if "moved" in hindsight and task.moved_distance is None:
                moved_distance_of(env, reward)
        except ValueError as error:
            problems.append(str(error))
    return problems


def _info_keys(task: Task, env: Env) -> set[str]:
    """Keys of `info` in an episode of random actions, up to the step that has the success key."""
    env.reset(seed=0)
    env.action_space.seed(0)
    keys: set[str] = set()
    for _ in range(task.horizon):
        *_, terminated, truncated, info = env.step(env.action_space.sample())
        keys.update(info)
        if task.success_key in keys or terminated or truncated:
            break
    return keys


def check_hardware(plan: Plan) -> None:
    """Check that this machine has the hardware for the runs' precision.

    Raises:
        BadInputError: It has not.
    """
    if all(run.tac.precision == "float32" for run in plan.settings):
        return
    from music_rllib.tac.kernels.precision import PrecisionError, check_precision

    try:
        check_precision("bf16")
    except PrecisionError as error:
        raise BadInputError(str(error)) from error


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


def check_searches(opened: Sweep) -> None:
    """Check that the studies of the searches can be opened."""
    if opened.plan.searched:
        from music_rllib.search.opening import check_studies

        check_studies(opened)


def check_ray(console: Console, opened: Sweep) -> None:
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
