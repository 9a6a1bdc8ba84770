"""TAC's losses and gradients in the Learner, compared with SAC written out."""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from ray.rllib.core import DEFAULT_MODULE_ID
from torch import Tensor

from music_rllib import names
from music_rllib.config.tac_settings import TACSettings
from music_rllib.functional.distribution import sample_squashed
from music_rllib.kernels.actor_critic import mean_values
from music_rllib.replay.trajectories import Trajectory
from music_rllib.tac.algorithm import TACConfig
from music_rllib.tac.diagnostics import NonFiniteLossError, of_updates
from music_rllib.tac.learner import TACLearner
from music_rllib.tac.random_state import determinism_without_compiler

OBSERVATION, ACTION, BATCH = 6, 3, 32


def small_learner(
    observations: gym.spaces.Box, actions: int, seed: int, **settings: Any
) -> TACLearner:
    """A learner with small networks for `actions` dimensions of actions."""
    spaces = (observations, gym.spaces.Box(-1.0, 1.0, (actions,)))
    config = TACConfig().debugging(seed=seed)
    config.training(**{"hidden_sizes": (16, 16), "random_steps": 0, **settings})
    config.environment(observation_space=spaces[0], action_space=spaces[1])
    with determinism_without_compiler():
        built: TACLearner = config.build_learner(spaces={DEFAULT_MODULE_ID: spaces})
    return built


def test_fractions_of_quantiles_are_the_middles_of_equal_parts() -> None:
    module = learner(bootstrap="critics", quantiles=4).module[DEFAULT_MODULE_ID].unwrapped()
    assert module.quantile_fractions.tolist() == [0.125, 0.375, 0.625, 0.875]


def learner(**settings: Any) -> TACLearner:
    observations = gym.spaces.Box(-np.inf, np.inf, (OBSERVATION,))
    built = small_learner(observations, ACTION, 3, **{"batch_size": BATCH, **settings})
    built.module[DEFAULT_MODULE_ID].double()
    return built


def minibatch(seed: int = 0) -> dict[str, Tensor]:
    rng = np.random.default_rng(seed)
    batch = {
        "obs": rng.normal(size=(BATCH, OBSERVATION)),
        "new_obs": rng.normal(size=(BATCH, OBSERVATION)),
        "actions": rng.uniform(-1, 1, (BATCH, ACTION)),
        "rewards": rng.normal(size=BATCH),
        "discounts": (rng.random(BATCH) > 0.2).astype(float),
        "noise": rng.normal(size=(BATCH, ACTION)),
    }
    return {name: torch.from_numpy(values) for name, values in batch.items()}


def tac_loss(built: TACLearner, batch: dict[str, Tensor]) -> Tensor:
    forward = built.module[DEFAULT_MODULE_ID].forward_train(batch)
    built._losses, built._observed = {}, {}
    loss: Tensor = built.compute_loss_for_module(
        module_id=DEFAULT_MODULE_ID, config=built.config, batch=batch, fwd_out=forward
    )
    return loss


def gradients(loss: Tensor, module: Any) -> dict[str, Tensor]:
    named = {n: p for n, p in module.named_parameters() if p.requires_grad}
    return dict(zip(named, torch.autograd.grad(loss, list(named.values())), strict=True))


class ReferenceSAC:
    """SAC with a value network (Haarnoja et al. 2018a, eq. 5-13), on copies of the same weights.

    Every loss is computed separately, with torch.distributions' densities and plain matrix
    products, one critic after the other.
    """

    def __init__(self, module: Any, *, alpha: float, gamma: float, critic: str) -> None:
        self.m, self.alpha, self.gamma, self.critic = module, alpha, gamma, critic

    def normalise(self, x: Tensor) -> Tensor:
        n = self.m.normaliser
        normalised: Tensor = ((x - n.mean) * n.inverse_std).clamp(-n.clip, n.clip)
        return normalised

    def q(self, which: int, x: Tensor, a: Tensor) -> Tensor:
        h = torch.cat([x, a], -1)
        last = len(self.m.critics.weights) - 1
        for i, (w, b) in enumerate(zip(self.m.critics.weights, self.m.critics.biases, strict=True)):
            h = h @ w[which] + b[which]
            h = h if i == last else F.relu(h)
        return h.squeeze(-1)

    def policy(self, x: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_std = self.m.policy(x).chunk(2, -1)
        normal = torch.distributions.Normal(mean, log_std.clamp(-20, 2).exp())
        raw = mean + normal.scale * noise
        action = torch.tanh(raw)
        log_pi = normal.log_prob(raw).sum(-1) - torch.log(1 - action**2).sum(-1)
        return action, log_pi

    def gradients(self, b: dict[str, Tensor]) -> dict[str, Tensor]:
        x, nxt = self.normalise(b["obs"]), self.normalise(b["new_obs"])
        action, log_pi = self.policy(x, b["noise"])
        q1, q2 = self.q(0, x, action), self.q(1, x, action)
        smaller = torch.minimum(q1, q2)
        v_target = (smaller - self.alpha * log_pi).detach()
        v_loss = 0.5 * F.mse_loss(self.m.value(x).squeeze(-1), v_target)
        next_value = self.m.value_target(nxt).squeeze(-1).detach()
        backup = b["rewards"] + self.gamma * b["discounts"] * next_value
        errors = [0.5 * F.mse_loss(self.q(i, x, b["actions"]), backup) for i in range(2)]
        q_loss = errors[0] + errors[1]
        improved = q1 if self.critic == "first" else smaller
        pi_loss = (self.alpha * log_pi - improved).mean()
        self.total = v_loss + q_loss + pi_loss
        found: dict[str, Tensor] = {}
        for prefix, loss in (("policy", pi_loss), ("value", v_loss), ("critics", q_loss)):
            named = {n: p for n, p in self.m.named_parameters() if n.split(".")[0] == prefix}
            grads = torch.autograd.grad(loss, list(named.values()), retain_graph=True)
            found |= dict(zip(named, grads, strict=True))
        return found


@pytest.mark.parametrize("form", ["per_dimension", "joint"])
@pytest.mark.parametrize("critic", ["first", "min"])
def test_at_q_1_tac_is_sac_with_a_value_network(form: str, critic: str) -> None:
    built = learner(entropic_index=1.0, alpha=0.17, entropy_form=form, policy_critic=critic)
    module = built.module[DEFAULT_MODULE_ID]
    module.normaliser.update(torch.randn(50, OBSERVATION) * 3 + 1)
    reference = ReferenceSAC(module, alpha=0.17, gamma=0.99, critic=critic)
    for seed in range(3):
        batch = minibatch(seed)
        loss = tac_loss(built, batch)
        ours, sacs = gradients(loss, module), reference.gradients(batch)
        assert ours.keys() == sacs.keys()
        torch.testing.assert_close(loss, reference.total, rtol=1e-6, atol=1e-6)
        for name, gradient in ours.items():
            torch.testing.assert_close(gradient, sacs[name], rtol=1e-6, atol=1e-6, msg=name)


def test_entropic_index_and_form_change_the_policy_gradient_only_away_from_1() -> None:
    batch = minibatch()

    def policy_gradient(q: float, form: str) -> Tensor:
        built = learner(entropic_index=q, entropy_form=form)
        module = built.module[DEFAULT_MODULE_ID]
        return gradients(tac_loss(built, batch), module)["policy.0.weight"]

    near = policy_gradient(1.0 + 1e-8, "per_dimension")
    torch.testing.assert_close(near, policy_gradient(1.0, "joint"), rtol=1e-5, atol=1e-8)
    assert not torch.allclose(policy_gradient(1.5, "joint"), policy_gradient(1.5, "per_dimension"))
    assert not torch.allclose(policy_gradient(1.5, "joint"), policy_gradient(2.0, "joint"))


@pytest.fixture
def extreme_batches() -> Iterator[dict[str, Tensor]]:
    def batches() -> Iterator[dict[str, Tensor]]:
        for action in (-1.0, 1.0):
            for noise in (-6.0, 0.0, 6.0):
                batch = minibatch()
                batch["actions"][:] = action
                batch["noise"][:] = noise
                yield batch

    return batches()


@pytest.mark.parametrize("q", [0.1, 0.5, 1.0, 2.0, 5.0])
@pytest.mark.parametrize("log_std", [-30.0, -20.0, 2.0])
@pytest.mark.parametrize("form", ["per_dimension", "joint"])
def test_losses_and_gradients_stay_finite_at_every_bound(
    q: float, log_std: float, form: str, extreme_batches: Iterator[dict[str, Tensor]]
) -> None:
    built = learner(entropic_index=q, entropy_form=form)
    module = built.module[DEFAULT_MODULE_ID].float()
    module.policy[-1].bias.data[ACTION:] = log_std
    for batch in extreme_batches:
        loss = tac_loss(built, {name: values.float() for name, values in batch.items()})
        assert torch.isfinite(loss)
        for name, gradient in gradients(loss, module).items():
            assert torch.isfinite(gradient).all(), name


def test_metrics_stay_finite_where_the_losses_do() -> None:
    built = learner(entropic_index=5.0)
    module = built.module[DEFAULT_MODULE_ID].float()
    # The most peaked policy, with a saturated tanh: (q-1) ln p is 110, and e^88 overflows float32.
    module.policy[-1].bias.data[:ACTION], module.policy[-1].bias.data[ACTION:] = 5.0, -20.0
    loss = tac_loss(built, {name: values.float() for name, values in minibatch().items()})
    assert torch.isfinite(loss)
    observed = {name: values[None] for name, values in built._observed.items()}
    metrics = of_updates(observed, built._settings, 5.0)
    assert float(metrics[names.CLIPPED_DENSITIES]) == 1.0
    for name, value in (metrics | built._losses).items():
        assert torch.isfinite(value), name


@pytest.mark.parametrize(("low", "high"), [(-50.0, 50.0), (-4 / 0.03, 4 / 0.03), (-16.7, 0.0)])
def test_a_target_whose_atoms_are_all_at_a_bound_counts_as_clipped(low: float, high: float) -> None:
    settings = TACSettings(
        bootstrap="critics", critics=5, quantiles=25, dropped_quantiles=2, target_bounds=(low, high)
    )
    atoms = np.full((8, 5 * 23), low, np.float32)
    targets = torch.from_numpy(mean_values(atoms[None]))
    observed = {"q_values": torch.zeros(1, 5, 8), "targets": targets}
    assert float(of_updates(observed, settings, 1.0)[names.CLIPPED_TARGETS]) == 1.0


def test_a_distant_bound_does_not_widen_the_other_one() -> None:
    settings = TACSettings(
        bootstrap="critics", critics=5, quantiles=25, dropped_quantiles=2, target_bounds=(-1e6, 0.0)
    )
    observed = {"q_values": torch.zeros(1, 5, 8), "targets": torch.full((1, 8), -5.0)}
    assert float(of_updates(observed, settings, 1.0)[names.CLIPPED_TARGETS]) == 0.0


def test_a_loss_that_is_not_finite_stops_the_run_and_names_network_and_update() -> None:
    built = learner()
    batch = minibatch()
    batch["rewards"][3] = float("nan")
    module = built.module[DEFAULT_MODULE_ID].float()
    assert module is not None
    columns = {name: values.float().numpy() for name, values in batch.items() if name != "noise"}
    from ray.rllib.policy.sample_batch import MultiAgentBatch, SampleBatch

    data = MultiAgentBatch({DEFAULT_MODULE_ID: SampleBatch(columns)}, env_steps=BATCH)
    with pytest.raises(NonFiniteLossError, match=r"loss/critics not finite at gradient update 1 "):
        built.update(data)


def test_learned_alpha_moves_towards_the_target_entropy() -> None:
    for target, direction in ((50.0, 1), (-50.0, -1)):
        alpha = {"learned": True, "initial": 0.2, "target_entropy": target}
        built = learner(alpha=alpha)
        module = built.module[DEFAULT_MODULE_ID]
        gradient = gradients(tac_loss(built, minibatch()), module)["log_alpha"]
        assert float(-gradient) * direction > 0


def test_automatic_target_entropy_is_sacs_at_q_1() -> None:
    assert learner(alpha={"learned": True})._objective._target_entropy == pytest.approx(-ACTION)
    at_2 = learner(alpha={"learned": True}, entropic_index=2.0)._objective._target_entropy
    assert at_2 == pytest.approx(-ACTION * (np.e - 1))


@pytest.mark.parametrize("policy", ["stochastic", "deterministic"])
def test_action_l2_penalises_the_squashed_action(policy: str) -> None:
    """d tanh(u)^2 / du = 2 tanh(u) (1 - tanh(u)^2), computed by hand below."""
    ddpg = {"bootstrap": "critics", "alpha": 0.0, "behaviour": {"kind": "gaussian_noise"}}
    settings: dict[str, Any] = ddpg if policy == "deterministic" else {"alpha": 0.0}
    built = learner(policy=policy, action_l2=1.0, policy_critic="first", **settings)
    module = built.module[DEFAULT_MODULE_ID].float()
    for parameter in module.parameters():
        parameter.data.zero_()
    rows = 4
    batch = {
        name: values[:1].repeat(rows, 1).float()
        for name, values in minibatch().items()
        if values.ndim == 2
    }
    batch |= {"rewards": torch.zeros(rows), "discounts": torch.ones(rows)}
    for mean, noise, expected in (
        (0.0, 0.0, 0.0),
        (0.5, 0.0, 0.72686),
        (2.0, 0.0, 0.13622),
        (-1.0, 0.0, -0.63970),
        (1.5, 0.5, 0.13622),
    ):
        if policy == "deterministic":
            mean, noise = mean + noise, 0.0
        module.policy[-1].bias.data[:ACTION] = mean
        batch["noise"][:] = noise
        gradient = gradients(tac_loss(built, batch), module)["policy.4.bias"][:ACTION]
        torch.testing.assert_close(
            gradient, torch.full((ACTION,), expected / ACTION), atol=1e-5, rtol=0
        )


@pytest.mark.parametrize("n_steps", [1, 3, 5])
def test_exact_critics_of_n_step_targets_have_no_bias(n_steps: int) -> None:
    """Rewards of 0: Q = gamma^n (alpha S + Q), with the entropy S of a constant policy."""
    gamma, alpha, steps = 0.95, 0.05, 50
    built = small_learner(
        gym.spaces.Box(-np.inf, np.inf, (3,)), 4, 0, gamma=gamma, alpha=alpha, bootstrap="critics"
    )
    built.config.replay(n_steps=n_steps)
    module = built._policy_module
    for parameter in module.parameters():
        parameter.data.zero_()
    noise = torch.randn(100_000, 4, generator=torch.Generator().manual_seed(0))
    zeros = torch.zeros(1)
    entropy = -float(sample_squashed(zeros, zeros, noise).log_density.sum(-1).mean())
    exact = gamma**n_steps * alpha * entropy / (1.0 - gamma**n_steps)
    for critics in (module.critics, module.critics_target):
        critics.biases[-1].data.fill_(exact)
    frames, actions = np.zeros((steps + 1, 3), np.float32), np.zeros((steps, 4), np.float32)
    episode = Trajectory(frames, actions, np.zeros(steps, np.float32), terminated=False)
    built.metrics.reduce()
    built.diagnose([episode] * 40, None)
    logged = built.metrics.peek((DEFAULT_MODULE_ID, names.Q_BIAS))
    assert logged == pytest.approx(0.0, abs=0.1)
