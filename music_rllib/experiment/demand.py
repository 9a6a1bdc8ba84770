"""What runs need at least, by their settings alone, against what a machine has.

A lower bound of memory: what is left out (the interpreter, buffers, an environment's own) is there
whatever the settings are. Observations count as far as a task's split tells their size.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from music_rllib.config.problems import shown
from music_rllib.config.run_settings import RunSettings
from music_rllib.envs.tasks import Task
from music_rllib.errors import BadInputError
from music_rllib.runtime import machine as local

if TYPE_CHECKING:
    from music_rllib.experiment.session import Sweep

__all__ = ["DemandError", "Machine", "check_demand", "check_memory", "long_runs"]

FLOAT = 4
STEPS_PER_SECOND = 50_000
"""Environment steps of a process that simulates as fast as any does."""
UPDATES_PER_SECOND = 10_000
"""Gradient updates of small networks on the fastest hardware."""
LONG_DAYS = 60
"""A run that takes longer at these rates was hardly meant."""
ENVIRONMENT_BYTES = 10_000
"""Of one sub-environment; MuJoCo's take a hundred times that."""

CERTAIN_BYTES = 2 * 2**30
"""Memory that a cluster's nodes are not asked for."""


class DemandError(BadInputError, ValueError):
    """A run that no machine at hand can hold."""


@dataclass(frozen=True)
class Machine:
    """Where runs are to run."""

    name: str
    memory: int
    """Bytes that it has."""
    claimable: int
    """Bytes that its system grants one process at once, used or not."""


def check_demand(sweep: Sweep) -> list[str]:
    """Look whether the runs that are left can be held in memory, and would ever end.

    Returns:
        What a person should know who may have meant something else.

    Raises:
        DemandError: One of them can't be held.
        ClusterError: The cluster that would say so can't be reached.
    """
    runs = [(node.stage, node.run) for node in sweep.plan.nodes if node.key not in sweep.finished]
    for stage in sweep.config.stages:
        if stage.search is not None:
            runs += [(stage.name, run) for run in stage.points[0].runs.values()]
    machine = Machine("this machine", local.memory(), local.claimable())
    if (address := local.cluster_address()) is not None:
        machine = _cluster_machine(address, sweep, runs)
    check_memory(runs, machine)
    return list(long_runs(runs))


def _cluster_machine(address: str, sweep: Sweep, runs: list[tuple[str, RunSettings]]) -> Machine:
    """The largest node, where it matters and no larger one may be added."""
    name = "the cluster's largest node"
    address_space = 2**47
    most = max((least_memory(run) for _, run in runs), default=0)
    if most <= CERTAIN_BYTES:
        return Machine(name, CERTAIN_BYTES, address_space)
    from music_rllib.runtime.ray_cluster import cluster

    local.check_reachable(address)
    with cluster(sweep.config.resources) as room:
        return Machine(name, address_space if room.grows else room.memory, address_space)


def least_memory(run: RunSettings) -> int:
    """Bytes that a run needs at least."""
    return sum(amount for _, _, amount in _parts(run))


def check_memory(runs: Iterable[tuple[str, RunSettings]], machine: Machine) -> None:
    """Look whether each of `runs`, with the names of their stages, fits by itself.

    Raises:
        DemandError: One doesn't; names the setting that asks for most, and both amounts.
    """
    for stage, run in runs:
        setting, value, amount = max(_parts(run), key=lambda part: part[2])
        has, limit = "the memory of", machine.memory
        if least_memory(run) <= limit:
            # The replay's array is claimed whole, and costs memory as it fills.
            setting, value = "replay.capacity", run.replay.capacity
            amount = value * _row_bytes(run.task)
            has, limit = "what a process may claim on", machine.claimable
            if amount <= limit:
                continue
        raise DemandError(
            f"stage {stage}: {setting} must fit into {has} {machine.name}, {_gib(limit)}, got "
            f"{shown(value)}, for which a run on {run.task.name} needs {_gib(amount)} at least"
        )


def long_runs(runs: Iterable[tuple[str, RunSettings]]) -> Iterator[str]:
    """One line per stage and task whose runs would take months or years on any hardware."""
    said = set()
    for stage, run in runs:
        setting, value, seconds = max(_seconds(run), key=lambda part: part[2])
        days = seconds // 86_400
        if days >= LONG_DAYS and (stage, run.task.name) not in said:
            said.add((stage, run.task.name))
            years = days // 365
            time = f"{_number(years)} years" if years > 1 else f"{days} days"
            yield (
                f"stage {stage}: a run on {run.task.name} takes {time} on the fastest hardware, "
                f"with {setting} {shown(value)}"
            )


def _seconds(run: RunSettings) -> Iterator[tuple[str, object, int]]:
    """Setting, value and the seconds that come with it."""
    evaluation = run.evaluation
    evaluations = 1 - (-run.env_steps // evaluation.interval)
    yield "env_steps", run.env_steps, run.env_steps // STEPS_PER_SECOND
    played = evaluations * evaluation.episodes * run.task.horizon
    yield "evaluation.episodes", evaluation.episodes, played // STEPS_PER_SECOND
    ratio = run.tac.replay_ratio
    updates = (run.env_steps - run.tac.random_steps) * int(ratio)
    yield "tac.replay_ratio", ratio, updates // UPDATES_PER_SECOND if ratio > 1 else 0


def _parts(run: RunSettings) -> Iterator[tuple[str, object, int]]:
    """Setting, value and the bytes that come with it."""
    tac, replay, music, horizon = run.tac, run.replay, run.music, run.task.horizon
    row, observation = _row_bytes(run.task), _observation(run.task)
    yield "tac.hidden_sizes", tac.hidden_sizes, FLOAT * _network_numbers(run, observation)
    wide = sum(tac.hidden_sizes) > tac.batch_size
    setting = ("tac.hidden_sizes", tac.hidden_sizes) if wide else ("tac.batch_size", tac.batch_size)
    yield *setting, tac.batch_size * (row + FLOAT * sum(tac.hidden_sizes))
    yield "replay.capacity", replay.capacity, min(replay.capacity, run.env_steps) * row
    # The trajectories of an evaluation are counted when all are there.
    episodes = run.evaluation.episodes
    yield "evaluation.episodes", episodes, episodes * horizon * row
    yield "num_envs", run.num_envs, run.num_envs * (ENVIRONMENT_BYTES + horizon * row)
    if music.estimator != "none":
        units, batch = music.hidden_size, music.batch_trajectories
        yield "music.hidden_size", units, 4 * FLOAT * units * (observation + 2)
        wide = units > batch * horizon
        asked = ("music.hidden_size", units) if wide else ("music.batch_trajectories", batch)
        yield *asked, FLOAT * batch * horizon * (observation + units)


def _row_bytes(task: Task) -> int:
    """Of a transition: what is observed, an action, its reward and whether it was the last."""
    return FLOAT * (_observation(task) + 3)


def _network_numbers(run: RunSettings, observation: int) -> int:
    """Weights with gradients and Adam's two moments, and averaged weights."""
    tac = run.tac
    policy = _weights(observation, tac.hidden_sizes, 1)
    critics = _weights(observation + 1, tac.hidden_sizes, 1)
    if tac.policy == "stochastic":
        critics *= 2
    if tac.bootstrap == "value":
        value = averaged = _weights(observation, tac.hidden_sizes, 1)
    else:
        value, averaged = 0, critics
    return 4 * (policy + critics + value) + averaged


def _weights(inputs: int, hidden_sizes: tuple[int, ...], outputs: int) -> int:
    sizes = [inputs, *hidden_sizes, outputs]
    return sum((fan_in + 1) * fan_out for fan_in, fan_out in pairwise(sizes))


def _observation(task: Task) -> int:
    """As far as the task says."""
    return 1 + max((*task.agent_indices, *task.surrounding_indices), default=0)


def _gib(amount: int) -> str:
    return f"{_number(amount / 2**30 if amount < 10**30 else amount // 2**30)} GiB"


def _number(value: float) -> str:
    return f"{value:,.1f}" if value < 1e6 else f"{min(value, 10**300):.1e}"
