"""The environment runner: plays whole episodes in a few sub-environments, stepped together.

RLlib's SingleAgentEnvRunner spends more than half of its time in connectors and episode objects,
resets to the same goal in every call with a seed, and never seeds random actions. This runner plays
one episode per sub-environment and call, seeds every reset by (seed, worker, episode), and keeps no
simulator state between calls: a checkpoint of a few integers resumes it exactly.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import ray
from numpy.typing import NDArray
from ray.rllib.core import COMPONENT_RL_MODULE, DEFAULT_AGENT_ID, DEFAULT_MODULE_ID
from ray.rllib.env import INPUT_ENV_SPACES
from ray.rllib.env.env_context import EnvContext
from ray.rllib.env.env_runner import EnvRunner
from ray.rllib.utils.checkpoints import Checkpointable
from ray.rllib.utils.metrics import (
    EPISODE_LEN_MEAN,
    EPISODE_RETURN_MEAN,
    NUM_AGENT_STEPS_SAMPLED,
    NUM_ENV_STEPS_SAMPLED,
    NUM_ENV_STEPS_SAMPLED_LIFETIME,
    NUM_EPISODES,
    NUM_EPISODES_LIFETIME,
    WEIGHTS_SEQ_NO,
)
from ray.rllib.utils.typing import StateDict
from ray.tune.registry import ENV_CREATOR, _global_registry

from music_rllib.config.tac_settings import ColoredNoise, TACSettings
from music_rllib.envs.episodes import Episode, Recording
from music_rllib.envs.features import beyond_observation
from music_rllib.envs.goal_functions import compute_reward_of, compute_terminated_of
from music_rllib.envs.make import (
    Env,
    episode_limit,
    in_environment,
    is_gymnasium_id,
    make_env,
    name_of,
    reset_seed,
)
from music_rllib.envs.values import BadNumberError, check_action_space, observation_sizes, to_bounds
from music_rllib.replay.trajectories import ReplayLayout
from music_rllib.runtime.quiet import quiet_third_parties
from music_rllib.tac.callbacks import EpisodeCallbacks
from music_rllib.tac.rl_module import Actor, TACModule

SUCCESS_LAST, SUCCESS_ANY = "success_last_step", "success_any_step"
DISPLACEMENT, MOVED = "object_displacement", "object_moved"
"""Metrics of an episode in addition to RLlib's own."""

MOVED_THRESHOLD = 0.01
"""Distance from its start (meters in the Fetch tasks) above which the object counts as moved."""

WIDTH = 3.0
"""Standard deviation, before tanh, of `random_actions: wide`."""

Floats = NDArray[np.float32]


class TrajectoryEnvRunner(EnvRunner, Checkpointable):
    """EnvRunner whose `sample()` returns finished `Episode`s.

    It runs no connectors. It calls RLlib's callbacks of environments and episodes
    (`EpisodeCallbacks`).
    """

    def __init__(self, *, config: Any, **kwargs: Any) -> None:
        quiet_third_parties()  # a remote runner is a process of its own
        super().__init__(config=config, **kwargs)
        self.worker_index: int = self.worker_index or 0
        self._env_creator = kwargs.get("env_creator")
        self._spaces = kwargs.get("spaces")
        tac, music, replay, self._split, _ = self.config.settings
        self._settings: TACSettings = tac
        training = not self.config.in_evaluation
        self._zero_goals = training and music.goals == "zero"
        self._hindsight = training and replay.hindsight_k > 0
        self._success = (self.config.success_key, self.config.success_if_missing)
        # Training and evaluation have independent random streams, and so do the workers.
        self._entropy = (
            seed_or_entropy(self.config.seed),
            int(self.config.in_evaluation),
            self.worker_index,
        )
        self._rng = np.random.default_rng(self._entropy)
        self._episodes_started = 0
        self._weights_seq_no = 0
        self.envs: list[Env] = []
        self._callbacks = EpisodeCallbacks(self)
        if self.worker_index > 0 or self.config.num_env_runners == 0 or self._spaces is None:
            self.make_env()
        self.make_module()

    # -- construction ---------------------------------------------------------------------

    def make_env(self) -> None:
        self.close_envs()
        self.envs = [self._make_sub_env(i) for i in range(self.config.num_envs_per_env_runner)]
        self.env = self.envs[0]
        self._action_space = check_action_space(self.env.action_space)
        observation, goal = observation_sizes(self.env.observation_space)
        self.layout = ReplayLayout(
            observation=observation,
            action=int(self._action_space.shape[0]),
            goal=goal,
            horizon=episode_limit(self.env, self._settings.max_episode_steps),
        )
        split = self._split.agent_indices, self._split.surrounding_indices
        if beyond := beyond_observation(*split, observation):
            raise ValueError("\n".join(beyond))

    def _make_sub_env(self, vector_index: int) -> Env:
        context = EnvContext(
            self.config.env_config,
            worker_index=self.worker_index,
            vector_index=vector_index,
            num_workers=self.num_workers,
        )
        name = self.config.env
        # A name that is registered with Ray is the user's own environment, as in RLlib.
        if is_gymnasium_id(name) and not _global_registry.contains(ENV_CREATOR, name):
            env = make_env(name, **context)
        else:
            assert self._env_creator is not None
            env = self._env_creator(context)
        self._callbacks.environment_created(env, context)
        return env

    def make_module(self) -> None:
        spec = self.config.get_rl_module_spec(spaces=self.get_spaces(), inference_only=True)
        self.module: TACModule = spec.build().eval()

    def get_spaces(self) -> dict[str, Any]:
        if not self.envs:
            assert self._spaces is not None
            return dict(self._spaces)
        pair = (self.env.observation_space, self.env.action_space)
        return {INPUT_ENV_SPACES: pair, DEFAULT_MODULE_ID: pair}

    # -- playing --------------------------------------------------------------------------

    def sample(
        self,
        *,
        num_timesteps: int | None = None,
        num_episodes: int | None = None,
        explore: bool | None = None,
        random_actions: bool = False,
        force_reset: bool = False,
        **kwargs: Any,
    ) -> list[Episode]:
        """Play whole episodes.

        Args:
            num_timesteps: play at least this many steps.
            num_episodes: play exactly this many episodes. Neither: one per sub-environment.
            explore: act by the training behavior; False: deterministically.
            random_actions: act at random.
            force_reset: ignored, because every call begins with new episodes.
        """
        if explore is None:
            explore = bool(self.config.explore)
        episodes: list[Episode] = []
        steps = 0
        while True:
            count = len(self.envs)
            if num_episodes is not None:
                count = min(count, num_episodes - len(episodes))
            episodes += self._play(count, explore=explore, random_actions=random_actions)
            steps = sum(len(episode) for episode in episodes)
            if len(episodes) >= (num_episodes or 0) and steps >= (num_timesteps or 0):
                break
        if any(episode.successes is not None for episode in episodes):
            # The environment reports success: steps and episodes without the key are none.
            self._success = (self._success[0], False)
            episodes = list(map(_with_success, episodes))
        self._log(episodes, steps)
        self._callbacks.sample_ended()
        return episodes

    def _play(self, count: int, *, explore: bool, random_actions: bool) -> list[Episode]:
        """Play one episode in each of the first `count` sub-environments."""
        recordings = [self._start_episode(i) for i in range(count)]
        finished: dict[int, Episode] = {}
        actor = self.module.actor()
        behaviour, colored = self._settings.behaviour, None
        if explore and not random_actions and isinstance(behaviour, ColoredNoise):
            shape = (self.layout.horizon, count, self.layout.action)
            colored = colored_noise(self._rng, behaviour.exponent, shape)
        while len(finished) < count:
            playing = [i for i in range(count) if i not in finished]
            inputs = np.stack([recordings[i].network_input for i in playing])
            noise = None if colored is None else colored[recordings[playing[0]].steps, playing]
            actions = self._act(
                actor, inputs, explore=explore, random_actions=random_actions, noise=noise
            )
            if not actions.ravel().dot(actions.ravel()) <= actions.size:
                raise _bad_action(actions, inputs, [recordings[i].place for i in playing])
            for i, action, scaled in zip(playing, actions, self._to_env(actions), strict=True):
                ended = self._step(self._callbacks.env(i), recordings[i], action, scaled)
                self._callbacks.episode_stepped(i, action, scaled, ended)
                if ended is not None:
                    finished[i] = recordings[i].finish(terminated=ended)
        return [finished[i] for i in range(count)]

    def _start_episode(self, index: int) -> Recording:
        """Reset sub-environment `index`."""
        entropy = np.random.SeedSequence((*self._entropy, self._episodes_started))
        self._episodes_started += 1
        seed = reset_seed(entropy, self.config.seed_range)
        self._callbacks.episode_created(index)
        with in_environment:
            observation, info = self.envs[index].reset(seed=seed)
        worker = f" of worker {self.worker_index}" if self.worker_index else ""
        name = (
            f"{name_of(self.envs[index])}, sub-environment {index}{worker}, "
            f"{'evaluation' if self.config.in_evaluation else 'training'} episode "
            f"{self._episodes_started} (reset with seed {seed})"
        )
        recording = Recording(
            self.layout,
            zero_goal=self._zero_goals,
            name=name,
            success=self._success,
            goal_reward=compute_reward_of(self.envs[index]) if self._hindsight else None,
            goal_end=compute_terminated_of(self.envs[index]) if self._hindsight else None,
        )
        recording.see(observation)
        self._callbacks.episode_started(index, observation, info)
        return recording

    def _step(self, env: Env, recording: Recording, action: Floats, scaled: Floats) -> bool | None:
        """Take one step; return whether the episode terminated, or None if it continues."""
        with in_environment:
            observation, reward, terminated, truncated, info = env.step(scaled)
        recording.step(action, reward, info, observation)
        terminated, truncated = recording.ends(terminated, truncated)
        if terminated or truncated or recording.steps == self.layout.horizon:
            return terminated
        return None

    def _to_env(self, actions: Floats) -> Floats:
        """Scale actions [B, A] from [-1, 1] to the environment's bounds."""
        return to_bounds(actions, self._action_space)

    def _act(
        self,
        actor: Actor,
        inputs: Floats,
        *,
        explore: bool,
        random_actions: bool,
        noise: Floats | None = None,
    ) -> Floats:
        """[B, I] -> [B, A] in [-1, 1]; `noise` [B, A] replaces independent normal noise."""
        shape = (len(inputs), self.layout.action)
        if random_actions:
            return self._random(shape)
        behaviour = self._settings.behaviour
        if not explore:
            return actor(inputs, None)
        if noise is None:
            noise = self._rng.standard_normal(shape, dtype=np.float32)
        if behaviour == "policy":
            return actor(inputs, noise)
        if isinstance(behaviour, ColoredNoise):
            actions = actor(inputs, noise)
        else:
            actions = np.clip(actor(inputs, None) + behaviour.std * noise, -1.0, 1.0)
        random = self._random(shape)
        is_random = self._rng.random((len(inputs), 1)) < behaviour.random_share
        return np.where(is_random, random, actions)

    def _random(self, shape: tuple[int, int]) -> Floats:
        """Random actions [B, A]."""
        if self._settings.random_actions == "uniform":
            return self._rng.uniform(-1.0, 1.0, shape).astype(np.float32)
        wide: Floats = np.tanh(WIDTH * self._rng.standard_normal(shape, dtype=np.float32))
        return wide

    # -- metrics and state ----------------------------------------------------------------

    def _log(self, episodes: list[Episode], steps: int) -> None:
        log = self.metrics.log_value
        log(NUM_ENV_STEPS_SAMPLED, steps, reduce="sum")
        log((NUM_AGENT_STEPS_SAMPLED, DEFAULT_AGENT_ID), steps, reduce="sum")
        log(NUM_EPISODES, len(episodes), reduce="sum")
        log(NUM_ENV_STEPS_SAMPLED_LIFETIME, steps, reduce="lifetime_sum", with_throughput=True)
        log(NUM_EPISODES_LIFETIME, len(episodes), reduce="lifetime_sum")
        # Without a window, which RLlib would keep from the first call, of fewer episodes.
        for episode in episodes:
            for name, value in self._episode_metrics(episode):
                log(name, value, reduce="mean")

    def _episode_metrics(self, episode: Episode) -> Iterator[tuple[str, float]]:
        yield EPISODE_LEN_MEAN, float(len(episode))
        yield EPISODE_RETURN_MEAN, float(episode.rewards.sum())
        if episode.successes is not None:
            yield SUCCESS_LAST, float(episode.successes[-1])
            yield SUCCESS_ANY, float(episode.successes.any())
        if self._split.surrounding_indices:
            surrounding = episode.frames[:, list(self._split.surrounding_indices)]
            moved = np.linalg.norm(surrounding - surrounding[0], axis=-1)
            yield DISPLACEMENT, float(moved[-1])
            yield MOVED, float(moved.max() > MOVED_THRESHOLD)

    def get_metrics(self) -> Any:
        return self.metrics.reduce()

    def get_state(
        self,
        components: str | Collection[str] | None = None,
        *,
        not_components: str | Collection[str] | None = None,
        **kwargs: Any,
    ) -> StateDict:
        state: StateDict = {}
        if components is None:  # RLlib gives parts of a training runner to evaluation runners
            state["episodes_started"] = self._episodes_started
            state["rng"] = self._rng.bit_generator.state
            state["reports_success"] = self._success[1] is False
        if self._check_component(COMPONENT_RL_MODULE, components, not_components):
            state[COMPONENT_RL_MODULE] = self.module.get_state(**kwargs)
            state[WEIGHTS_SEQ_NO] = self._weights_seq_no
        return state

    def set_state(self, state: StateDict) -> None:
        if "rng" in state:
            self._episodes_started = int(state["episodes_started"])
            self._rng.bit_generator.state = state["rng"]
            if state.get("reports_success"):
                self._success = (self._success[0], False)
        if COMPONENT_RL_MODULE in state:
            # RLlib's runner skips weights with an older sequence number, so it would keep newer
            # weights if an earlier checkpoint is restored in the same process.
            module_state = state[COMPONENT_RL_MODULE]
            if isinstance(module_state, ray.ObjectRef):
                module_state = ray.get(module_state)
            self.module.set_state(module_state.get(DEFAULT_MODULE_ID, module_state))
            self._weights_seq_no = int(state.get(WEIGHTS_SEQ_NO, 0))

    def get_ctor_args_and_kwargs(self) -> tuple[tuple[Any, ...], dict[str, Any]]:
        return (), {"config": self.config}

    def get_checkpointable_components(self) -> list[tuple[str, Checkpointable]]:
        return [(COMPONENT_RL_MODULE, self.module)]

    def assert_healthy(self) -> None:
        assert self.module is not None

    def close_envs(self) -> None:
        for env in self.envs:
            env.close()
        self.envs = []

    def stop(self) -> None:
        self.close_envs()


def colored_noise(rng: np.random.Generator, exponent: float, shape: tuple[int, ...]) -> Floats:
    """Standard normal noise with the power f^-exponent over the first axis, of T steps.

    Timmer & Koenig 1995, "On generating power law noise". Frequency 0 has the power of the lowest
    frequency 1/T, so that the noise of an episode has a mean.
    """
    steps = shape[0]
    frequency = np.maximum(np.fft.rfftfreq(steps), 1 / steps)
    scale = frequency ** (-exponent / 2)
    white = rng.standard_normal(shape)
    noise = np.fft.irfft((np.fft.rfft(white, axis=0).T * scale).T, n=steps, axis=0)
    # The variance of each step: a real signal has every frequency twice, except the first and, if T
    # is even, the last.
    twice = np.full(len(scale), 2.0)
    twice[[0, -1] if steps % 2 == 0 else 0] = 1.0
    scaled: Floats = (noise / np.sqrt((twice * scale**2).sum() / steps)).astype(np.float32)
    return scaled


def _with_success(episode: Episode) -> Episode:
    """The episode, without success if no step reported one."""
    if episode.successes is not None:
        return episode
    return replace(episode, successes=np.zeros(len(episode), np.bool_))


def _bad_action(actions: Floats, inputs: Floats, places: list[str]) -> BadNumberError:
    """The error for actions [B, A] beyond +-1; `places` [B] name the episodes and steps.

    Observations are finite, so the weights are not finite, or the inputs are too large for them.
    """
    row, dimension = np.argwhere(~(np.abs(actions) <= 1.0))[0]
    return BadNumberError(
        f"{places[row]}: the policy's action[{dimension}] is "
        f"{actions[row, dimension]:g}, it must be within +-1\n"
        "The networks' weights are not finite, or the observation is too large for them (its "
        f"largest entry is {np.abs(inputs[row]).max():g})."
    )


def seed_or_entropy(seed: int | None) -> int:
    """The seed; for None, entropy from the system."""
    if seed is not None:
        return seed
    entropy = np.random.SeedSequence().entropy
    assert isinstance(entropy, int)
    return entropy
