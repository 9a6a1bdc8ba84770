"""FusedAdam has the numbers and the state of `torch.optim.Adam`."""

from __future__ import annotations

import copy
import io
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from music_rllib.kernels.adam import FlatParameters, FusedAdam, adam_step

SHAPES = [(7, 5), (5,), (2, 3, 4), ()]
STEPS = 6


class Training:
    """Two sets of parameters that get the same gradients: one for Torch's Adam, one for ours."""

    def __init__(self) -> None:
        generator = torch.Generator().manual_seed(0)
        starts = [torch.randn(shape, generator=generator) for shape in SHAPES]
        self.generator = generator
        self.theirs = [start.clone().requires_grad_() for start in starts]
        self.ours = [start.clone().requires_grad_() for start in starts]
        self.adam = torch.optim.Adam(self.theirs, lr=1e-2, fused=True)
        self.fused = FusedAdam(self.ours, lr=1e-2)

    def step(self, *, without: int | None = None) -> None:
        self.adam.zero_grad()
        self.fused.zero_grad()
        for i, (a, b) in enumerate(zip(self.theirs, self.ours, strict=True)):
            gradient = torch.randn(a.shape, generator=self.generator)
            if i != without:
                a.grad, b.grad = gradient, gradient.clone()
        self.adam.step()
        self.fused.step()

    def check(self) -> None:
        for a, b in zip(self.theirs, self.ours, strict=True):
            assert torch.equal(a, b)
        theirs, ours = self.adam.state_dict()["state"], self.fused.state_dict()["state"]
        assert theirs.keys() == ours.keys()
        for i, state in theirs.items():
            assert state.keys() == ours[i].keys()
            for name, values in state.items():
                assert torch.equal(values, ours[i][name]), (i, name)
                assert values.shape == ours[i][name].shape


def test_every_step_has_the_bits_of_adam() -> None:
    training = Training()
    for _ in range(STEPS):
        training.step()
        training.check()


@pytest.mark.parametrize("first", [0, 3])
def test_a_parameter_without_gradient_stays_as_it_is(first: int) -> None:
    training = Training()
    for i in range(STEPS):
        training.step(without=1 if first <= i < first + 2 else None)
        training.check()


def test_the_learning_rate_can_change() -> None:
    training = Training()
    for i in range(STEPS):
        for optimizer in (training.adam, training.fused):
            optimizer.param_groups[0]["lr"] = 1e-2 / (i + 1)
        training.step()
        training.check()


def deep_copied(state: dict[str, object]) -> dict[str, object]:
    return copy.deepcopy(state)


def saved(state: dict[str, object]) -> dict[str, object]:
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    loaded: dict[str, object] = torch.load(file, weights_only=True)
    return loaded


@pytest.mark.parametrize("carried", [deep_copied, saved])
@pytest.mark.parametrize("behind", [0, 1, 4])
def test_it_continues_from_a_loaded_state(carried: Callable[..., dict[str, object]], behind: int) -> None:
    training = Training()
    for _ in range(behind):
        training.step()
    states = carried(training.adam.state_dict()), carried(training.fused.state_dict())
    weights = [parameter.detach().clone() for parameter in training.ours]
    for _ in range(3):
        training.step()  # what is loaded has to replace what these leave behind
    for parameters in (training.theirs, training.ours):
        put_back(parameters, weights)
    training.adam.load_state_dict(states[1])
    training.fused.load_state_dict(states[0])
    for _ in range(3):
        training.step()
        training.check()


@torch.no_grad()
def put_back(parameters: list[Tensor], weights: list[Tensor]) -> None:
    for parameter, weight in zip(parameters, weights, strict=True):
        parameter.copy_(weight)


def test_gradients_are_forgotten_or_made_zero() -> None:
    training = Training()
    training.step()
    training.fused.zero_grad(set_to_none=False)
    assert all(parameter.grad is not None for parameter in training.ours)
    assert not any(parameter.grad.any() for parameter in training.ours)  # type: ignore[union-attr]
    training.fused.zero_grad()
    assert all(parameter.grad is None for parameter in training.ours)


@pytest.mark.parametrize("behind", [0, 3])
def test_a_compiled_step_has_the_numbers_and_the_state_of_adam(behind: int) -> None:
    training = Training()
    for _ in range(behind):
        training.step()
    if behind:
        training.fused.load_state_dict(saved(training.fused.state_dict()))
    flat = FlatParameters(training.ours)
    for step in range(STEPS):
        if step == 2:  # a checkpoint in between is taken over
            training.fused.load_state_dict(saved(training.fused.state_dict()))
        training.adam.zero_grad()
        for a, b in zip(training.theirs, training.ours, strict=True):
            a.grad = torch.randn(a.shape, generator=training.generator)
            flat.gradient(b).copy_(a.grad)
        training.adam.step()
        adam_step(training.fused.step_of(flat))
        theirs, ours = training.adam.state_dict()["state"], training.fused.state_dict()["state"]
        assert theirs.keys() == ours.keys()
        for i, (a, b) in enumerate(zip(training.theirs, training.ours, strict=True)):
            torch.testing.assert_close(b, a, rtol=1e-6, atol=1e-7)
            assert list(theirs[i]) == list(ours[i])
            for name, values in theirs[i].items():
                torch.testing.assert_close(ours[i][name], values, rtol=1e-6, atol=1e-7)
