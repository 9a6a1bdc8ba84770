"""The algorithm `TAC`: collects episodes, stores them, learns from the replay, syncs weights."""

from __future__ import annotations

import contextlib
import shutil
import sys
import tempfile
import time
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.core import (
    COMPONENT_EVAL_ENV_RUNNER,
    COMPONENT_RL_MODULE,
    DEFAULT_MODULE_ID,
)
from ray.rllib.core.columns import Columns
from ray.rllib.env.env_runner_group import EnvRunnerGroup
from ray.rllib.policy.sample_batch import MultiAgentBatch, SampleBatch
from ray.rllib.utils.metrics import (
    ENV_RUNNER_RESULTS,
    ENV_RUNNER_SAMPLING_TIMER,
    LEARNER_RESULTS,
    LEARNER_UPDATE_TIMER,
    NUM_ENV_STEPS_SAMPLED_LIFETIME,
    REPLAY_BUFFER_SAMPLE_TIMER,
    SYNCH_WORKER_WEIGHTS_TIMER,
    TIMERS,
)
from ray.rllib.utils.typing import StateDict

from music_rllib.envs.episodes import Episode
from music_rllib.envs.make import goal_reward_of, moved_distance_of
from music_rllib.envs.values import BadNumberError
from music_rllib.replay.buffer import TrajectoryReplay
from music_rllib.replay.trajectories import Transitions
from music_rllib.schedules import value_at
from music_rllib.tac.config import TACConfig
from music_rllib.tac.env_runner import SUCCESS_LAST, TrajectoryEnvRunner, seed_or_entropy
from music_rllib.tac.rl_module import ESTIMATOR_MODULE
from music_rllib.tac.weights import NetworkWeights, by_module, by_network

REVIVE_SECONDS = 300.0
"""How long a remote environment runner that died may take to be restarted."""
UPDATES_PER_CALL = 100
"""Updates whose minibatches are sampled and sent together: few enough for the CPU's cache."""


class TAC(Algorithm):
    """Tsallis Actor-Critic (paper Fig. 3), with MUSIC's intrinsic reward where configured."""

    REPLAY = "replay"
    """Name of the trajectories' part of the state."""

    @classmethod
    def get_default_config(cls) -> TACConfig:
        return TACConfig()

    def setup(self, config: TACConfig) -> None:
        with _determinism_without_compiler():
            super().setup(config)
        self._settings = self.config.tac_settings()
        self._music = self.config.music_settings()
        self._replay_settings = self.config.replay_settings()
        self.env_steps = 0
        """Environment steps collected so far, by all runners."""
        self.grad_updates = 0
        """Gradient updates done so far."""
        self.replay = self._make_replay()
        self._runner_states: dict[int, StateDict] = dict(self._call_runners(_random_state))
        """Random states of the remote runners after their last episodes, by worker index."""

    def _make_replay(self) -> TrajectoryReplay:
        settings = self._replay_settings
        runner = self._runner_with_environment()
        seed = self.config.seed_range[0]
        goal_reward = goal_reward_of(runner.env, seed) if settings.hindsight_k > 0 else None
        moved_distance = self.config.moved_distance
        if goal_reward and settings.hindsight_episodes == "moved" and moved_distance is None:
            moved_distance = moved_distance_of(runner.env, goal_reward, seed)
        return TrajectoryReplay(
            runner.layout,
            settings.capacity,
            np.random.default_rng((seed_or_entropy(self.config.seed), _REPLAY_STREAM)),
            goal_reward=goal_reward,
            hindsight_k=settings.hindsight_k,
            hindsight_episodes=settings.hindsight_episodes,
            moved_distance=moved_distance,
            td_exponent=settings.priority_exponent if settings.priority == "td_error" else None,
        )

    def _runner_with_environment(self) -> TrajectoryEnvRunner:
        """The local runner; one without environments, as beside remote runners, gets one."""
        runner: TrajectoryEnvRunner = self.env_runner
        if not runner.envs:
            runner.config = runner.config.copy(copy_frozen=False).env_runners(
                num_envs_per_env_runner=1
            )
            runner.make_env()
        return runner

    def _setup_logdir(self) -> None:
        """Outside Tune, logs to a temporary folder instead of a new one in the user's home."""
        if self._storage is not None:
            super()._setup_logdir()
        else:
            self._logdir = tempfile.mkdtemp(prefix="tac-")
            self._remove_logdir = weakref.finalize(
                self, shutil.rmtree, self._logdir, ignore_errors=True
            )

    def cleanup(self) -> None:
        super().cleanup()
        if self._storage is None:  # not left to the interpreter's end, which workers of Ray skip
            self._remove_logdir()

    # -- one step of the algorithm --------------------------------------------------------

    def training_step(self) -> None:
        explored = self.env_steps >= self._settings.random_steps
        with self.metrics.log_time((TIMERS, ENV_RUNNER_SAMPLING_TIMER)):
            episodes = self._collect(random_actions=not explored)
        self._observe_inputs(episodes)
        if explored:
            self.learner_group.foreach_learner(lambda learner: learner.diagnose(episodes))
        self.replay.extend(episodes, self._trajectory_priorities(episodes))
        for updates in self._updates_due():
            with self.metrics.log_time((TIMERS, REPLAY_BUFFER_SAMPLE_TIMER)):
                drawn = self._draw(updates)
                batch = self._batch_of(drawn, updates)
            with self.metrics.log_time((TIMERS, LEARNER_UPDATE_TIMER)):
                results = self.learner_group.update(
                    batch=batch, timesteps={NUM_ENV_STEPS_SAMPLED_LIFETIME: self.env_steps}
                )
            self.grad_updates += updates
            self.metrics.aggregate(results, key=LEARNER_RESULTS)
            if drawn.weights is not None:
                errors = self._call_learner(lambda learner: learner.take_td_errors())
                self.replay.update_priorities(drawn.rows, errors)
        with self.metrics.log_time((TIMERS, SYNCH_WORKER_WEIGHTS_TIMER)):
            self._sync_weights(self.env_runner_group)

    def _sync_weights(self, group: EnvRunnerGroup) -> None:
        group.sync_weights(from_worker_or_learner_group=self.learner_group, inference_only=True)

    def evaluate(self, *args: Any, **kwargs: Any) -> Any:
        """Evaluates as RLlib does, and gives the success rate to settings that follow it."""
        results = super().evaluate(*args, **kwargs)
        success = results.get(ENV_RUNNER_RESULTS, {}).get(SUCCESS_LAST)
        if success is not None:
            rate, env_steps = float(success), self.env_steps
            self.learner_group.foreach_learner(
                lambda learner: learner.observe_measured("success_rate", rate, env_steps)
            )
        return results

    def _collect(self, *, random_actions: bool) -> list[Episode]:
        """Plays one episode in every sub-environment."""

        def play(runner: TrajectoryEnvRunner) -> tuple[list[Episode], Any]:
            return runner.sample(random_actions=random_actions), runner.get_metrics()

        remote = bool(self._runner_states)
        samples = self._collect_remotely(play) if remote else [play(self.env_runner)]
        self.metrics.aggregate([metrics for _, metrics in samples], key=ENV_RUNNER_RESULTS)
        episodes = [episode for sampled, _ in samples for episode in sampled]
        self.env_steps += sum(len(episode) for episode in episodes)
        return episodes

    # -- remote environment runners, which may die ----------------------------------------

    def _call_runners(self, function: Callable[[Any], Any], ids: Iterable[int] = ()) -> list[Any]:
        """Results of the living remote runners among `ids`, or of all where none are given."""
        results: list[Any] = self.env_runner_group.foreach_env_runner(
            function, local_env_runner=False, remote_worker_ids=sorted(ids) or None
        )
        return results

    def _collect_remotely(self, play: Callable[[Any], Any]) -> list[tuple[list[Episode], Any]]:
        """Plays one round on every remote runner, again where a runner died; in runners' order.

        Raises:
            RuntimeError: a runner could not be restarted.
            BadNumberError: an environment returned a number that cannot be learned from.
        """

        def play_with_state(runner: TrajectoryEnvRunner) -> tuple[Any, tuple[int, StateDict]]:
            try:
                return play(runner), _random_state(runner)
            except BadNumberError as error:  # raised, it would count as the runner's death
                return error, _random_state(runner)

        samples: dict[int, tuple[list[Episode], Any]] = {}
        give_up = time.monotonic() + REVIVE_SECONDS
        while missing := self._runner_states.keys() - samples.keys():
            for sample, (index, state) in self._call_runners(play_with_state, missing):
                if isinstance(sample, BadNumberError):
                    raise sample
                samples[index], self._runner_states[index] = sample, state
            if self._runner_states.keys() - samples.keys():
                if time.monotonic() > give_up:
                    raise RuntimeError(
                        f"environment runners {sorted(missing)} died and did not come back within "
                        f"{REVIVE_SECONDS:.0f} s"
                    )
                if not self.restore_env_runners(self.env_runner_group):
                    time.sleep(0.5)
        return [samples[index] for index in sorted(samples)]

    def restore_env_runners(self, env_runner_group: EnvRunnerGroup) -> list[int]:
        """Restarts dead runners in the random states from which they would have continued."""
        restored: list[int] = super().restore_env_runners(env_runner_group)
        if restored and env_runner_group is self.env_runner_group:
            self._restore_random_states(restored)
            self._sync_weights(env_runner_group)
        return restored

    def _restore_random_states(self, indices: Iterable[int]) -> None:
        states = {index: self._runner_states[index] for index in indices}
        self._call_runners(lambda runner: runner.set_state(states[runner.worker_index]), states)

    # -- learning -------------------------------------------------------------------------

    def _observe_inputs(self, episodes: list[Episode]) -> None:
        """Adds the new states to the normaliser, also with the goals that hindsight will use."""
        width, layout = self.replay.layout.network_input, self.replay.layout
        frames = np.concatenate([episode.frames for episode in episodes])
        inputs = frames[:, :width]
        if self._replay_settings.hindsight_k > 0:
            achieved = np.concatenate([frames[:, : layout.observation], frames[:, width:]], axis=1)
            inputs = np.concatenate([inputs, achieved])
        self.learner_group.foreach_learner(lambda learner: learner.observe_inputs(inputs))

    def _trajectory_priorities(self, episodes: list[Episode]) -> NDArray[np.float64] | None:
        """MUSIC-p: a priority for each episode by the frozen estimator."""
        if not self._music.prioritise_replay:
            return None
        priorities: NDArray[np.float64] = self._call_learner(
            lambda learner: learner.trajectory_priorities(episodes)
        )
        return priorities

    def _call_learner(self, function: Callable[[Any], Any]) -> Any:
        return next(iter(self.learner_group.foreach_learner(function))).get()

    def _updates_due(self) -> list[int]:
        """The updates that the replay ratio asks for, in calls of at most `UPDATES_PER_CALL`."""
        counted_steps = self.env_steps - self._settings.steps_before_updates
        due = int(counted_steps * self._settings.replay_ratio) - self.grad_updates
        full, rest = divmod(max(due, 0), UPDATES_PER_CALL)
        return [UPDATES_PER_CALL] * full + ([rest] if rest else [])

    def sample_batch(self, updates: int) -> MultiAgentBatch:
        """The minibatches of `updates` updates, concatenated as `TACLearner` takes them."""
        return self._batch_of(self._draw(updates), updates)

    def _draw(self, updates: int) -> Transitions:
        beta = value_at(
            self._replay_settings.importance_exponent,
            self.env_steps,
            self.config.total_env_steps or 0,
        )
        rows = updates * self._settings.batch_size
        return self.replay.sample_transitions(rows, importance_exponent=beta)

    def _batch_of(self, drawn: Transitions, updates: int) -> MultiAgentBatch:
        columns = {
            Columns.OBS: drawn.inputs,
            Columns.ACTIONS: drawn.actions,
            Columns.REWARDS: drawn.rewards,
            "discounts": drawn.discounts,
            Columns.NEXT_OBS: drawn.next_inputs,
        }
        if drawn.weights is not None:
            columns["weights"] = drawn.weights
        batches = {DEFAULT_MODULE_ID: SampleBatch(columns)}
        if self._music.estimator == "trained":
            last = max(*self.config.agent_indices, *self.config.surrounding_indices)
            count = updates * self._music.batch_trajectories
            whole = self.replay.sample_trajectories(count, width=last + 1)
            trajectories: dict[str, NDArray[Any]] = {Columns.OBS: whole.observations}
            if whole.inside is not None:
                trajectories["inside"] = whole.inside
            batches[ESTIMATOR_MODULE] = SampleBatch(trajectories)
        return MultiAgentBatch(batches, env_steps=len(drawn.rewards))

    # -- plain weights --------------------------------------------------------------------

    def get_network_weights(self) -> NetworkWeights:
        """The arrays of each network: policy, critics, value, value_target, normaliser, ..."""
        state = self.learner_group.get_state(components="learner/rl_module")["learner"]["rl_module"]
        return by_network(state)

    def set_network_weights(self, weights: Mapping[str, Mapping[str, NDArray[Any]]]) -> None:
        """Loads the given networks, as `get_network_weights` returns them; keeps the others.

        Raises ValueError for an unknown network, and for missing, unknown or misshapen tensors.
        """
        modules = by_module(weights, self.get_network_weights())
        self.learner_group.foreach_learner(
            lambda learner: [learner.module[mid].set_state(state) for mid, state in modules.items()]
        )
        for group in (self.env_runner_group, self.eval_env_runner_group):
            if group is not None:
                self._sync_weights(group)

    # -- checkpoints ----------------------------------------------------------------------

    def get_state(
        self, components: Any = None, *, not_components: Any = None, **kw: Any
    ) -> StateDict:
        state = super().get_state(components, not_components=not_components, **kw)
        if self._check_component(self.REPLAY, components, not_components):
            state[self.REPLAY] = self.replay.state()
        state[_COUNTERS] = {"env_steps": self.env_steps, "grad_updates": self.grad_updates}
        state[_RUNNERS] = dict(self._runner_states)
        return state

    def set_state(self, state: StateDict) -> None:
        super().set_state(state)
        if COMPONENT_EVAL_ENV_RUNNER in state and self.eval_env_runner is not None:
            # RLlib gives it the training runner's state.
            self.eval_env_runner.set_state(state[COMPONENT_EVAL_ENV_RUNNER])
        if self.REPLAY in state:
            self.replay.load_state(state[self.REPLAY])
        if _COUNTERS in state:
            self.env_steps = state[_COUNTERS]["env_steps"]
            self.grad_updates = state[_COUNTERS]["grad_updates"]
        runner_states = state.get(_RUNNERS, {})
        if runner_states and runner_states.keys() == self._runner_states.keys():
            self._runner_states = dict(runner_states)
            self._restore_random_states(runner_states)


_COUNTERS, _RUNNERS = "tac_counters", "tac_runners"
_REPLAY_STREAM = 101
"""Separates the replay's random stream from those of the environment runners."""


def _random_state(runner: TrajectoryEnvRunner) -> tuple[int, StateDict]:
    """The worker index, and the state of the runner without its weights."""
    return runner.worker_index, runner.get_state(not_components=COMPONENT_RL_MODULE)


@contextlib.contextmanager
def _determinism_without_compiler() -> Iterator[None]:
    """Spare each run's process a second: RLlib seeds torch by a call that loads its compiler.

    That sets the compiler's own flag too, which matters only where it is loaded.
    """
    if "torch._inductor" in sys.modules:
        yield
        return

    def use(mode: bool, *, warn_only: bool = False) -> None:
        torch.set_deterministic_debug_mode(
            ("warn" if warn_only else "error") if mode else "default"
        )

    original = torch.use_deterministic_algorithms
    torch.use_deterministic_algorithms = use
    try:
        yield
    finally:
        torch.use_deterministic_algorithms = original
