"""The algorithm `TAC` and its config: collect episodes, store them, learn from the replay."""

from __future__ import annotations

import contextlib
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from traceback import format_exc
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.core import ALL_MODULES, COMPONENT_EVAL_ENV_RUNNER, COMPONENT_RL_MODULE
from ray.rllib.env.env_runner_group import EnvRunnerGroup
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
from music_rllib.envs.features import Symmetries
from music_rllib.envs.goal_functions import (
    augmentation_of,
    goal_end_of,
    goal_reward_of,
    moved_distance_of,
)
from music_rllib.envs.values import BadNumberError
from music_rllib.intrinsic.make import reward_class
from music_rllib.replay.buffer import TrajectoryReplay
from music_rllib.replay.trajectories import Floats, WholeTrajectories
from music_rllib.runtime.machine import own_folder
from music_rllib.schedules import value_at
from music_rllib.tac.config import AlgorithmSettings, TACConfigBase
from music_rllib.tac.env_runner import SUCCESS_LAST, TrajectoryEnvRunner, seed_or_entropy
from music_rllib.tac.learner import GRAD_UPDATES
from music_rllib.tac.minibatches import INTRINSIC, batch_of
from music_rllib.tac.random_state import determinism_without_compiler
from music_rllib.tac.rl_module import (
    ESTIMATOR_MODULE,
    NetworkWeights,
    states_by_module,
    weights_by_network,
)

REVIVE_SECONDS = 300.0
"""Longest wait for the restart of a remote environment runner that died."""
UPDATES_PER_CALL = 100
"""Updates whose minibatches are sampled and sent together; they fit into the CPU's cache."""


class TAC(Algorithm):
    """Tsallis Actor-Critic (paper Fig. 3), with MUSIC's intrinsic reward if configured."""

    REPLAY = "replay"
    """Key of the trajectories in the state."""

    @classmethod
    def get_default_config(cls) -> TACConfig:
        return TACConfig()

    def setup(self, config: TACConfig) -> None:
        if self.config.env is None:
            raise ValueError("an environment must be set: TACConfig().environment(...)")
        with determinism_without_compiler():
            super().setup(config)
        self._settings: AlgorithmSettings = self.config.settings
        name = self._settings.intrinsic.reward
        self._reward = None if name is None else reward_class(name)
        self.env_steps = 0
        """Environment steps of all runners."""
        self.grad_updates = 0
        self.replay = self._make_replay()
        self._runner_states: dict[int, StateDict] = dict(self._call_runners(_random_state))
        """Random states of the remote runners after their last episodes, by worker index."""

    def _make_replay(self) -> TrajectoryReplay:
        settings = self._settings.replay
        runner = self._runner_with_environment()
        seeds, hindsight = self.config.seed_range, settings.hindsight_k > 0
        goal_reward = goal_reward_of(runner.env, seeds) if hindsight else None
        moved_distance = self.config.moved_distance
        if goal_reward and settings.hindsight_episodes == "moved" and moved_distance is None:
            moved_distance = moved_distance_of(runner.env, goal_reward, seeds[0])
        augment = None
        if settings.symmetries:
            of_task = Symmetries.model_validate(self.config.task_symmetries)  # Tune gives a dict
            augment = augmentation_of(
                of_task, settings.symmetries, runner.layout, runner.env,
                reward=goal_reward, goals=self._settings.music.goals == "environment",
                seed=seeds[0],
            )  # fmt: skip
        return TrajectoryReplay(
            runner.layout,
            settings.capacity,
            np.random.default_rng((seed_or_entropy(self.config.seed), _REPLAY_STREAM)),
            goal_reward=goal_reward,
            goal_end=goal_end_of(runner.env, seeds[0]) if goal_reward else None,
            hindsight_k=settings.hindsight_k,
            hindsight_goals=settings.hindsight_goals,
            n_steps=settings.n_steps,
            gamma=self._settings.tac.gamma,
            hindsight_episodes=settings.hindsight_episodes,
            moved_distance=moved_distance,
            td_exponent=settings.priority_exponent if settings.priority == "td_error" else None,
            augment=augment,
        )

    def _runner_with_environment(self) -> TrajectoryEnvRunner:
        """The local runner; beside remote runners it has no environment, and gets one here."""
        runner: TrajectoryEnvRunner = self.env_runner
        if not runner.envs:
            runner.config = runner.config.copy(copy_frozen=False).env_runners(
                num_envs_per_env_runner=1
            )
            runner.make_env()
        return runner

    def _setup_logdir(self) -> None:
        """Outside Tune, log to a temporary folder instead of a new one in the user's home."""
        if self._storage is not None:
            super()._setup_logdir()
        else:
            self._files = contextlib.ExitStack()
            self._logdir = self._files.enter_context(own_folder("music-tac-"))

    def cleanup(self) -> None:
        super().cleanup()
        if self._storage is None:  # now, because workers of Ray skip the interpreter's finalizers
            self._files.close()

    # -- one step of the algorithm --------------------------------------------------------

    def training_step(self) -> None:
        explored = self.env_steps >= self._settings.tac.random_steps
        with self.metrics.log_time((TIMERS, ENV_RUNNER_SAMPLING_TIMER)):
            episodes = self._collect(random_actions=not explored)
        self._observe_inputs(episodes)
        values = self._values_to_store(episodes)
        if explored:
            self.learner_group.foreach_learner(lambda learner: learner.diagnose(episodes, values))
        self.replay.extend(episodes, self._trajectory_priorities(episodes), values)
        schedule, budget = self._settings.replay.importance_exponent, self.config.total_env_steps
        exponent = value_at(schedule, self.env_steps, budget or 0)
        for updates in self._updates_due():
            with self.metrics.log_time((TIMERS, REPLAY_BUFFER_SAMPLE_TIMER)):
                drawn = self.replay.sample_transitions(
                    updates * self._settings.tac.batch_size, importance_exponent=exponent
                )
                batch = batch_of(
                    drawn, self._sample_trajectories(updates), self.replay.values_of(drawn.rows)
                )
            with self.metrics.log_time((TIMERS, LEARNER_UPDATE_TIMER)):
                results = self.learner_group.update(
                    batch=batch, timesteps={NUM_ENV_STEPS_SAMPLED_LIFETIME: self.env_steps}
                )
            self.grad_updates += updates
            self.metrics.aggregate(results, key=LEARNER_RESULTS)
            if drawn.weights is not None:
                errors = self._call_learner(lambda learner: learner.take_td_errors())
                self.replay.update_priorities(drawn.rows, errors)
        key = (LEARNER_RESULTS, ALL_MODULES, GRAD_UPDATES)
        self.metrics.log_value(key, self.grad_updates, window=1)
        with self.metrics.log_time((TIMERS, SYNCH_WORKER_WEIGHTS_TIMER)):
            self._sync_weights(self.env_runner_group)

    def _sync_weights(self, group: EnvRunnerGroup) -> None:
        group.sync_weights(from_worker_or_learner_group=self.learner_group, inference_only=True)

    def evaluate(self, *args: Any, **kwargs: Any) -> Any:
        """Evaluate as RLlib does, and pass the success rate to settings that follow it.

        Raises:
            ValueError: There are no evaluation runners; those of training would sample actions, and
                play other episodes in training afterwards.
        """
        if self.eval_env_runner_group is None and not self.config.is_offline:
            raise ValueError(
                "evaluate() needs runners of its own: set evaluation(evaluation_interval=...) or "
                "evaluation(evaluation_num_env_runners=...)"
            )
        results = super().evaluate(*args, **kwargs)
        success = results.get(ENV_RUNNER_RESULTS, {}).get(SUCCESS_LAST)
        if success is None and self.config.follows_success and results.get(ENV_RUNNER_RESULTS):
            warnings.warn(
                "a setting follows the success rate, and no episode has reported "
                f"info[{self.config.success_key!r}]: is the config's success_key right?",
                stacklevel=2,
            )
        if success is not None:
            rate, env_steps = float(success), self.env_steps
            self.learner_group.foreach_learner(
                lambda learner: learner.observe_measured("success_rate", rate, env_steps)
            )
        return results

    def _collect(self, *, random_actions: bool) -> list[Episode]:
        """Play one episode in every sub-environment."""

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
        """Results of the healthy remote runners among `ids`; without `ids`, of all of them."""
        results: list[Any] = self.env_runner_group.foreach_env_runner(
            function, local_env_runner=False, remote_worker_ids=sorted(ids) or None
        )
        return results

    def _collect_remotely(self, play: Callable[[Any], Any]) -> list[tuple[list[Episode], Any]]:
        """Play one round on every remote runner, in their order; repeat it if a runner died.

        Raises:
            RuntimeError: a runner could not be restarted, or failed again after its restart.
            BadNumberError: an environment returned an unusable number.
        """
        restarted = False

        def play_with_state(runner: TrajectoryEnvRunner) -> tuple[Any, tuple[int, StateDict]]:
            try:
                return play(runner), _random_state(runner)
            except BadNumberError as error:  # raised, it would count as the runner's death
                return error, _random_state(runner)
            except Exception:
                if not restarted:
                    raise  # the episode is repeated in a new process
                text = f"an environment fails after a restart, too:\n{format_exc()}"
                return RuntimeError(text), _random_state(runner)

        samples: dict[int, tuple[list[Episode], Any]] = {}
        give_up = time.monotonic() + REVIVE_SECONDS
        while missing := self._runner_states.keys() - samples.keys():
            for sample, (index, state) in self._call_runners(play_with_state, missing):
                if isinstance(sample, RuntimeError):
                    raise sample
                samples[index], self._runner_states[index] = sample, state
            if self._runner_states.keys() - samples.keys():
                if time.monotonic() > give_up:
                    raise RuntimeError(
                        f"environment runners {sorted(missing)} died and finished no episode "
                        f"within {REVIVE_SECONDS:.0f} s: their logs say why"
                    )
                restored = self.restore_env_runners(self.env_runner_group)
                if not restored:
                    time.sleep(0.5)
                    continue
                restarted = True
                self._make_on_env_runners_recreated_callbacks(
                    config=self.config,
                    env_runner_group=self.env_runner_group,
                    restored_env_runner_indices=restored,
                )
        return [samples[index] for index in sorted(samples)]

    def restore_env_runners(self, env_runner_group: EnvRunnerGroup) -> list[int]:
        """Restart dead runners with the random states from which they would have continued."""
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
        """Add the new states to the normalizer, also with the goals that hindsight may use."""
        width, layout = self.replay.layout.network_input, self.replay.layout
        frames = np.concatenate([episode.frames for episode in episodes])
        inputs = frames[:, :width]
        if self._settings.replay.hindsight_k > 0:
            achieved = np.concatenate([frames[:, : layout.observation], frames[:, width:]], axis=1)
            inputs = np.concatenate([inputs, achieved])
        self.learner_group.foreach_learner(lambda learner: learner.observe_inputs(inputs))

    def _trajectory_priorities(self, episodes: list[Episode]) -> NDArray[np.float64] | None:
        """MUSIC-p: the frozen estimator's priority of each episode."""
        if not self._settings.music.prioritise_replay:
            return None
        priorities: NDArray[np.float64] = self._call_learner(
            lambda learner: learner.trajectory_priorities(episodes)
        )
        return priorities

    def _values_to_store(self, episodes: list[Episode]) -> list[Floats] | None:
        """Numbers of each step that the replay keeps for an intrinsic reward by episode."""
        if self._reward is None or not self._reward.by_episode:
            return None
        values: list[Floats] = self._call_learner(lambda learner: learner.bonus.values_of(episodes))
        return values

    def _call_learner(self, function: Callable[[Any], Any]) -> Any:
        return next(iter(self.learner_group.foreach_learner(function))).get()

    def _updates_due(self) -> list[int]:
        """Numbers of updates per call, at most `UPDATES_PER_CALL`, to reach the replay ratio."""
        counted_steps = self.env_steps - self._settings.tac.steps_before_updates
        due = int(counted_steps * self._settings.tac.replay_ratio) - self.grad_updates
        full, rest = divmod(max(due, 0), UPDATES_PER_CALL)
        return [UPDATES_PER_CALL] * full + ([rest] if rest else [])

    def _sample_trajectories(self, updates: int) -> dict[str, WholeTrajectories]:
        """The trajectories of the estimator and of another intrinsic reward, if they need some."""
        music, split, found = self._settings.music, self._settings.split, {}
        sample = self.replay.sample_trajectories
        if music.estimator == "trained":
            last = max(*split.agent_indices, *split.surrounding_indices)
            count = updates * music.batch_trajectories
            found[ESTIMATOR_MODULE] = sample(count, width=last + 1)
        if self._reward is not None and self._reward.trajectories:
            found[INTRINSIC] = sample(updates * self._reward.trajectories)
        return found

    # -- network weights ------------------------------------------------------------------

    def get_network_weights(self) -> NetworkWeights:
        """Weights by network (policy, critics, value, value_target, normaliser, ...) and array."""
        state = self.learner_group.get_state(components="learner/rl_module")["learner"]["rl_module"]
        weights = weights_by_network(state)
        if self._reward is not None:
            weights[INTRINSIC] = self._call_learner(lambda learner: learner.bonus.weights())
        return weights

    def set_network_weights(self, weights: Mapping[str, Mapping[str, NDArray[Any]]]) -> None:
        """Load the given networks, as `get_network_weights` returns them; keep the others.

        Raises ValueError for an unknown network, and for missing, unknown or misshapen tensors.
        """
        # This also checks the networks of an intrinsic reward, which no module holds.
        modules = states_by_module(weights, self.get_network_weights())
        if (of_reward := weights.get(INTRINSIC)) is not None:
            self.learner_group.foreach_learner(
                lambda learner: learner.bonus.load_weights(of_reward)
            )
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
            # RLlib sets the training runner's state.
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


class TACConfig(TACConfigBase):
    """Configures TAC, with or without MUSIC, on any continuous-action Gymnasium environment.

    Every field of `TACSettings` is an attribute and an argument of `training()`, every field of
    `MusicSettings` (prefixed `music_`) of `music()`, every field of `ReplaySettings` (prefixed
    `replay_`) of `replay()`. `validate()` checks all of them; RLlib calls it when it builds the
    algorithm.

        >>> config = (
        ...     TACConfig()
        ...     .environment("Pendulum-v1")
        ...     .training(entropic_index=1.5, alpha=0.2)
        ... )
        >>> algo = config.build_algo()
    """

    def __init__(self, algo_class: type | None = None) -> None:
        super().__init__(algo_class=algo_class or TAC)


_COUNTERS, _RUNNERS = "tac_counters", "tac_runners"
_REPLAY_STREAM = 101
"""Separates the replay's random stream from the environment runners' streams."""


def _random_state(runner: TrajectoryEnvRunner) -> tuple[int, StateDict]:
    """The worker index, and the state of the runner without its weights."""
    return runner.worker_index, runner.get_state(not_components=COMPONENT_RL_MODULE)
