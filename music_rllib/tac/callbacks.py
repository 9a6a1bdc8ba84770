"""RLlib's callbacks of environments and episodes, as `TrajectoryEnvRunner` calls them."""

from __future__ import annotations

import copy
from typing import Any

from ray.rllib.callbacks.callbacks import RLlibCallback
from ray.rllib.callbacks.utils import make_callback
from ray.rllib.env.env_context import EnvContext
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils import force_list

_CALLED = (
    "on_environment_created", "on_episode_created", "on_episode_start", "on_episode_step",
    "on_episode_end", "on_sample_end",
)  # fmt: skip


class EpisodeCallbacks:
    """Builds RLlib's episodes for callbacks; does nothing if a config has no callbacks.

    As in RLlib's own runner, episodes have what the environment returned and actions in [-1, 1].
    Changes that a callback makes to them are not learned from. The scaled action is in their
    `extra_model_outputs` as "actions_for_env". `env` is the sub-environment, because there is no
    vector environment.
    """

    def __init__(self, runner: Any) -> None:
        config = runner.config
        classes = [c for c in force_list(config.callbacks_class) if c is not RLlibCallback]
        self._objects = [made() for made in classes]
        self._functions = {name: getattr(config, f"callbacks_{name}") for name in _CALLED}
        self._is_on = bool(self._objects) or any(self._functions.values())
        self._runner = runner
        self._episodes: dict[int, SingleAgentEpisode] = {}
        self._recorders: dict[int, _Recorder] = {}
        self._finished: list[SingleAgentEpisode] = []

    def _call(self, name: str, **arguments: Any) -> None:
        make_callback(
            name,
            callbacks_objects=self._objects,
            callbacks_functions=self._functions[name],
            kwargs={
                "env_runner": self._runner, "metrics_logger": self._runner.metrics, **arguments
            },
        )  # fmt: skip

    def _call_of_episode(self, name: str, index: int, **arguments: Any) -> None:
        self._call(
            name, episode=self._episodes[index], env=self._runner.envs[index],
            rl_module=self._runner.module, env_index=index, **arguments,
        )  # fmt: skip

    def environment_created(self, env: Any, context: EnvContext) -> None:
        if self._is_on:
            self._call("on_environment_created", env=env, env_context=context)

    def episode_created(self, index: int) -> None:
        """Call before sub-environment `index` is reset."""
        if self._is_on:
            env = self._runner.envs[index]
            self._recorders[index] = _Recorder(env)
            self._episodes[index] = SingleAgentEpisode(
                observation_space=env.observation_space, action_space=env.action_space
            )
            self._call_of_episode("on_episode_created", index)

    def episode_started(self, index: int, observation: Any, info: dict[str, Any]) -> None:
        """Call after sub-environment `index` was reset."""
        if self._is_on:
            self._episodes[index].add_env_reset(copy.deepcopy(observation), copy.copy(info))
            self._call_of_episode("on_episode_start", index)

    def env(self, index: int) -> Any:
        """Sub-environment `index`, wrapped to record its last step if there are callbacks."""
        return self._recorders[index] if self._is_on else self._runner.envs[index]

    def episode_stepped(self, index: int, action: Any, scaled: Any, ended: bool | None) -> None:
        """Call after a step; `ended` is whether it terminated, None if the episode continues."""
        if not self._is_on:
            return
        observation, reward, _, _, info = self._recorders[index].last
        self._episodes[index].add_env_step(
            copy.deepcopy(observation), action, reward, copy.copy(info),
            terminated=ended is True, truncated=ended is False,
            extra_model_outputs={"actions_for_env": scaled},
        )  # fmt: skip
        self._call_of_episode("on_episode_step", index)
        if ended is not None:
            self._call_of_episode("on_episode_end", index, prev_episode_chunks=[])
            self._finished.append(self._episodes[index].to_numpy())

    def sample_ended(self) -> None:
        if self._is_on:
            self._call("on_sample_end", samples=self._finished)
            self._finished = []


class _Recorder:
    """An environment that keeps the result of its last step."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self.last: Any = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def step(self, action: Any) -> Any:
        self.last = self._env.step(action)
        return self.last
