"""Distribution and networks of TAC, compared with independent computations."""

import math

import numpy as np
import pytest
import torch
from scipy import integrate
from torch import nn

from music_rllib.functional.distribution import bounded_log_std, sample_squashed
from music_rllib.tac.networks import Critics, Perceptron


@pytest.mark.parametrize(("mean", "log_std"), [(0.0, -1.0), (0.8, 0.0), (-1.5, 0.5)])
def test_squashed_density_integrates_to_one(mean: float, log_std: float) -> None:
    def density(action: float) -> float:
        raw = np.arctanh(action)
        noise = torch.tensor([(raw - mean) / np.exp(log_std)], dtype=torch.float64)
        mu, log_sigma = torch.tensor([[mean], [log_std]], dtype=torch.float64)
        sample = sample_squashed(mu, log_sigma, noise)
        assert float(sample.action) == pytest.approx(action, abs=1e-9)
        return float(sample.log_density.exp())

    total, _ = integrate.quad(density, -1 + 1e-12, 1 - 1e-12, limit=400)
    assert total == pytest.approx(1.0, abs=1e-5)


def test_log_density_keeps_its_digits_where_tanh_saturates() -> None:
    mean = torch.tensor([[12.0]], requires_grad=True)
    sample = sample_squashed(mean, torch.zeros(1, 1), torch.zeros(1, 1))
    exact = -0.5 * np.log(2 * np.pi) - 2 * (np.log(2) - 12.0 - np.log1p(np.exp(-24.0)))
    assert float(sample.log_density.detach()) == pytest.approx(exact, rel=1e-6)
    sample.log_density.sum().backward()
    assert mean.grad is not None
    assert float(mean.grad) == pytest.approx(2.0, rel=1e-5)


def as_two_perceptrons(critics: Critics, sizes: list[int]) -> list[Perceptron]:
    copies = []
    for which in range(2):
        copy = Perceptron(sizes[0], sizes[1:], 1, layer_norm=critics.layer_norm)
        linears = [layer for layer in copy if isinstance(layer, nn.Linear)]
        for layer, weight, bias in zip(linears, critics.weights, critics.biases, strict=True):
            layer.weight.data = weight[which].T.clone()
            layer.bias.data = bias[which, 0].clone()
        copies.append(copy)
    return copies


@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("sizes", [[7, 16], [7, 16, 16, 8]])
def test_twin_critics_are_two_separate_perceptrons(sizes: list[int], layer_norm: bool) -> None:
    torch.manual_seed(0)
    critics = Critics(sizes[0], sizes[1:], layer_norm=layer_norm)
    inputs = torch.randn(11, 7, requires_grad=True)
    values = critics(inputs)
    expected = torch.stack(
        [copy(inputs).squeeze(-1) for copy in as_two_perceptrons(critics, sizes)]
    )
    torch.testing.assert_close(values, expected)
    (gradient,) = torch.autograd.grad(values.square().sum(), inputs, retain_graph=True)
    (reference,) = torch.autograd.grad(expected.square().sum(), inputs)
    torch.testing.assert_close(gradient, reference)
    assert not torch.allclose(values[0], values[1])


def test_layer_norm_limits_a_networks_outputs_for_any_input() -> None:
    """At most the last layer's weights times sqrt(H), for any input (RLPD, section 4.2)."""
    torch.manual_seed(0)
    network, inputs = Perceptron(7, [16, 9], 1, layer_norm=True), torch.randn(20, 7)
    last = next(layer for layer in reversed(network) if isinstance(layer, nn.Linear))
    bound = float(last.weight.detach().norm()) * 3 + float(last.bias.detach().abs())
    for scale in (1.0, 1e3, 1e6):
        outputs = network(inputs * scale)
        assert float(outputs.detach().abs().max()) <= bound
        copy = torch.from_numpy(network.in_numpy()((inputs * scale).numpy()))
        torch.testing.assert_close(copy, outputs.detach())


def test_frozen_critics_pass_gradients_to_their_inputs_only() -> None:
    critics = Critics(5, [8, 8])
    inputs = torch.randn(3, 5, requires_grad=True)
    values = critics(inputs, frozen=True)
    torch.testing.assert_close(values, critics(inputs))
    values.sum().backward()
    assert inputs.grad is not None
    assert inputs.grad.abs().sum() > 0
    assert all(parameter.grad is None for parameter in critics.parameters())


@pytest.mark.parametrize(
    ("bounds", "first_std"), [((-20.0, 2.0), 1.234e-4), ((-5.0, 2.0), 0.2231)], ids=str
)
def test_log_std_is_clamped_to_its_bounds_or_scaled_between_them(
    bounds: tuple[float, float], first_std: float
) -> None:
    """TAC-2020 writes -20 + 11 (tanh(x) + 1), the original MUSIC's SAC -5 + 3.5 (tanh(x) + 1)."""
    low, high = bounds
    raw = torch.tensor([-30.0, -1.0, 0.0, 1.0, 30.0], dtype=torch.float64)
    scaled = bounded_log_std(raw, bounds, "tanh")
    half = {-20.0: 11.0, -5.0: 3.5}[low]
    expected = [low + half * (math.tanh(x) + 1) for x in raw.tolist()]
    assert scaled.tolist() == pytest.approx(expected)
    assert math.exp(scaled[2]) == pytest.approx(first_std, rel=1e-3)
    clamped = [max(low, -30.0), -1.0, 0.0, 1.0, high]
    assert bounded_log_std(raw, bounds, "clamp").tolist() == clamped
