"""Lower bounds of the memory and time that runs need, computed from their settings.

The bound of memory omits everything that does not depend on the settings: the interpreter, its
libraries, an environment's own data. The size of an observation is taken from the largest index of
the task's agent and surroundings.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from operator import attrgetter
from typing import TYPE_CHECKING

from music_rllib.config.problems import shown
from music_rllib.config.run_settings import RunSettings
from music_rllib.envs.tasks import Task
from music_rllib.errors import BadInputError
from music_rllib.runtime import machine

if TYPE_CHECKING:
    from music_rllib.experiment.open_sweep import OpenSweep

FLOAT = 4
"""Bytes of a number."""
STEPS_PER_SECOND = 50_000
"""Environment steps per second of the fastest simulations."""
UPDATES_PER_SECOND = 10_000
"""Gradient updates per second of small networks on the fastest hardware."""
LONG_DAYS = 60
"""A run that takes longer at these rates is probably a mistake."""
ENVIRONMENT_BYTES = 10_000
"""Memory of one sub-environment; MuJoCo's take a hundred times as much."""
CERTAIN_BYTES = 2 * 2**30
"""Memory that every node of a cluster is assumed to have."""


class DemandError(BadInputError, ValueError):
    """A run does not fit on any available machine."""


def check_demand(sweep: OpenSweep) -> list[str]:
    """Check that the unfinished runs fit into memory.

    Returns:
        Warnings about runs that would take months or years.

    Raises:
        DemandError: A run does not fit.
        ClusterError: The cluster can't be reached.
    """
    runs = [(node.stage, node.run) for node in sweep.plan.nodes if node.key not in sweep.finished]
    for stage in sweep.config.stages:
        if stage.search is not None:
            runs += [(stage.name, run) for run in stage.points[0].runs.values()]
    place, memory = "this machine", float(machine.memory())
    if (address := machine.cluster_address()) is not None:
        place, memory = "the cluster's largest node", _cluster_memory(address, sweep, runs)
    check_memory(runs, place, memory)
    return list(long_runs(runs))


def _cluster_memory(
    address: str, sweep: OpenSweep, runs: Iterable[tuple[str, RunSettings]]
) -> float:
    """Memory of the cluster's largest node, which is only looked up if the runs need much."""
    if max((least_memory(run) for _, run in runs), default=0) <= CERTAIN_BYTES:
        return CERTAIN_BYTES
    from music_rllib.runtime.ray_cluster import cluster

    machine.check_reachable(address)
    with cluster(sweep.config.resources) as capacity:
        return float("inf") if capacity.grows else capacity.memory


def check_memory(runs: Iterable[tuple[str, RunSettings]], place: str, memory: float) -> None:
    """Check that each of `runs`, given with the names of their stages, fits into `memory` bytes.

    Raises:
        DemandError: A run does not fit; the message names the settings that need most.
    """
    for stage, run in runs:
        if least_memory(run) > memory:
            settings, amount = max(_memory(run).items(), key=lambda item: item[1])
            values = " and ".join(shown(attrgetter(setting)(run)) for setting in settings)
            raise DemandError(
                f"stage {stage}: {' and '.join(settings)} must fit into the memory of {place}, "
                f"{_gib(memory)}, got {values}, for which a run on {run.task.name} needs at least "
                f"{_gib(amount)}"
            )


def least_memory(run: RunSettings) -> int:
    """Bytes that a run needs at least."""
    return sum(_memory(run).values())


def _memory(run: RunSettings) -> dict[tuple[str, ...], int]:
    """Bytes that a run needs at least, by the settings that cause them."""
    tac, replay, music, horizon = run.tac, run.replay, run.music, run.task.horizon
    observation, units = _observation(run.task), music.hidden_size
    row = FLOAT * (observation + 3)  # with action, reward, and whether the episode ended
    has_estimator = music.estimator != "none"
    return {
        ("tac.hidden_sizes",): FLOAT * _network_numbers(run, observation),
        ("tac.batch_size", "tac.hidden_sizes"): tac.batch_size
        * (row + FLOAT * sum(tac.hidden_sizes)),
        ("replay.capacity",): replay.capacity * row,
        # An evaluation keeps all of its trajectories until it ends.
        ("evaluation.episodes",): run.evaluation.episodes * horizon * row,
        ("num_envs",): run.num_envs * (ENVIRONMENT_BYTES + horizon * row),
        ("music.hidden_size",): has_estimator * 4 * FLOAT * units * (observation + 2),
        ("music.batch_trajectories", "music.hidden_size"): has_estimator
        * (FLOAT * music.batch_trajectories * horizon * (observation + units)),
    }


def _network_numbers(run: RunSettings, observation: int) -> int:
    """Numbers of all networks: weights, gradients, Adam's two moments, and target networks."""
    tac = run.tac
    policy = _weights(observation, tac.hidden_sizes)
    critics = _weights(observation + 1, tac.hidden_sizes)
    if tac.policy == "stochastic":
        critics *= 2
    value = policy if tac.bootstrap == "value" else 0
    return 4 * (policy + critics + value) + (value or critics)


def _weights(inputs: int, hidden_sizes: tuple[int, ...]) -> int:
    """Weights and biases of a multilayer perceptron with one output."""
    sizes = [inputs, *hidden_sizes, 1]
    return sum((fan_in + 1) * fan_out for fan_in, fan_out in pairwise(sizes))


def _observation(task: Task) -> int:
    """Size of an observation, up to the largest index of the task."""
    return 1 + max((*task.agent_indices, *task.surrounding_indices), default=0)


def long_runs(runs: Iterable[tuple[str, RunSettings]]) -> Iterator[str]:
    """One line per stage and task whose runs would take months or years on any hardware."""
    seen = set()
    for stage, run in runs:
        days = _least_seconds(run) // 86_400
        if days >= LONG_DAYS and (stage, run.task.name) not in seen:
            seen.add((stage, run.task.name))
            yield (
                f"stage {stage}: a run on {run.task.name} takes at least {_number(days)} days on "
                "the fastest hardware; see env_steps, tac.replay_ratio and evaluation"
            )


def _least_seconds(run: RunSettings) -> int:
    """Seconds that a run takes at least."""
    evaluations = 1 - (-run.env_steps // run.evaluation.interval)
    played = evaluations * run.evaluation.episodes * run.task.horizon
    updates = (run.env_steps - run.tac.steps_before_updates) * int(run.tac.replay_ratio)
    return (run.env_steps + played) // STEPS_PER_SECOND + max(updates, 0) // UPDATES_PER_SECOND


def _gib(amount: float) -> str:
    return f"{_number(amount / 2**30 if amount < 10**30 else int(amount) // 2**30)} GiB"


def _number(value: float) -> str:
    return f"{value:,.1f}" if value < 1e6 else f"{min(value, 10**300):.1e}"
