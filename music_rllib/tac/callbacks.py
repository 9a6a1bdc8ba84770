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
    """Keeps RLlib's episodes beside the runner's own where a config has callbacks, else nothing.

    They hold what the environment returned and the actions in [-1, 1], like those of RLlib's own
    runner; what a callback changes in them is not learned from. The scaled action is in their
    `extra_model_outputs` as "actions_for_env". `env` is the sub-environment, since there is no
    vector environment.
    """

    def __init__(self, runner: Any) -> None:
        config = runner.config
        classes = [c for c in force_list(config.callbacks_class) if c is not RLlibCallback]
        self._objects = [made() for made in classes]
        self._functions = {name: getattr(config, f"callbacks_{name}") for name in _CALLED}
        self.is_on = bool(self._objects) or any(self._functions.values())
        """Whether anything is called."""
        self._runner = runner
        self._episodes: dict[int, SingleAgentEpisode] = {}
        self._watched: dict[int, _Watched] = {}
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

    def made(self, env: Any, context: EnvContext) -> None:
        """A sub-environment was made."""
        if self.is_on:
            self._call("on_environment_created", env=env, env_context=context)

    def created(self, index: int) -> None:
        """Sub-environment `index` is about to be reset."""
        if self.is_on:
            env = self._runner.envs[index]
            self._watched[index] = _Watched(env)
            self._episodes[index] = SingleAgentEpisode(
                observation_space=env.observation_space, action_space=env.action_space
            )
            self._call_of_episode("on_episode_created", index)

    def started(self, index: int, observation: Any, info: dict[str, Any]) -> None:
        """It was reset."""
        if self.is_on:
            self._episodes[index].add_env_reset(copy.deepcopy(observation), copy.copy(info))
            self._call_of_episode("on_episode_start", index)

    def watched(self, index: int) -> Any:
        """The sub-environment; where anything is called, one that keeps its last step."""
        return self._watched[index] if self.is_on else self._runner.envs[index]

    def stepped(self, index: int, action: Any, scaled: Any, ended: bool | None) -> None:
        """It made a step; `ended` is whether it terminated, None where the episode continues."""
        if not self.is_on:
            return
        observation, reward, _, _, info = self._watched[index].last
        self._episodes[index].add_env_step(
            copy.deepcopy(observation), action, reward, copy.copy(info),
            terminated=ended is True, truncated=ended is False,
            extra_model_outputs={"actions_for_env": scaled},
        )  # fmt: skip
        self._call_of_episode("on_episode_step", index)
        if ended is not None:
            self._call_of_episode("on_episode_end", index, prev_episode_chunks=[])
            self._finished.append(self._episodes[index].to_numpy())

    def sampled(self) -> None:
        """A call of `sample` ends."""
        if self.is_on:
            self._call("on_sample_end", samples=self._finished)
            self._finished = []


class _Watched:
    """An environment whose last step is kept."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self.last: Any = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def step(self, action: Any) -> Any:
        self.last = self._env.step(action)
        return self.last
