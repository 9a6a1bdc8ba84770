"""The RLlib config of TAC, without the algorithm: `TACConfig` in `tac/algorithm.py` adds it."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self, TypeVar

from pydantic import BaseModel, ValidationError, model_validator
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig, NotProvided
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.tune.search.sample import Domain

from music_rllib.config.problems import problems_of
from music_rllib.config.run_settings import ReplaySettings
from music_rllib.config.tac_settings import TACSettings
from music_rllib.envs.features import Indices, Symmetries, check_split
from music_rllib.envs.tasks import LAST_SEED
from music_rllib.intrinsic.settings import IntrinsicSettings, MusicSettings
from music_rllib.runtime.quiet import quiet_third_parties
from music_rllib.schedules import Linear, Measured, StrictModel, check_measurable
from music_rllib.tac.env_runner import TrajectoryEnvRunner
from music_rllib.tac.learner import TACLearner
from music_rllib.tac.rl_module import ESTIMATOR_MODULE, EstimatorModule, TACModule
from music_rllib.tac.rllib_settings import ignored_settings

_Model = TypeVar("_Model", bound=BaseModel)


class Split(StrictModel):
    """Positions of the agent's and the surrounding state in the observation."""

    agent_indices: Indices = ()
    surrounding_indices: Indices = ()

    @model_validator(mode="after")
    def _both_or_none(self) -> Self:
        check_split(self.agent_indices, self.surrounding_indices)
        return self


class AlgorithmSettings(NamedTuple):
    """The validated settings of an algorithm, as all of its parts read them."""

    tac: TACSettings
    music: MusicSettings
    replay: ReplaySettings
    split: Split
    intrinsic: IntrinsicSettings = IntrinsicSettings()


class TACConfigBase(AlgorithmConfig):
    """Everything of `TACConfig` except its algorithm.

    Settings are plain attributes, so `tune.grid_search` works on them. `settings` is their one
    validated form; `validate()` checks it together with RLlib's settings.
    """

    def __init__(self, algo_class: type | None = None) -> None:
        quiet_third_parties()  # users of TAC can't act on RLlib's notices about its own API stack
        super().__init__(algo_class=algo_class)
        self._settings: AlgorithmSettings | None = None
        for model, prefix in _MODELS:
            for name, field in model.model_fields.items():
                setattr(self, prefix + name, field.get_default(call_default_factory=True))
        self.total_env_steps: int | None = None
        self.torch_threads = 1
        self.seed_range: tuple[int, int] = (0, LAST_SEED)
        self.success_key: str | None = "is_success"
        # Success of a step whose info lacks the key; None leaves the step out of success rates.
        self.success_if_missing: bool | None = None
        self.moved_distance: float | None = None
        self.task_symmetries = Symmetries()
        self.framework_str = "torch"
        self.env_runner_cls = TrajectoryEnvRunner
        # One iteration is one episode per sub-environment and the updates after it.
        self.min_time_s_per_iteration = None
        self.min_sample_timesteps_per_iteration = 1_000
        # RLlib's default would evaluate sampled actions.
        self.evaluation_config = {"explore": False}
        # The Learner checks for NaNs once per update call, with a message; not in every gradient.
        self.torch_skip_nan_gradients = True
        # TAC syncs weights itself; there are no connector states to sync.
        self._dont_auto_sync_env_runner_states = True

    def __setattr__(self, key: str, value: Any) -> None:
        super().__setattr__(key, value)
        if key in _FIELDS:
            self._settings = None

    # -- setting --------------------------------------------------------------------------

    def training(
        self,
        *,
        total_env_steps: int | None = NotProvided,
        torch_threads: int = NotProvided,
        **settings: Any,
    ) -> Self:
        """Set TAC's hyperparameters.

        Args:
            total_env_steps: budget of the run, of which `linear` schedules are fractions.
            torch_threads: threads of the Learner's process. More than one gains nothing on
                networks of this size, and changes results in the last digits.
            **settings: fields of `TACSettings`, or arguments of `AlgorithmConfig.training`.

        Raises:
            TypeError: unknown setting.
        """
        fields = TACSettings.model_fields
        tac = {name: settings.pop(name) for name in list(settings) if name in fields}
        super().training(**settings)
        return self._set(
            tac,
            total_env_steps=total_env_steps,
            torch_threads=torch_threads,
        )

    def music(
        self,
        *,
        agent_indices: Sequence[int] = NotProvided,
        surrounding_indices: Sequence[int] = NotProvided,
        **settings: Any,
    ) -> Self:
        """Set the hyperparameters of MUSIC's intrinsic reward.

        `estimator="trained"` and `mi_reward_weight` > 0 add the reward.

        Args:
            agent_indices: positions of the agent's state in the observation.
            surrounding_indices: positions of the surrounding state in the observation.
            **settings: fields of `MusicSettings`.

        Raises:
            TypeError: unknown setting.
        """
        agent, surrounding = (
            one if one is NotProvided or _is_searched(one) else tuple(one)
            for one in (agent_indices, surrounding_indices)
        )
        fields = _prefixed("music", settings, MusicSettings)
        return self._set(fields, agent_indices=agent, surrounding_indices=surrounding)

    def intrinsic(self, **settings: Any) -> Self:
        """Add an intrinsic reward to the task's and MUSIC's.

        Args:
            **settings: fields of `IntrinsicSettings`.

        Raises:
            TypeError: unknown setting.
        """
        return self._set(_prefixed("intrinsic", settings, IntrinsicSettings))

    def replay(
        self, *, moved_distance: float | None = NotProvided,
        task_symmetries: Symmetries | Mapping[str, Any] = NotProvided, **settings: Any,
    ) -> Self:  # fmt: skip
        """Set the hyperparameters of replay and hindsight.

        Args:
            moved_distance: for `hindsight_episodes: moved`, the distance from the first achieved
                goal that counts as moved. None: the task's reward decides; with dense rewards, a
                fifth of the environment's `distance_threshold`.
            task_symmetries: symmetries of the environment, for the setting `symmetries`; or a
                mapping as in a sweep's file.
            **settings: fields of `ReplaySettings`.

        Raises:
            TypeError: unknown setting.
        """
        if task_symmetries is not NotProvided and not _is_searched(task_symmetries):
            try:
                task_symmetries = Symmetries.model_validate(task_symmetries)
            except ValidationError as error:
                raise _in_words(error, task_symmetries, Symmetries, "task_symmetries.") from None
        fields = _prefixed("replay", settings, ReplaySettings)
        return self._set(fields, moved_distance=moved_distance, task_symmetries=task_symmetries)

    def use(self, settings: AlgorithmSettings) -> Self:
        """Take over validated settings, such as those of a sweep's run; nothing is validated."""
        for part, (_, prefix) in zip(settings, _MODELS, strict=True):
            for name, value in part:
                setattr(self, prefix + name, value)
        self._settings = settings
        return self

    def _set(self, settings: Mapping[str, Any], **optional: Any) -> Self:
        """Set attributes; those of `optional` only if they are provided."""
        given = {name: value for name, value in optional.items() if value is not NotProvided}
        for name, value in {**settings, **given}.items():
            setattr(self, name, value)
        return self

    def update_from_dict(self, config_dict: Any) -> Self:
        """Update the settings as RLlib does, but raise ValueError for unknown keys."""
        # RLlib also reads keys of its own dictionaries that are not attributes, and Tune adds keys
        # with double underscores.
        known = {*self.to_dict(), "multiagent"}
        unknown = [
            key
            for key in config_dict
            if not self._has(key) and key not in known and not key.startswith("__")
        ]
        if unknown:
            raise ValueError(
                f"unknown settings in the config: {', '.join(sorted(unknown))} (settings of groups "
                "have a prefix, such as replay_capacity)"
            )
        return super().update_from_dict(config_dict)  # type: ignore[no-any-return]

    def _has(self, key: str) -> bool:
        """Whether a setting has this name; methods and computed values are none."""
        of_class = inspect.getattr_static(type(self), self._translate_special_keys(key), None)
        if callable(of_class) or (isinstance(of_class, property) and of_class.fset is None):
            return False
        return hasattr(self, key)

    def to_dict(self) -> dict[str, Any]:
        found: dict[str, Any] = super().to_dict()
        del found["_settings"]
        return found

    def get_state(self) -> dict[str, Any]:
        # RLlib drops values of -1, which would then pass validation as the default.
        state: dict[str, Any] = super().get_state()
        return state | {name: getattr(self, name) for name in (*_FIELDS, "seed")}

    # -- reading --------------------------------------------------------------------------

    def get_evaluation_config_object(self) -> Any:
        found = super().get_evaluation_config_object()
        if found is not None and not self.evaluation_config:  # RLlib allows None
            found.explore = False
        return found

    @property
    def settings(self) -> AlgorithmSettings:
        """The validated settings; raises ValueError that names each problem."""
        if self._settings is None:
            found = AlgorithmSettings._make(self._validated(*part) for part in _MODELS)
            self.__dict__["_settings"] = found  # also if the config is frozen
            return found
        return self._settings

    def _validated(self, model: type[_Model], prefix: str) -> _Model:
        values = {name: getattr(self, prefix + name) for name in model.model_fields}
        try:
            return model.model_validate(values)
        except ValidationError as error:
            raise _in_words(error, values, model, prefix) from None

    def validate(self) -> None:
        if not self.in_evaluation and (problems := list(ignored_settings(self))):
            self._value_error("\n".join(problems))
        super().validate()
        tac, music, replay, split, intrinsic = self.settings
        if self.in_evaluation:
            return
        for name, value, least in (
            ("debugging(seed=...)", self.seed, 0),
            ("training(total_env_steps=...)", self.total_env_steps, 1),
            ("training(torch_threads=...)", self.torch_threads, 1),
        ):
            if value is not None and (isinstance(value, str) or value < least):
                self._value_error(f"{name} must be >= {least}, got {value}")
        if self.moved_distance is not None and not self.moved_distance > 0:
            self._value_error(f"replay(moved_distance=...) must be > 0, got {self.moved_distance}")
        if self.num_learners > 1:
            self._value_error(
                f"num_learners must be 0 or 1, got {self.num_learners}: one update of TAC is too "
                "small to be split. Run more trials instead."
            )
        if music.goals == "zero" and replay.hindsight_k > 0:
            self._value_error(
                "replay_hindsight_k must be 0 with music_goals='zero' (hindsight would replace "
                f"the zeros by achieved goals), got {replay.hindsight_k:g}"
            )
        try:
            music.check_rewards(intrinsic)
        except ValueError as error:
            self._value_error(f"music_{error}")
        if problem := replay.problem(music, intrinsic):
            self._value_error(f"replay_{problem}")
        schedules = (
            tac.entropic_index,
            getattr(tac.alpha, "value", tac.alpha),
            music.mi_reward_weight,
            intrinsic.weight,
            replay.importance_exponent,
        )
        if any(isinstance(s, Linear) for s in schedules) and not self.total_env_steps:
            self._value_error(
                "a linear schedule needs the budget: set training(total_env_steps=...)"
            )
        self._check_adaptive(tac, music, intrinsic)
        if music.estimator != "none" and not split.agent_indices:
            self._value_error(
                "MUSIC needs to know the agent's and the surrounding state: set "
                "music(agent_indices=[...], surrounding_indices=[...])"
            )

    def _check_adaptive(
        self, tac: TACSettings, music: MusicSettings, intrinsic: IntrinsicSettings
    ) -> None:
        adaptive = {
            "entropic_index": tac.entropic_index,
            "music_mi_reward_weight": music.mi_reward_weight,
            "intrinsic_weight": intrinsic.weight,
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

    @property
    def follows_success(self) -> bool:
        """Whether a setting follows the success rate."""
        tac, music, _, _, intrinsic = self.settings
        values = tac.entropic_index, music.mi_reward_weight, intrinsic.weight
        return any(isinstance(v, Measured) and v.follows == "success_rate" for v in values)

    # -- defaults for RLlib ---------------------------------------------------------------

    def get_default_rl_module_spec(self) -> RLModuleSpec:
        return RLModuleSpec(module_class=TACModule)

    def get_default_learner_class(self) -> type:
        return TACLearner

    @property
    def _model_config_auto_includes(self) -> dict[str, Any]:
        """RLlib merges a spec's own `model_config` into it, so own modules get the settings."""
        return {"tac": self.settings.tac}

    def get_multi_rl_module_spec(
        self, *, inference_only: bool = False, **kwargs: Any
    ) -> MultiRLModuleSpec:
        spec = super().get_multi_rl_module_spec(inference_only=inference_only, **kwargs)
        music = self.settings.music
        if music.estimator != "none" and not inference_only:
            policy = spec.rl_module_specs[DEFAULT_MODULE_ID]
            estimator = RLModuleSpec(
                module_class=EstimatorModule,
                observation_space=policy.observation_space,
                action_space=policy.action_space,
                model_config={
                    **dict(self.settings.split),
                    "hidden_size": music.hidden_size,
                    "bound": music.bound,
                },
                learner_only=True,
            )
            spec.add_modules({ESTIMATOR_MODULE: estimator})
        return spec


_MODELS: tuple[tuple[type[BaseModel], str], ...] = (
    (TACSettings, ""),
    (MusicSettings, "music_"),
    (ReplaySettings, "replay_"),
    (Split, ""),
    (IntrinsicSettings, "intrinsic_"),
)
"""Types of `AlgorithmSettings`, and the prefix of their fields as attributes of the config."""
_FIELDS = frozenset(prefix + name for model, prefix in _MODELS for name in model.model_fields)


def _in_words(
    error: ValidationError, values: Any, model: type[BaseModel], prefix: str
) -> ValueError:
    """The error of pydantic about `values` with one line per problem."""
    found = problems_of(error, values, model)
    lines = (f"{prefix}{'.'.join(map(str, path))} {rule}".lstrip() for path, rule in found)
    return ValueError("\n".join(lines))


def _is_searched(value: Any) -> bool:
    """Whether a value is one of Tune's search spaces, which Tune replaces."""
    return isinstance(value, Domain) or (isinstance(value, dict) and "grid_search" in value)


def _prefixed(method: str, settings: Mapping[str, Any], model: type[BaseModel]) -> dict[str, Any]:
    """Settings by the names of their attributes; raises TypeError for an unknown one."""
    unknown = sorted(set(settings) - set(model.model_fields))
    if unknown:
        known = ", ".join(model.model_fields)
        raise TypeError(f"{method}() has no setting {', '.join(unknown)}; it has: {known}")
    return {f"{method}_{name}": value for name, value in settings.items()}
