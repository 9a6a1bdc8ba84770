"""The current values of q, alpha and the intrinsic reward's weight."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from music_rllib import names
from music_rllib.config.tac_settings import TACSettings, alpha_at
from music_rllib.intrinsic.settings import MusicSettings
from music_rllib.schedules import Follower, Linear, Measured, Piecewise, Quantity, value_at


class ScheduledSettings:
    """Settings that change over a run, at the time of the last `advance`.

    `total_env_steps` is the run's budget, 0 where it is not known; `actions` the number of action
    dimensions.
    """

    entropic_index: float
    mi_reward_weight: float
    alpha: float
    """Alpha at the current q; without effect where it is learned."""

    def __init__(
        self, tac: TACSettings, music: MusicSettings, total_env_steps: int, actions: int
    ) -> None:
        self._tac, self._total, self._actions = tac, total_env_steps, actions
        self._adaptive: dict[str, float | Linear | Piecewise | Measured] = {
            names.ENTROPIC_INDEX: tac.entropic_index,
            names.MI_REWARD_WEIGHT: music.mi_reward_weight,
        }
        self._followers = {
            name: Follower(schedule)
            for name, schedule in self._adaptive.items()
            if isinstance(schedule, Measured)
        }
        self._set(0, {})

    def advance(self, env_steps: int) -> None:
        """Sets the values for `env_steps`, by the measurements so far."""
        self._set(env_steps, {name: each.measured for name, each in self._followers.items()})

    def _set(self, env_steps: int, followed: dict[str, float | None]) -> None:
        self._env_steps, self._followed = env_steps, followed
        self.entropic_index, self.mi_reward_weight = (
            value_at(schedule, env_steps, self._total, followed.get(name))
            for name, schedule in self._adaptive.items()
        )
        self.alpha = alpha_at(self._tac, self.entropic_index, env_steps, self._total, self._actions)

    def observe(self, quantity: Quantity, measured: float, env_steps: int | None = None) -> None:
        """Records a measurement after `env_steps`, or at the last `advance`."""
        at = self._env_steps if env_steps is None else env_steps
        for follower in self._followers.values():
            follower.observe(quantity, measured, at)

    def metrics(self) -> dict[str, float]:
        """The values without alpha, and the measurements that they follow, by metric name."""
        values = (self.entropic_index, self.mi_reward_weight)
        followed = {
            names.FOLLOWED[name]: measured
            for name, measured in self._followed.items()
            if measured is not None
        }
        return dict(zip(self._adaptive, values, strict=True)) | followed

    def state(self) -> dict[str, Any]:
        """The state for a checkpoint; the values of the last update diagnose fresh episodes."""
        return {
            "env_steps": self._env_steps,
            "followed": dict(self._followed),
            "followers": {name: follower.state() for name, follower in self._followers.items()},
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Continues from a result of `state`."""
        self._set(state["env_steps"], dict(state["followed"]))
        for name, follower in self._followers.items():
            follower.load_state(state["followers"][name])
