"""One training run: a `TAC` algorithm built from `RunSettings`, advanced report by report."""

from __future__ import annotations

import os
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, EPISODE_RETURN_MEAN, LEARNER_RESULTS

from music_rllib import names
from music_rllib.config.run_settings import RunSettings
from music_rllib.config.tac_settings import Range, have_diverged, reward_of_step
from music_rllib.experiment.plan import REPORT_INTERVAL
from music_rllib.intrinsic.music import HELD_OUT_STEPS
from music_rllib.kernels.compiling import is_kept
from music_rllib.kernels.update import learn
from music_rllib.replay.ring import Segment, new_segments
from music_rllib.schedules import extremes
from music_rllib.store.handoff import Spaces
from music_rllib.store.history import Report
from music_rllib.store.serialization import read_arrays, read_state, write_arrays, write_state
from music_rllib.store.work_folder import NewCheckpoint, SavedCheckpoint
from music_rllib.tac.algorithm import TAC, TACConfig
from music_rllib.tac.config import AlgorithmSettings, Split
from music_rllib.tac.env_runner import DISPLACEMENT, MOVED, SUCCESS_ANY, SUCCESS_LAST
from music_rllib.tac.networks import for_another_run

_NEVER = 10**9
_TRAJECTORIES = "trajectories.safetensors"

_TRAINING = {
    SUCCESS_LAST: names.TRAIN_SUCCESS,
    SUCCESS_ANY: names.TRAIN_SUCCESS_ANY,
    EPISODE_RETURN_MEAN: names.TRAIN_RETURN,
    DISPLACEMENT: names.TRAIN_DISPLACEMENT,
    MOVED: names.TRAIN_TOUCHED,
}
_EVALUATION = {
    SUCCESS_LAST: names.EVAL_SUCCESS,
    SUCCESS_ANY: names.EVAL_SUCCESS_ANY,
    EPISODE_RETURN_MEAN: names.EVAL_RETURN,
    DISPLACEMENT: names.EVAL_DISPLACEMENT,
    MOVED: names.EVAL_TOUCHED,
}


def algorithm_config(run: RunSettings) -> TACConfig:
    """The RLlib config of a run; all its settings come from `run`."""
    config = TACConfig()
    config.environment(run.task.env_id, env_config=dict(run.task.env_kwargs))
    config.env_runners(num_env_runners=0, num_envs_per_env_runner=run.num_envs)
    steps = min(run.tac.max_episode_steps or run.task.horizon, run.task.horizon)
    split = Split(
        agent_indices=run.task.agent_indices, surrounding_indices=run.task.surrounding_indices
    )
    tac = run.tac.model_copy(update={"max_episode_steps": steps})
    config.use(AlgorithmSettings(tac, run.music, run.replay, split, run.intrinsic))
    config.training(total_env_steps=run.env_steps)
    config.replay(moved_distance=run.task.moved_distance, task_symmetries=run.task.symmetries)
    config.success_key, config.success_if_missing = run.task.success_key, False
    config.seed_range = run.task.seed_range
    # `TrainingRun` evaluates at given environment steps.
    config.evaluation(
        evaluation_interval=_NEVER,
        evaluation_duration=run.evaluation.episodes,
        evaluation_duration_unit="episodes",
        evaluation_config=TACConfig.overrides(explore=False),
    )
    # An iteration is one episode in every sub-environment; a report covers several iterations.
    config.reporting(min_sample_timesteps_per_iteration=1)
    # Ending its thread would take up to 0.7 s.
    config.debugging(seed=run.seed, log_sys_usage=False)
    return config


class Paused(Exception):  # noqa: N818  not an error
    """Training stopped between two reports."""


class TrainingRun:
    """Train one run to its budget.

    Args:
        run: The settings.
        handoff: Network weights to start from (`TAC.set_network_weights`).
        gpus: If above 0, the networks train on a GPU.

    Raises:
        ValueError: Settings or weights do not fit the environment.
    """

    def __init__(
        self,
        run: RunSettings,
        handoff: Mapping[str, Mapping[str, NDArray[Any]]] | None = None,
        gpus: float = 0.0,
    ) -> None:
        self.run, self._gpus = run, gpus
        # Ray would copy an exception of the environment, which its constructor may not allow.
        os.environ.setdefault("RAY_AIR_FULL_TRACEBACKS", "1")
        config = algorithm_config(run)
        if gpus:
            config.learners(num_gpus_per_learner=gpus)
        with warnings.catch_warnings():  # the sweep has printed this warning already
            warnings.filterwarnings("ignore", "target_bounds ")
            self.algorithm: TAC = config.build_algo()
        if handoff:
            if "normaliser" in handoff:
                handoff = {**handoff, "normaliser": for_another_run(handoff["normaliser"])}
            self.algorithm.set_network_weights(handoff)
        self._begun = False
        """Whether the untrained policy has been evaluated."""
        self._rounds: defaultdict[str, list[float]] = defaultdict(list)
        """Metrics of the training iterations since the last report."""
        self._segments: list[Segment] = []
        """Files with trajectories in this run's checkpoints."""
        self._process = psutil.Process()
        self._process.cpu_percent()  # the first call starts the measurement

    @property
    def env_steps(self) -> int:
        return self.algorithm.env_steps

    @property
    def finished(self) -> bool:
        """Whether the budget is spent."""
        return self.env_steps >= self.run.env_steps

    @property
    def will_compile(self) -> bool:
        """Whether the first update compiles code, which happens once per machine."""
        return not self._gpus and not is_kept(learn)

    def advance(self, pause: Callable[[], bool] = lambda: False) -> dict[str, float]:
        """Train until the next report is due; the first report is an evaluation at step 0.

        Args:
            pause: Called before each iteration; training pauses if it returns True.

        Returns:
            Means since the last report, by the names of `music_rllib.names`, and evaluation metrics
            if an evaluation is due. Metrics that do not exist yet are left out.

        Raises:
            Paused: `pause` returned True. `save` keeps the metrics measured so far, so the pause
                does not change the next report.
        """
        if not self._begun:
            self._begun = True
            return self.evaluate() | self._status()
        interval = self.run.evaluation.interval
        evaluation_at = _next_multiple(self.env_steps, interval)
        report_at = _next_multiple(self.env_steps, min(interval, REPORT_INTERVAL))
        goal = min(report_at, evaluation_at, self.run.env_steps)
        while self.env_steps < goal:
            if pause():
                raise Paused
            for name, value in _training_metrics(self.algorithm.train()):
                self._rounds[name].append(value)
        metrics = _means(self._rounds)
        self._rounds.clear()
        if self.env_steps >= evaluation_at or self.finished:
            metrics |= self.evaluate()
        return metrics | self._status()

    def evaluate(self) -> dict[str, float]:
        """Metrics of deterministic episodes, whose goals depend on the seed only."""
        results = self.algorithm.evaluate()[ENV_RUNNER_RESULTS]
        metrics = {name: float(results[key]) for key, name in _EVALUATION.items() if key in results}
        return metrics | {names.EVAL_EPISODES: float(self.run.evaluation.episodes)}

    def _status(self) -> dict[str, float]:
        return {
            names.ENV_STEPS: float(self.env_steps),
            names.GRAD_UPDATES: float(self.algorithm.grad_updates),
            names.SYSTEM_CPU: self._process.cpu_percent(),
            names.SYSTEM_MEMORY: self._process.memory_info().rss / 2**20,
        }

    def network_weights(self) -> dict[str, dict[str, NDArray[Any]]]:
        return self.algorithm.get_network_weights()

    @property
    def spaces(self) -> Spaces:
        """The environment's observation and action spaces."""
        return Spaces.of(*self.algorithm.env_runner.get_spaces()[DEFAULT_MODULE_ID])

    def save(self, draft: NewCheckpoint, *, alone: bool = False) -> None:
        """Write everything that `restore` needs to resume bit-identically.

        Only trajectories that no earlier checkpoint of this run has are written, or all of them if
        the checkpoint must be complete `alone`.

        Raises:
            StorageError: The storage cannot be written.
        """

        def write(label: str, arrays: Mapping[str, NDArray[Any]]) -> str:
            with draft.new_part(label) as (name, folder):
                write_arrays(folder / _TRAJECTORIES, arrays)
            return name

        replay = self.algorithm.replay
        self._segments = new_segments(replay, [] if alone else self._segments, write)
        draft.needs = [segment.name for segment in self._segments]
        state = {
            "algorithm": self.algorithm.get_state(not_components=TAC.REPLAY),
            "replay": replay.index(),
            "segments": [(segment.name, segment.first, segment.end) for segment in self._segments],
            "rounds": dict(self._rounds),
            "begun": self._begun,
        }
        write_state(draft.folder, state)

    def restore(self, saved: SavedCheckpoint, *, other_run: bool = False) -> None:
        """Resume from a checkpoint that `save` wrote; only before the first `advance`.

        After a checkpoint of another run, the next `save` writes all trajectories.

        Raises:
            StateError: It is not a checkpoint.
            ValueError: It has other settings.
        """
        state = read_state(saved.folder)
        self.algorithm.set_state(state["algorithm"])
        segments = [Segment(*segment) for segment in state["segments"]]
        files = ((segment.first, saved.parts[segment.name] / _TRAJECTORIES) for segment in segments)
        parts = ((first, read_arrays(path)) for first, path in files)  # one in memory at a time
        self.algorithm.replay.load_packed(state["replay"], parts)
        self._segments = [] if other_run else segments
        self._rounds = defaultdict(list, state["rounds"])
        self._begun = state["begun"]

    @property
    def replay_mb(self) -> float:
        """Size of the trajectories in the replay, in megabytes."""
        return self.algorithm.replay.used_nbytes / 2**20

    def divergence(self, reports: Sequence[Report]) -> str | None:
        """A message if the last of the run's reports is the first with diverged critics."""
        run = self.run
        task_reward = run.task.reward_range
        if task_reward is None and run.music.task_reward:
            return None  # the reachable returns are not known
        reward = reward_of_step(Range(*(task_reward or (0.0, 0.0))), run.music)
        if run.intrinsic.reward is not None:
            reward = Range(reward.low - extremes(run.intrinsic.weight)[1], reward.high)
        metrics = [report.metrics for report in reports]
        means = np.array([one.get(names.Q_MEAN, 0.0) for one in metrics])
        bonuses = np.array(
            [one.get(names.ALPHA, 0.0) * one.get(names.ENTROPY, 0.0) for one in metrics]
        )
        diverged = have_diverged(means, bonuses, reward, run.tac.gamma)
        if not diverged[-1] or diverged[:-1].any():
            return None
        remedy = "" if run.tac.target_bounds else "; tac.target_bounds limits their targets"
        return (
            f"its critics diverge: {means[-1]:.3g} on average, with rewards of {reward} a step "
            f"at gamma {run.tac.gamma:g}{remedy}"
        )

    def close(self) -> None:
        """Release environments and networks."""
        self.algorithm.stop()


def _means(rounds: Mapping[str, list[float]]) -> dict[str, float]:
    """Means over training iterations; the bound on new trajectories is weighted by steps."""
    metrics = {name: float(np.mean(values)) for name, values in rounds.items()}
    if (steps := metrics.pop(HELD_OUT_STEPS, None)) is not None:
        weights = np.array(rounds[HELD_OUT_STEPS]) / steps
        metrics[names.HELD_OUT_BOUND] = float(np.mean(weights * rounds[names.HELD_OUT_BOUND]))
    return metrics


def _next_multiple(steps: int, interval: int) -> int:
    return (steps // interval + 1) * interval


def _training_metrics(result: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """Public names and values of the metrics of an RLlib result.

    RLlib's mean of no values is NaN; such metrics of iterations without an update are left out.
    """
    episodes = result.get(ENV_RUNNER_RESULTS, {})
    for key, name in _TRAINING.items():
        if key in episodes:
            yield name, float(episodes[key])
    learner = result.get(LEARNER_RESULTS, {}).get(DEFAULT_MODULE_ID, {})
    for key, value in learner.items():
        wanted = key == HELD_OUT_STEPS or key.startswith(names.LEARNER_GROUPS)
        if wanted and not np.isnan(value):
            yield key, float(value)
