"""Settings and callbacks of RLlib that TAC refuses, because they would have no effect."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.callbacks.callbacks import RLlibCallback
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.utils import force_list

from music_rllib.tac.env_runner import TrajectoryEnvRunner
from music_rllib.tac.learner import TACLearner
from music_rllib.tac.rl_module import TACModule

_UPDATES = "set training(batch_size=..., replay_ratio=...)"
_EPISODES = (
    "TAC plays one whole episode in each sub-environment: set "
    "env_runners(num_envs_per_env_runner=...)"
)
_ENVIRONMENT = "wrap the environment instead"
_LEARNER = "wrap the environment, or override a method of TACLearner (learners(learner_class=...))"
_NETWORKS = (
    "set training(hidden_sizes=...), or rl_module(rl_module_spec=...) with a subclass of TACModule"
)
_ONE_POLICY = "TAC trains one policy in a single-agent environment"
_ONLINE = "TAC learns from its own replay: save and restore checkpoints"

_INSTEAD: dict[str, dict[str, str]] = {
    "training": {
        "train_batch_size": _UPDATES,
        "_train_batch_size_per_learner": _UPDATES,
        "num_epochs": _UPDATES,
        "minibatch_size": _UPDATES,
        "shuffle_batch_per_epoch": "every minibatch is drawn at random from the replay",
        "model": _NETWORKS,
        "optimizer": "override TACLearner.configure_optimizers_for_module",
        "_learner_connector": f"TAC's Learner runs no connectors; {_LEARNER}",
        "add_default_connectors_to_learner_pipeline": "TAC's Learner runs no connectors",
    },
    "rl_module": {
        "_model_config": _NETWORKS,
        "algorithm_config_overrides_per_module": "set training(...) and music(...)",
    },
    "env_runners": {
        "_env_to_module_connector": f"TAC's env runner runs no connectors; {_ENVIRONMENT}",
        "_module_to_env_connector": f"TAC's env runner runs no connectors; {_ENVIRONMENT}",
        "add_default_connectors_to_env_to_module_pipeline": "TAC's env runner runs no connectors",
        "add_default_connectors_to_module_to_env_pipeline": "TAC's env runner runs no connectors",
        "rollout_fragment_length": _EPISODES,
        "batch_mode": _EPISODES,
        "gym_env_vectorize_mode": f"{_EPISODES}, or num_env_runners for processes",
        "sample_timeout_s": "a round ends with its episodes: set training(max_episode_steps=...)",
        "observation_filter": "set training(normalise_observations=...)",
        "preprocessor_pref": _ENVIRONMENT,
        "compress_observations": "set replay(capacity=...) to what fits into memory",
        "remote_worker_envs": "set env_runners(num_env_runners=...)",
        "episode_lookback_horizon": "TAC keeps whole episodes",
        "episodes_to_numpy": "TAC keeps whole episodes as arrays",
        "exploration_config": "set training(behaviour=...)",
        "create_local_env_runner": "the replay's layout comes from the local runner's environment",
    },
    "environment": {
        "clip_rewards": _ENVIRONMENT,
        "normalize_actions": "TAC always scales actions from [-1, 1] to the environment's bounds",
        "clip_actions": "TAC always scales actions from [-1, 1] to the environment's bounds",
        "render_env": "set the environment's render_mode in env_config",
        "action_mask_key": _ENVIRONMENT,
    },
    "fault_tolerance": {
        "restart_failed_sub_environments": "handle failures within the environment, or set "
        "env_runners(num_env_runners=...), whose processes are restarted",
    },
    "learners": {"num_aggregator_actors_per_learner": "TAC's minibatches need no aggregation"},
    "framework": {
        "torch_compile_learner": "updates on a CPU are compiled already",
        "torch_compile_worker": "the policy acts without PyTorch on a CPU",
    },
    "resources": {"num_gpus": "set learners(num_gpus_per_learner=...)"},
    "multi_agent": {"policies_to_train": _ONE_POLICY, "observation_fn": _ONE_POLICY},
    "offline_data": {"input_": _ONLINE, "output": _ONLINE},
    "reporting": {
        "min_train_timesteps_per_iteration": "set min_sample_timesteps_per_iteration",
        "keep_per_episode_custom_metrics": "log metrics in callbacks",
    },
    "experimental": {"_torch_grad_scaler_class": "losses and gradients are float32"},
}
"""Method and attribute of `AlgorithmConfig` to the instruction for its user."""

NEVER_CALLED = (
    "on_sub_environment_created", "on_postprocess_trajectory", "on_create_policy",
    "on_learn_on_batch", "on_workers_recreated", "on_evaluate_offline_start",
    "on_evaluate_offline_end", "on_offline_eval_runners_recreated",
)  # fmt: skip
"""Callbacks of RLlib's old API stack and of offline evaluation."""


def ignored_settings(config: AlgorithmConfig) -> Iterator[str]:
    """Yield a message for each setting of RLlib that would be ignored: name, value, remedy."""
    if config.framework_str != "torch":
        yield f"framework must be 'torch', got {config.framework_str!r}"
    if not (config.enable_rl_module_and_learner and config.enable_env_runner_and_connector_v2):
        yield "api_stack: TAC runs on RLlib's new API stack only"
    if config.is_multi_agent:
        yield f"multi_agent(policies=...) is refused: {_ONE_POLICY}"
    plain = AlgorithmConfig()
    for method, settings in _INSTEAD.items():
        for name, instead in settings.items():
            value = getattr(config, name, None)
            if value != getattr(plain, name, None):
                shown = f"{method}({name.removeprefix('_')}={_short(value)})"
                yield f"{shown} has no effect on TAC: {instead}"
    yield from _unusable_callbacks(config)
    yield from _unusable_classes(config)


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
    if spec is None:
        return
    if not isinstance(spec, RLModuleSpec):
        yield f"rl_module(rl_module_spec=...) must be an RLModuleSpec, got {_short(spec)}"
    elif spec.module_class is not None and not issubclass(spec.module_class, TACModule):
        yield (
            "rl_module(rl_module_spec=...): module_class must be a subclass of "
            f"music_rllib.TACModule, got {spec.module_class.__name__}: override its setup() to "
            "replace networks, since the losses need the policy, the critics and their averages"
        )
