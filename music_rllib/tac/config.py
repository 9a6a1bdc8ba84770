"""`TACConfig`: an ordinary RLlib config whose own settings are those of TAC, MUSIC and replay."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self, TypeVar

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig, NotProvided
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.tune.search.sample import Domain

from music_rllib.config.returns import Range, cut_off
from music_rllib.config.tac_settings import TACSettings
from music_rllib.envs.tasks import BUILT_IN_TASKS, LAST_SEED, Indices, check_split
from music_rllib.intrinsic.interface import IntrinsicReward
from music_rllib.intrinsic.music import Music
from music_rllib.intrinsic.settings import MusicSettings
from music_rllib.replay.settings import ReplaySettings
from music_rllib.runtime.quiet import quiet_third_parties
from music_rllib.schedules import Linear, Measured, check_measurable
from music_rllib.tac.rl_module import ESTIMATOR_MODULE, EstimatorModule, TACModule
from music_rllib.tac.rllib.settings import without_effect
from music_rllib.tac.scheduled import ScheduledSettings

_Settings = TypeVar("_Settings", TACSettings, MusicSettings, ReplaySettings)


class TACConfig(AlgorithmConfig):
    """Configures TAC, with or without MUSIC, on any continuous-action Gymnasium environment.

    Every field of `TACSettings` is an attribute and an argument of `training()`, every field of
    `MusicSettings` (prefixed `music_`) of `music()`, every field of `ReplaySettings` (prefixed
    `replay_`) of `replay()`. They are plain attributes, so `tune.grid_search` works on them; they
    are validated together by `validate()`.

        >>> config = (
        ...     TACConfig()
        ...     .environment("Pendulum-v1")
        ...     .training(entropic_index=1.5, alpha=0.2)
        ... )
        >>> algo = config.build_algo()
    """

    def __init__(self, algo_class: type | None = None) -> None:
        from music_rllib.tac.algorithm import TAC
        from music_rllib.tac.env_runner import TrajectoryEnvRunner

        # A user of TAC can do nothing about RLlib's notices on its own API stack.
        quiet_third_parties()
        super().__init__(algo_class=algo_class or TAC)
        for settings, prefix in _OWNED:
            for name, field in settings.model_fields.items():
                setattr(self, prefix + name, field.default)
        self.total_env_steps: int | None = None
        self.torch_threads = 1
        self.agent_indices: tuple[int, ...] = ()
        self.surrounding_indices: tuple[int, ...] = ()
        self.reward_range: tuple[float, float] | None = None
        self.seed_range: tuple[int, int] = (0, LAST_SEED)
        self.success_key: str | None = "is_success"
        # Success of a step whose info lacks the key; None leaves the step out of success rates.
        self.success_if_missing: bool | None = None
        self.moved_distance: float | None = None
        self.framework_str = "torch"
        self.env_runner_cls = TrajectoryEnvRunner
        # One iteration is one episode per sub-environment and the updates after it.
        self.min_time_s_per_iteration = None
        self.min_sample_timesteps_per_iteration = 1_000
        # The Learner checks for NaNs once per update call, with a message; not in every gradient.
        self.torch_skip_nan_gradients = True
        # TAC syncs weights itself; there are no connector states to sync.
        self._dont_auto_sync_env_runner_states = True

    def __setattr__(self, key: str, value: Any) -> None:
        # Checked here, because RLlib later takes every -1 for "not set" and would use the default.
        if key in _CHECKS and not _is_search_space(value):
            _checked(key, lambda: _CHECKS[key].validate_python(value))
        super().__setattr__(key, value)

    # -- setting --------------------------------------------------------------------------

    def training(
        self,
        *,
        total_env_steps: int | None = NotProvided,
        torch_threads: int = NotProvided,
        reward_range: tuple[float, float] | None = NotProvided,
        **settings: Any,
    ) -> Self:
        """Sets TAC's hyper-parameters.

        Args:
            total_env_steps: budget of the run, of which `linear` schedules are fractions.
            reward_range: smallest and largest reward of the environment, if they are known:
                `validate()` then warns of `target_bounds` that cut off values within reach.
            torch_threads: threads of the Learner's process. More than one gains nothing on
                networks of this size, and changes results in the last digits.
            **settings: fields of `TACSettings`, or arguments of `AlgorithmConfig.training`.

        Raises:
            TypeError: an unknown setting.
        """
        tac = {name: settings.pop(name) for name in list(settings) if name in _TAC_FIELDS}
        super().training(**settings)
        return self._set(
            tac,
            total_env_steps=total_env_steps,
            torch_threads=torch_threads,
            reward_range=reward_range,
        )

    def music(
        self,
        *,
        agent_indices: Sequence[int] = NotProvided,
        surrounding_indices: Sequence[int] = NotProvided,
        **settings: Any,
    ) -> Self:
        """Switches MUSIC's intrinsic reward on and sets it up.

        Args:
            agent_indices: where the agent's state lies in the observation.
            surrounding_indices: where the surrounding state lies in the observation.
            **settings: fields of `MusicSettings`.

        Raises:
            TypeError: an unknown setting.
            ValueError: the indices overlap, or repeat one.
        """
        _reject_unknown("music", settings, MusicSettings)
        self._set(_prefixed("music_", settings))
        if agent_indices is not NotProvided:
            self.agent_indices = tuple(agent_indices)
        if surrounding_indices is not NotProvided:
            self.surrounding_indices = tuple(surrounding_indices)
        if self.agent_indices and self.surrounding_indices:  # a later call may set the other one
            check_split(self.agent_indices, self.surrounding_indices)
        return self

    def replay(self, *, moved_distance: float | None = NotProvided, **settings: Any) -> Self:
        """Sets the replay and hindsight up.

        Args:
            moved_distance: for `hindsight_episodes: moved`, the distance from the first achieved
                goal that counts as moved. None: the task's reward decides, or where it is dense a
                fifth of the environment's `distance_threshold`.
            **settings: fields of `ReplaySettings`.

        Raises:
            TypeError: an unknown setting.
        """
        _reject_unknown("replay", settings, ReplaySettings)
        return self._set(_prefixed("replay_", settings), moved_distance=moved_distance)

    def _set(self, settings: Mapping[str, Any], **more: Any) -> Self:
        """Sets attributes; those of `more` only where they are provided."""
        given = {name: value for name, value in more.items() if value is not NotProvided}
        for name, value in {**settings, **given}.items():
            setattr(self, name, value)
        return self

    def update_from_dict(self, config_dict: Any) -> Self:
        """Updates the settings as RLlib does, but raises ValueError for unknown keys."""
        # RLlib also reads keys of its own dictionaries that are no attributes, and Tune adds keys
        # with double underscores.
        known = {*self.to_dict(), "multiagent"}
        unknown = [
            key
            for key in config_dict
            if not hasattr(self, key) and key not in known and not key.startswith("__")
        ]
        if unknown:
            raise ValueError(f"unknown settings in the config: {', '.join(sorted(unknown))}")
        return super().update_from_dict(config_dict)  # type: ignore[no-any-return]

    # -- reading --------------------------------------------------------------------------

    def tac_settings(self) -> TACSettings:
        """The validated settings of TAC; raises ValueError that names each problem."""
        return self._collect(TACSettings, "")

    def music_settings(self) -> MusicSettings:
        """The validated settings of MUSIC; raises ValueError that names each problem."""
        return self._collect(MusicSettings, "music_")

    def replay_settings(self) -> ReplaySettings:
        """The validated settings of the replay; raises ValueError that names each problem."""
        return self._collect(ReplaySettings, "replay_")

    def _collect(self, model: type[_Settings], prefix: str) -> _Settings:
        values = {name: getattr(self, prefix + name) for name in model.model_fields}
        return _checked(prefix, lambda: model.model_validate(values))

    def validate(self) -> None:
        if not self.in_evaluation and (problems := list(without_effect(self))):
            self._value_error("\n".join(problems))
        super().validate()
        tac, music, replay = self.tac_settings(), self.music_settings(), self.replay_settings()
        if self.in_evaluation:
            return
        if self.num_learners > 1:
            self._value_error(
                f"num_learners must be 0 or 1, got {self.num_learners}: one update of TAC is too "
                "small to be split. Run more trials instead."
            )
        if music.prioritise_replay and replay.priority != "uniform":
            self._value_error(
                "replay_priority must be 'uniform' with music_prioritise_replay, "
                f"got {replay.priority!r}: one of them decides what is replayed"
            )
        if music.prioritise_replay and replay.hindsight_episodes == "moved":
            self._value_error(
                "replay_hindsight_episodes must be 'all' with music_prioritise_replay, got "
                "'moved': one of them decides what is replayed"
            )
        if music.goals == "zero" and replay.hindsight_k > 0:
            self._value_error(
                "replay_hindsight_k must be 0 with music_goals='zero' (hindsight would put "
                f"achieved goals in place of the zeros), got {replay.hindsight_k:g}"
            )
        schedules = (
            tac.entropic_index,
            getattr(tac.alpha, "value", tac.alpha),
            music.mi_reward_weight,
            replay.importance_exponent,
        )
        if any(isinstance(s, Linear) for s in schedules) and not self.total_env_steps:
            self._value_error(
                "a linear schedule needs the budget: set training(total_env_steps=...)"
            )
        self._check_adaptive(tac, music)
        if music.estimator != "none" and not (self.agent_indices and self.surrounding_indices):
            self._value_error(
                "MUSIC needs to know the agent's and the surrounding state: set "
                "music(agent_indices=[...], surrounding_indices=[...])"
            )
        check_split(self.agent_indices, self.surrounding_indices)
        task = self._rewards()
        if task is not None and (remark := cut_off(tac, music, task)):
            warnings.warn(str(remark), stacklevel=2)

    def _check_adaptive(self, tac: TACSettings, music: MusicSettings) -> None:
        adaptive = {
            "entropic_index": tac.entropic_index,
            "music_mi_reward_weight": music.mi_reward_weight,
        }
        success, entropy = self.success_key is not None, tac.policy == "stochastic"
        check_measurable(adaptive, success=success, entropy=entropy)
        for name, value in adaptive.items():
            followed = isinstance(value, Measured) and value.follows == "success_rate"
            if followed and not self.evaluation_interval:
                self._value_error(
                    f"{name}.follows: success_rate needs evaluations: set "
                    "evaluation(evaluation_interval=...)"
                )

    def _rewards(self) -> Range | None:
        """The range of a step's reward, as set or a built-in task's; None: unknown."""
        reward_range = self.reward_range
        if reward_range is None and not self.env_config:
            built_in = (t.reward_range for t in BUILT_IN_TASKS.values() if t.env_id == self.env)
            reward_range = next(built_in, None)
        return None if reward_range is None else Range(*reward_range)

    # -- what RLlib builds from it --------------------------------------------------------

    def get_default_rl_module_spec(self) -> RLModuleSpec:
        return RLModuleSpec(module_class=TACModule)

    @property
    def _model_config_auto_includes(self) -> dict[str, Any]:
        """RLlib lays a spec's own `model_config` upon it, so that own modules get the settings."""
        return {"tac": self.tac_settings().model_dump(mode="json")}

    def get_multi_rl_module_spec(
        self, *, inference_only: bool = False, **kwargs: Any
    ) -> MultiRLModuleSpec:
        spec = super().get_multi_rl_module_spec(inference_only=inference_only, **kwargs)
        music = self.music_settings()
        if music.estimator != "none" and not inference_only:
            policy = spec.rl_module_specs[DEFAULT_MODULE_ID]
            estimator = RLModuleSpec(
                module_class=EstimatorModule,
                observation_space=policy.observation_space,
                action_space=policy.action_space,
                model_config={
                    "agent_indices": self.agent_indices,
                    "surrounding_indices": self.surrounding_indices,
                    "hidden_size": music.hidden_size,
                },
                learner_only=True,
            )
            spec.add_modules({ESTIMATOR_MODULE: estimator})
        return spec

    def intrinsic_reward(self, networks: Any) -> IntrinsicReward:
        """The reward that the Learner adds; a subclass may return another one.

        `networks` is the module `ESTIMATOR_MODULE`; None where the settings have no estimator.
        """
        return Music(self.music_settings(), networks and networks.estimator)

    def scheduled(self, actions: int) -> ScheduledSettings:
        """The settings that change over the run; `actions` is the number of action dimensions."""
        return ScheduledSettings(
            self.tac_settings(), self.music_settings(), self.total_env_steps or 0, actions
        )

    def get_default_learner_class(self) -> type:
        from music_rllib.tac.learner import TACLearner

        return TACLearner


_OWNED: tuple[tuple[type[BaseModel], str], ...] = (
    (TACSettings, ""),
    (MusicSettings, "music_"),
    (ReplaySettings, "replay_"),
)
_TAC_FIELDS = frozenset(TACSettings.model_fields)
_CHECKS: dict[str, TypeAdapter[Any]] = {
    prefix + name: TypeAdapter(field.rebuild_annotation(), config=ConfigDict(allow_inf_nan=False))
    for settings, prefix in _OWNED
    for name, field in settings.model_fields.items()
} | {name: TypeAdapter(Indices) for name in ("agent_indices", "surrounding_indices")}
"""The rule of each single field; `validate()` checks rules between fields."""
_KINDS = frozenset(
    {
        *("constant", "linear", "piecewise", "measured", "scheduled", "learned"),
        *("policy", "gaussian_noise"),
    }
)
"""Members of unions, which pydantic adds to an error's location."""
_T = TypeVar("_T")


def _checked(place: str, validation: Callable[[], _T]) -> _T:
    """The result of `validation`; its errors become one ValueError with field, rule and value."""
    try:
        return validation()
    except ValidationError as error:
        problems = []
        for problem in error.errors():
            inside = [str(part) for part in problem["loc"] if part not in _KINDS]
            where = place + ("." if place in _CHECKS and inside else "") + ".".join(inside)
            rule = problem["msg"].removeprefix("Value error, ")
            value = "" if "got " in rule else f", got {problem['input']!r}"
            problems.append(f"{where}: {rule}{value}" if where else f"{rule}{value}")
        raise ValueError("; ".join(problems)) from None


def _prefixed(prefix: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    return {prefix + name: value for name, value in settings.items()}


def _is_search_space(value: Any) -> bool:
    """Whether Tune still has to choose the value."""
    return isinstance(value, Domain) or (isinstance(value, dict) and "grid_search" in value)


def _reject_unknown(method: str, settings: Mapping[str, Any], model: type[BaseModel]) -> None:
    unknown = sorted(set(settings) - set(model.model_fields))
    if unknown:
        known = ", ".join(model.model_fields)
        raise TypeError(f"{method}() has no setting {', '.join(unknown)}; it has: {known}")
