"""The memory and time that runs need at least, by their settings alone.

The bound of memory leaves out what is there whatever the settings are: the interpreter, its
libraries, an environment's own data. An observation counts as far as the task's split of it into
agent and surroundings reaches.
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
    from music_rllib.experiment.open_sweep import OpenSweep

FLOAT = 4
"""Bytes of a number."""
STEPS_PER_SECOND = 50_000
"""Environment steps of a process that simulates as fast as any does."""
UPDATES_PER_SECOND = 10_000
"""Gradient updates of small networks on the fastest hardware."""
LONG_DAYS = 60
"""A run that takes longer at these rates is probably a mistake."""
ENVIRONMENT_BYTES = 10_000
"""Memory of one sub-environment; MuJoCo's take a hundred times that."""

CERTAIN_BYTES = 2 * 2**30
"""Memory that every node of a cluster is assumed to have."""

Demand = tuple[str, object, int]
"""A dotted setting, its value, and the bytes or seconds that it causes."""


class DemandError(BadInputError, ValueError):
    """A run that no available machine can hold."""


@dataclass(frozen=True)
class Machine:
    """Where runs are to run."""

    name: str
    memory: int
    """Its memory in bytes."""
    claimable: int
    """Bytes that its system grants one process at once, used or not."""


def check_demand(sweep: OpenSweep) -> list[str]:
    """Check that the unfinished runs fit into memory.

    Returns:
        Warnings about runs that would take months or years.

    Raises:
        DemandError: A run does not fit.
        ClusterError: The cluster whose memory counts can't be reached.
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


def _cluster_machine(
    address: str, sweep: OpenSweep, runs: list[tuple[str, RunSettings]]
) -> Machine:
    """The cluster's largest node; it is only asked for its memory where the runs need much."""
    name = "the cluster's largest node"
    address_space = 2**47  # bytes: no limit
    most = max((least_memory(run) for _, run in runs), default=0)
    if most <= CERTAIN_BYTES:
        return Machine(name, CERTAIN_BYTES, address_space)
    from music_rllib.runtime.ray_cluster import cluster

    local.check_reachable(address)
    with cluster(sweep.config.resources) as room:
        return Machine(name, address_space if room.grows else room.memory, address_space)


def least_memory(run: RunSettings) -> int:
    """Bytes that a run needs at least."""
    return sum(amount for _, _, amount in _memory(run))


def check_memory(runs: Iterable[tuple[str, RunSettings]], machine: Machine) -> None:
    """Check that each of `runs`, given with the names of their stages, fits on `machine` alone.

    Raises:
        DemandError: A run does not fit; the message names the setting that needs most.
    """
    for stage, run in runs:
        setting, value, amount = max(_memory(run), key=lambda demand: demand[2])
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
    seen = set()
    for stage, run in runs:
        setting, value, seconds = max(_seconds(run), key=lambda demand: demand[2])
        days = seconds // 86_400
        if days >= LONG_DAYS and (stage, run.task.name) not in seen:
            seen.add((stage, run.task.name))
            years = days // 365
            time = f"{_number(years)} years" if years > 1 else f"{days} days"
            yield (
                f"stage {stage}: a run on {run.task.name} takes {time} on the fastest hardware, "
                f"with {setting} {shown(value)}"
            )


def _seconds(run: RunSettings) -> Iterator[Demand]:
    """Seconds that a run takes at least, by setting."""
    evaluation = run.evaluation
    evaluations = 1 - (-run.env_steps // evaluation.interval)
    yield "env_steps", run.env_steps, run.env_steps // STEPS_PER_SECOND
    played = evaluations * evaluation.episodes * run.task.horizon
    yield "evaluation.episodes", evaluation.episodes, played // STEPS_PER_SECOND
    ratio = run.tac.replay_ratio
    updates = (run.env_steps - run.tac.steps_before_updates) * int(ratio)
    yield "tac.replay_ratio", ratio, updates // UPDATES_PER_SECOND if ratio > 1 else 0


def _memory(run: RunSettings) -> Iterator[Demand]:
    """Bytes that a run needs at least, by setting."""
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
    """Bytes of a transition: observation, action, reward, and whether it was the last."""
    return FLOAT * (_observation(task) + 3)


def _network_numbers(run: RunSettings, observation: int) -> int:
    """Numbers of all networks: weights, gradients, Adam's two moments, and target networks."""
    tac = run.tac
    policy = _weights(observation, tac.hidden_sizes)
    critics = _weights(observation + 1, tac.hidden_sizes)
    if tac.policy == "stochastic":
        critics *= 2
    if tac.bootstrap == "value":
        value = target = _weights(observation, tac.hidden_sizes)
    else:
        value, target = 0, critics
    return 4 * (policy + critics + value) + target


def _weights(inputs: int, hidden_sizes: tuple[int, ...]) -> int:
    """Weights and biases of a multilayer perceptron with one output."""
    sizes = [inputs, *hidden_sizes, 1]
    return sum((fan_in + 1) * fan_out for fan_in, fan_out in pairwise(sizes))


def _observation(task: Task) -> int:
    """Numbers of an observation, as far as the task's indices tell."""
    return 1 + max((*task.agent_indices, *task.surrounding_indices), default=0)


def _gib(amount: int) -> str:
    return f"{_number(amount / 2**30 if amount < 10**30 else amount // 2**30)} GiB"


def _number(value: float) -> str:
    return f"{value:,.1f}" if value < 1e6 else f"{min(value, 10**300):.1e}"
