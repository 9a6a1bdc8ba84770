"""TAC in programs that use RLlib directly: own classes, restored checkpoints, refused settings."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from torch import Tensor

from music_rllib import TAC, TACConfig, TACModule
from music_rllib.intrinsic.interface import IntrinsicReward, Sizes
from music_rllib.tac.learner import TACLearner

pytestmark = pytest.mark.usefixtures("local_ray")


def config(**settings: Any) -> TACConfig:
    """Ten steps per episode; a gradient limit selects autograd, so that nothing is compiled."""
    small = {"hidden_sizes": (8, 8), "batch_size": 8, "random_steps": 10, "replay_ratio": 0.1}
    found: TACConfig = TACConfig().environment("Pendulum-v1").debugging(seed=0)
    found.reporting(min_sample_timesteps_per_iteration=1)
    found.training(**{**small, "max_episode_steps": 10, "grad_clip": 1e9, **settings})
    return found


def built(made: TACConfig) -> TAC:
    algo: TAC = made.build_algo()
    return algo


class Rare(IntrinsicReward):
    """Less for each episode so far, which it counts."""

    scale = 1.0
    episodes: Tensor

    def __init__(self, sizes: Sizes) -> None:
        super().__init__(sizes)
        self.register_buffer("episodes", torch.zeros(()))

    def of_episode(self, observations: Tensor, actions: Tensor) -> Tensor:
        self.episodes += 1
        return torch.ones(len(actions)) / self.episodes

    def bonus(self, batch: Any) -> Tensor:
        stored: Tensor = batch.stored
        return stored


def test_of_episode_is_called_once_for_each_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("own_rare_reward")
    monkeypatch.setattr(module, "Rare", Rare, raising=False)
    monkeypatch.setitem(sys.modules, "own_rare_reward", module)
    algo = built(config().intrinsic(reward="own_rare_reward:Rare", weight=1.0))
    result = [algo.train() for _ in range(4)][-1]
    stored = algo.replay.values_of(np.arange(0, 44, 11))
    assert stored is not None
    assert stored.tolist() == pytest.approx([1, 1 / 2, 1 / 3, 1 / 4])
    assert np.isfinite(result["learners"]["default_policy"]["critics/bias"])


@pytest.mark.parametrize("before", [False, True])
def test_a_checkpoint_with_other_priorities_is_refused(before: bool, tmp_path: Path) -> None:
    def of(prioritized: bool) -> TAC:
        made = config().music(agent_indices=[0], surrounding_indices=[1, 2])
        return built(made.music(estimator="frozen", prioritise_replay=prioritized))

    source = of(before)
    source.train()
    source.save_to_path(str(tmp_path))
    same, other = of(before), of(not before)
    for algo in (same, other):
        algo.restore_from_path(str(tmp_path))
    same.train()
    with pytest.raises(ValueError, match="prioritise_replay must be that of the checkpoint"):
        other.train()


def test_a_checkpoint_without_the_numbers_of_a_reward_is_refused(tmp_path: Path) -> None:
    source = built(config())
    source.train()
    source.save_to_path(str(tmp_path))
    algo = built(config().intrinsic(reward="e3b"))
    algo.restore_from_path(str(tmp_path))
    with pytest.raises(ValueError, match="reward must be that of the checkpoint"):
        algo.train()


def test_a_mean_counts_all_episodes_of_a_call() -> None:
    runner = built(config(max_episode_steps=2)).env_runner
    for count in (5, 200):
        episodes = runner.sample(num_episodes=count)
        found = runner.get_metrics()["episode_return_mean"].peek()
        expected = np.mean([episode.rewards.sum() for episode in episodes])
        assert found == pytest.approx(expected, rel=1e-5)


def test_a_setting_that_follows_a_success_that_nothing_reports_warns() -> None:
    follows = {"follows": "success_rate", "points": [[0, 1], [1, 2]]}
    made = config(entropic_index=follows).evaluation(evaluation_interval=1, evaluation_duration=1)
    with pytest.warns(UserWarning, match=r"no episode has reported info\['is_success'\]"):
        built(made).train()


def with_module(name: str | None, **spec: Any) -> Callable[[TACConfig], TACConfig]:
    own = type("Own", (TACModule,), {name: lambda self, batch, **_: {}}) if name else None
    return lambda made: made.rl_module(rl_module_spec=RLModuleSpec(module_class=own, **spec))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (with_module("_forward_exploration"), "never calls _forward_exploration: override act"),
        (with_module("forward_inference"), "never calls forward_inference: override act"),
        (with_module(None, model_config={"fcnet_hiddens": [8]}), "fcnet_hiddens has no effect"),
        (
            lambda made: made.reporting(metrics_num_episodes_for_smoothing=5),
            "smoothing=5 has no effect",
        ),
        (
            lambda made: made.multi_agent(count_steps_by="agent_steps"),
            "count_steps_by='agent_steps' has no effect",
        ),
        (
            lambda made: made.evaluation(evaluation_config={"clip_actions": True, "gamma": 0.5}),
            "evaluation_config: clip_actions=True has no effect",
        ),
    ],
)
def test_what_has_no_effect_is_refused(
    change: Callable[[TACConfig], TACConfig], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        change(config()).validate()


def test_another_lr_after_a_restore_counts_from_the_first_update(tmp_path: Path) -> None:
    source = built(config(lr=1e-3))
    source.train()
    source.save_to_path(str(tmp_path))
    other = built(config(lr=1e-5))
    other.restore_from_path(str(tmp_path))
    learner = other.learner_group._learner
    assert isinstance(learner, TACLearner)
    assert learner._adam["networks"].param_groups[0]["lr"] == 1e-5


def test_evaluation_without_overrides_takes_the_mean_action() -> None:
    made = config().evaluation(evaluation_interval=1, evaluation_config=None)
    evaluation = made.get_evaluation_config_object()
    assert evaluation is not None
    assert evaluation.explore is False


def test_model_config_is_for_a_module_of_ones_own() -> None:
    own = RLModuleSpec(module_class=type("Own", (TACModule,), {}))
    config().rl_module(rl_module_spec=own, model_config={"width": 3}).validate()
    for spec in ({}, {"rl_module_spec": RLModuleSpec()}):
        with pytest.raises(ValueError, match=r"model_config=.* has no effect"):
            config().rl_module(model_config={"width": 3}, **spec).validate()


def test_replay_settings_of_a_task_are_checked_like_others() -> None:
    with pytest.raises(ValueError, match=r"^task_symmetries\.miror is not a known setting"):
        config().replay(task_symmetries={"miror": {"signs": [1]}})
    with pytest.raises(ValueError, match=r"moved_distance=...\) must be > 0, got -1"):
        config().replay(moved_distance=-1).validate()
    with pytest.raises(ValueError, match=r"total_env_steps=...\) must be >= 1, got 5"):
        config(total_env_steps="5").validate()


def test_defaults_are_values_and_a_forgotten_environment_is_named() -> None:
    assert TACConfig().to_dict()["intrinsic_settings"] == {}
    with pytest.raises(ValueError, match="an environment must be set"):
        TACConfig().build_algo()


def test_symmetries_can_be_a_mapping_as_tune_gives_them() -> None:
    settings = config().replay(symmetries=["mirror"]).to_dict() | {"task_symmetries": {}}
    with pytest.raises(ValueError, match="must have the symmetry mirror"):
        TAC(config=settings)
