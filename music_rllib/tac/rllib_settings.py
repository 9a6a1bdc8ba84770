"""Settings and callbacks of RLlib that TAC refuses, because they would have no effect."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.callbacks.callbacks import RLlibCallback
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.utils import force_list

from music_rllib.tac.env_runner import TrajectoryEnvRunner
from music_rllib.tac.learner import TACLearner
from music_rllib.tac.rl_module import TACModule

_NO_CONNECTORS = "TAC runs no connectors: wrap the environment, or override a method of TACLearner"
_EPISODES = (
    "TAC plays one whole episode in each sub-environment: set "
    "env_runners(num_envs_per_env_runner=..., or num_env_runners for processes)"
)
_NETWORKS = (
    "set training(hidden_sizes=...), or rl_module(rl_module_spec=...) with a subclass of TACModule"
)
_SCALED = "TAC always scales actions from [-1, 1] to the environment's bounds"

_REMEDIES: dict[str, tuple[str, ...]] = {
    "set training(batch_size=..., replay_ratio=...)": (
        "train_batch_size", "_train_batch_size_per_learner", "num_epochs", "minibatch_size",
        "shuffle_batch_per_epoch", "num_aggregator_actors_per_learner",
    ),
    _NETWORKS: ("model",),
    "override TACLearner.configure_optimizers_for_module": ("optimizer",),
    "set training(...) and music(...)": ("algorithm_config_overrides_per_module",),
    _NO_CONNECTORS: (
        "_learner_connector", "add_default_connectors_to_learner_pipeline",
        "_env_to_module_connector", "add_default_connectors_to_env_to_module_pipeline",
        "_module_to_env_connector", "add_default_connectors_to_module_to_env_pipeline",
    ),
    _EPISODES: (
        "rollout_fragment_length", "batch_mode", "gym_env_vectorize_mode", "remote_worker_envs",
        "episode_lookback_horizon", "episodes_to_numpy",
    ),
    "a round ends with its episodes: set training(max_episode_steps=...)": ("sample_timeout_s",),
    "set training(normalise_observations=...)": ("observation_filter",),
    "set training(behaviour=...)": ("exploration_config",),
    "set replay(capacity=...) to a size that fits into memory": ("compress_observations",),
    "the replay's layout comes from the local runner's environment": ("create_local_env_runner",),
    "wrap the environment instead": ("preprocessor_pref", "clip_rewards", "action_mask_key"),
    _SCALED: ("normalize_actions", "clip_actions"),
    "set the environment's render_mode in env_config": ("render_env",),
    "handle failures within the environment, or set env_runners(num_env_runners=...), whose "
    "processes are restarted": ("restart_failed_sub_environments",),
    "a run without one of its environment runners would be another run: leave it False": (
        "ignore_env_runner_failures",
    ),
    "environment runners compute on the CPU": ("num_gpus_per_env_runner",),
    "updates on a CPU are compiled already": ("torch_compile_learner", "torch_compile_worker"),
    "set learners(num_gpus_per_learner=...)": ("num_gpus",),
    "TAC trains one policy in a single-agent environment": (
        "policies_to_train", "observation_fn", "count_steps_by",
    ),
    "TAC learns from its own replay: save and restore checkpoints": ("input_", "output"),
    "set min_sample_timesteps_per_iteration": ("min_train_timesteps_per_iteration",),
    "log metrics in callbacks": ("keep_per_episode_custom_metrics",),
    "results are means over an iteration: set reporting(min_sample_timesteps_per_iteration=...)": (
        "metrics_num_episodes_for_smoothing",
    ),
    "losses and gradients are float32": ("_torch_grad_scaler_class",),
}  # fmt: skip
"""Instruction for the user to the attributes of `AlgorithmConfig` that it replaces."""

NEVER_CALLED = (
    "on_sub_environment_created", "on_postprocess_trajectory", "on_create_policy",
    "on_learn_on_batch", "on_workers_recreated", "on_evaluate_offline_start",
    "on_evaluate_offline_end", "on_offline_eval_runners_recreated",
)  # fmt: skip
"""Callbacks of RLlib's old API stack and of offline evaluation."""
_ACTING = ("_forward_exploration", "forward_exploration", "_forward_inference", "forward_inference")
"""Methods of a module by which TAC's runners do not act."""


def ignored_settings(config: AlgorithmConfig) -> Iterator[str]:
    """Yield a message for each setting of RLlib that would be ignored: name, value, remedy."""
    if config.framework_str != "torch":
        yield f"framework must be 'torch', got {config.framework_str!r}"
    if not (config.enable_rl_module_and_learner and config.enable_env_runner_and_connector_v2):
        yield "api_stack: TAC runs on RLlib's new API stack only"
    if config.is_multi_agent:
        yield "multi_agent(policies=...): TAC trains one policy in a single-agent environment"
    yield from _without_effect(partial(getattr, config))
    if isinstance(overrides := config.evaluation_config, dict):
        yield from (f"evaluation_config: {line}" for line in _without_effect(overrides.get))
    yield from _unusable_callbacks(config)
    yield from _unusable_classes(config)


def _without_effect(value_of: Callable[[str, Any], Any]) -> Iterator[str]:
    plain = AlgorithmConfig()
    for remedy, settings in _REMEDIES.items():
        for name in settings:
            default = getattr(plain, name, None)
            if (value := value_of(name, default)) != default:
                yield f"{name.removeprefix('_')}={_short(value)} has no effect on TAC: {remedy}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def _unusable_callbacks(config: AlgorithmConfig) -> Iterator[str]:
    for name in NEVER_CALLED:
        plain = getattr(RLlibCallback, name, None)
        classes = [getattr(c, "func", c) for c in force_list(config.callbacks_class)]
        overridden = any(getattr(c, name, None) is not plain for c in classes)
        if overridden or getattr(config, f"callbacks_{name}", None) is not None:
            yield f"callbacks: {name} is never called by TAC: remove it, or use another callback"


def _unusable_classes(config: AlgorithmConfig) -> Iterator[str]:
    for name, found, needed in (
        ("env_runners(env_runner_cls=...)", config.env_runner_cls, TrajectoryEnvRunner),
        ("learners(learner_class=...)", config.learner_class, TACLearner),
    ):
        if not issubclass(found, needed):
            yield f"{name} must be a subclass of {needed.__name__}, got {found.__name__}"
    spec = config._rl_module_spec
    is_own = getattr(spec, "module_class", None) not in (None, TACModule)
    if config._model_config and not is_own:
        yield f"model_config={_short(config._model_config)} has no effect on TAC: {_NETWORKS}"
    if spec is None:
        return
    if not isinstance(spec, RLModuleSpec):
        yield f"rl_module(rl_module_spec=...) must be an RLModuleSpec, got {_short(spec)}"
    elif spec.module_class is not None and not issubclass(spec.module_class, TACModule):
        yield (
            "rl_module(rl_module_spec=...): module_class must be a subclass of "
            f"music_rllib.TACModule, got {spec.module_class.__name__}: override its setup() to "
            "replace networks, because the losses need the policy, the critics and their averages"
        )
    else:
        yield from _unused_of_module(spec)


def _unused_of_module(spec: RLModuleSpec) -> Iterator[str]:
    kind = spec.module_class or TACModule
    for name in _ACTING:
        if getattr(kind, name) is not getattr(TACModule, name):
            yield f"rl_module(rl_module_spec=...): TAC never calls {name}: override act() instead"
    given = spec.model_config or {}
    keys = given if isinstance(given, dict) else vars(given)
    if kind is TACModule and (unused := sorted(set(keys) - {"tac"})):
        yield (
            f"rl_module(rl_module_spec=...): model_config's {', '.join(unused)} has no effect on "
            f"TACModule: {_NETWORKS}"
        )
