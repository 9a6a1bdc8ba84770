"""A compiled step has the numbers and the state of `torch.optim.Adam`."""

from __future__ import annotations

import io

import pytest
import torch

from music_rllib.kernels.adam import FlatParameters, FusedAdam, adam_step

SHAPES = [(7, 5), (5,), (2, 3, 4), ()]


def saved(state: dict[str, object]) -> dict[str, object]:
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    loaded: dict[str, object] = torch.load(file, weights_only=True)
    return loaded


@pytest.mark.parametrize("steps_before", [0, 3])
def test_compiled_and_plain_steps_continue_each_other(steps_before: int) -> None:
    """Plain steps, compiled ones with a checkpoint and another learning rate, plain steps again."""
    generator = torch.Generator().manual_seed(0)
    starts = [torch.randn(shape, generator=generator) for shape in SHAPES]
    theirs, ours = ([start.clone().requires_grad_() for start in starts] for _ in range(2))
    adam, fused = torch.optim.Adam(theirs, lr=1e-2, fused=True), FusedAdam(ours, lr=1e-2)
    flat: FlatParameters | None = None
    for step in range(steps_before + 8):
        for a, b in zip(theirs, ours, strict=True):
            a.grad = torch.randn(a.shape, generator=generator)
            b.grad = a.grad.clone()
        compiled = steps_before <= step < steps_before + 6
        if step == steps_before + 2:
            fused.load_state_dict(saved(fused.state_dict()))
        if step == steps_before + 4:
            for optimizer in (adam, fused):
                optimizer.param_groups[0]["lr"] = 3e-3
        adam.step()
        if compiled:
            flat = flat or FlatParameters(ours)
            for b in ours:
                assert b.grad is not None
                flat.view(flat.gradients, b).copy_(b.grad)
            adam_step(fused.step_of(flat))
        else:
            fused.step()
        expected, found = adam.state_dict()["state"], fused.state_dict()["state"]
        assert expected.keys() == found.keys()
        for i, (a, b) in enumerate(zip(theirs, ours, strict=True)):
            torch.testing.assert_close(b, a, rtol=1e-6, atol=1e-7)
            assert list(expected[i]) == list(found[i])
            for name, values in expected[i].items():
                torch.testing.assert_close(found[i][name], values, rtol=1e-6, atol=1e-7)
