"""The fused perceptron against the same layers one by one, in float64.

oneDNN computes it on every CPU; where there is no AVX-512 it just is not taken.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from music_rllib.tac import fused
from music_rllib.tac.networks import Critics, Perceptron

INPUTS, ROWS = 31, 96


def networks(hidden: list[int]) -> dict[str, nn.Module]:
    torch.manual_seed(0)
    return {
        "policy": Perceptron(INPUTS, hidden, 8),
        "policy of a hand": Perceptron(INPUTS, hidden, 40),
        "value": Perceptron(INPUTS, hidden, 1),
        "twin critics": Critics(INPUTS, hidden),
        "a single critic": Critics(INPUTS, hidden, 1),
    }


def with_gradients(network: nn.Module, inputs: Tensor, **kwargs: bool) -> dict[str, Tensor]:
    """Output, and gradients of its sum, which all are the same number, and a curved function."""
    inputs = inputs.clone().requires_grad_(True)
    network.zero_grad(set_to_none=True)
    output = network(inputs, **kwargs)
    output.sum().backward(retain_graph=True)
    (output * output.detach().cos()).sum().backward()
    grads = {name: p.grad for name, p in network.named_parameters() if p.grad is not None}
    return {"output": output.detach(), "inputs": inputs.grad, **grads}


pytestmark = pytest.mark.filterwarnings("error")


def with_onednn(test: Any) -> Any:
    """For several sizes, on a CPU of any kind."""
    return pytest.mark.parametrize("hidden", [[128, 128, 128], [64], [17, 200]], ids=str)(
        pytest.mark.usefixtures("onednn")(test)
    )


@pytest.fixture
def onednn(monkeypatch: pytest.MonkeyPatch) -> None:
    if fused._linear_pointwise is None:
        pytest.skip("this build of PyTorch has no oneDNN")
    monkeypatch.setattr(fused, "_has_onednn", lambda: True)


@with_onednn
@pytest.mark.parametrize("frozen", [False, True])
def test_same_values_and_gradients_as_layer_by_layer(hidden: list[int], frozen: bool) -> None:
    inputs = torch.randn(ROWS, INPUTS)
    for name, network in networks(hidden).items():
        only_critics = {"frozen": frozen} if isinstance(network, Critics) else {}
        found = with_gradients(network, inputs, **only_critics)
        exact = with_gradients(network.double(), inputs.double(), **only_critics)
        assert found.keys() == exact.keys(), name
        assert len(found) == 2 if only_critics.get("frozen") else len(found) > 3
        for part, values in found.items():
            scale = float(exact[part].abs().max())
            torch.testing.assert_close(
                values.double(), exact[part], rtol=0, atol=3e-6 * scale, msg=f"{name}: {part}"
            )


@with_onednn
@pytest.mark.parametrize("count", [1, 2])
def test_critics_learn_from_one_minibatch_and_are_asked_about_another(
    hidden: list[int], count: int
) -> None:
    def gradients(critics: Critics, *, together: bool) -> tuple[Tensor, ...]:
        both = torch.randn(2, ROWS, INPUTS, generator=torch.Generator().manual_seed(1))
        learned, asked = both[0], both[1].requires_grad_(True)
        if together:
            values, answers = critics.learn_and_ask(learned, asked)
        else:
            values, answers = critics(learned), critics(asked, frozen=True)
        loss = values.square().sum() + answers.amin(0).sum()
        return values, answers, *torch.autograd.grad(loss, [asked, *critics.parameters()])

    torch.manual_seed(0)
    critics = Critics(INPUTS, hidden, count)
    for one, two in zip(
        gradients(critics, together=True), gradients(critics, together=False), strict=True
    ):
        torch.testing.assert_close(one, two, rtol=0, atol=3e-6 * float(two.detach().abs().max()))


@with_onednn
def test_the_same_bits_each_time_and_wherever_the_numbers_lie(hidden: list[int]) -> None:
    memory = torch.randn(ROWS * INPUTS + 64)
    for network in networks(hidden).values():
        places = [memory[o : o + ROWS * INPUTS].view(ROWS, INPUTS) for o in (0, 1, 3, 16)]
        inputs = places[0].clone()
        first = with_gradients(network, inputs)
        for place in places:
            place.copy_(inputs)
            again = with_gradients(network, place)
            assert all(torch.equal(again[part], values) for part, values in first.items())


@with_onednn
def test_only_what_learns_has_gradients(hidden: list[int]) -> None:
    inputs = torch.randn(ROWS, INPUTS)
    for network in networks(hidden).values():
        network.requires_grad_(False)
        assert not network(inputs).requires_grad
        assert with_gradients(network, inputs).keys() == {"output", "inputs"}


def test_few_rows_and_other_types_go_layer_by_layer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(fused, "_has_onednn", lambda: True)
    assert fused.is_fused(torch.zeros(fused.FEWEST_ROWS, 3))
    assert not fused.is_fused(torch.zeros(fused.FEWEST_ROWS - 1, 3))
    assert not fused.is_fused(torch.zeros(ROWS, 3, dtype=torch.float64))
    assert not fused.is_fused(torch.zeros(2, ROWS, 3))


def test_a_machine_without_avx512_has_no_use_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for flags in (frozenset(), frozenset({"avx2"})):
        monkeypatch.setattr(fused, "cpu_flags", lambda flags=flags: flags)
        assert not fused._has_onednn.__wrapped__()
    monkeypatch.setattr(fused, "_has_onednn", lambda: False)
    assert not fused.is_fused(torch.zeros(ROWS, 3))
