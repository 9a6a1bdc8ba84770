"""Alphas for comparing q at equal entropy reach their targets on a bandit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.policy.sample_batch import MultiAgentBatch, SampleBatch

from music_rllib import names
from music_rllib.functional.entropy_scale import matched_alpha, normalised_alpha
from music_rllib.tac.learner import TACLearner
from tests.integration.algorithm.test_tac_losses import small_learner

ACTIONS, BATCH = 2, 32
RAMP = {"schedule": "linear", "start": 1.0, "end": 3.0, "begin": 0.0, "finish": 1.0}


def learner(**settings: Any) -> TACLearner:
    observations = gym.spaces.Box(-1.0, 1.0, (1,))
    fast = {"batch_size": BATCH, "lr": 2e-2, "tau": 0.05, "normalise_observations": False}
    return small_learner(observations, ACTIONS, 0, **{**fast, **settings})


def learn(built: TACLearner, updates: int, env_steps: int = 0) -> dict[str, float]:
    """Metrics of updates on a bandit whose reward falls with the squared distance to an action."""
    rows, rng = updates * BATCH, np.random.default_rng(built._grad_updates)
    actions = rng.uniform(-1, 1, (rows, ACTIONS)).astype(np.float32)
    states = np.ones((rows, 1), np.float32)
    columns = {
        "obs": states,
        "new_obs": states,
        "actions": actions,
        "rewards": -2.0 * np.square(actions - 0.2).sum(1),
        "discounts": np.zeros(rows, np.float32),
    }
    batch = MultiAgentBatch({DEFAULT_MODULE_ID: SampleBatch(columns)}, env_steps=rows)
    steps = {"num_env_steps_sampled_lifetime": env_steps}
    results = built.update(batch, timesteps=steps)[DEFAULT_MODULE_ID]
    return {name: float(value.peek()) for name, value in results.items()}


@pytest.mark.parametrize("q", [1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("form", ["per_dimension", "joint"])
def test_a_learned_alpha_reaches_the_same_shannon_entropy_at_every_q(q: float, form: str) -> None:
    alpha = {"learned": True, "initial": 0.1, "lr": 3e-2, "target_shannon": -1.0}
    built = learner(entropic_index=q, entropy_form=form, alpha=alpha)
    learn(built, 400)
    assert learn(built, 200)[names.SHANNON_ENTROPY] == pytest.approx(-1.0, abs=0.05)


def test_a_learned_alpha_reaches_a_width() -> None:
    alpha = {"learned": True, "initial": 0.1, "lr": 3e-2, "target_width": 0.2}
    built = learner(entropic_index=2.0, bootstrap="critics", alpha=alpha)
    learn(built, 600)
    policy = built.module[DEFAULT_MODULE_ID].unwrapped()
    _, log_std = policy.policy_parameters(policy.normaliser(torch.ones(1, 1)))
    assert float(log_std.detach().mean().exp()) == pytest.approx(0.2, rel=0.1)


@pytest.mark.parametrize("form", ["per_dimension", "joint"])
def test_a_scaled_alpha_follows_q(form: str) -> None:
    shared = {"entropic_index": RAMP, "entropy_form": form, "total_env_steps": 1_000}
    controls: dict[str, tuple[Any, Callable[[float], float]]] = {
        "matched_width": (0.1, lambda q: matched_alpha(0.3, q, 0.1, ACTIONS, form)),
        "normalised": (True, lambda q: normalised_alpha(0.3, q, ACTIONS, form)),
    }
    for key, (setting, expected) in controls.items():
        built = learner(alpha={"value": 0.3, key: setting}, **shared)
        for env_steps, q in ((0, 1.0), (500, 2.0), (1_000, 3.0), (9_000, 3.0)):
            found = learn(built, 1, env_steps)
            assert found[names.ENTROPIC_INDEX] == pytest.approx(q)
            assert found[names.ALPHA] == pytest.approx(expected(q)), (key, env_steps)
