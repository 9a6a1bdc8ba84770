"""The loss of quantile critics (QR-DQN), and the atoms that TQC drops."""

from __future__ import annotations

import torch

from music_rllib.functional.actor_critic import quantile_loss, smallest_atoms


def test_the_quantile_loss_is_smallest_at_the_quantiles() -> None:
    """Its Huber part is narrow beside targets of 0 to 1,000."""
    target = torch.linspace(0, 1000, 2001, dtype=torch.float64)[None]
    fractions = torch.tensor([0.125, 0.375, 0.625, 0.875], dtype=torch.float64)
    for off in (-20.0, 20.0):
        quantiles = (1000 * fractions + off)[None, None].requires_grad_()
        (gradient,) = torch.autograd.grad(quantile_loss(quantiles, fractions, target), quantiles)
        assert (gradient * off > 0).all()
    once, twice = (
        quantile_loss(torch.zeros(1, 1, 1), torch.tensor([0.25]), torch.tensor([[4.0]]), weights)
        for weights in (None, torch.tensor([2.0]))
    )
    assert (float(once), float(twice)) == (0.25 * 3.5, 2 * 0.25 * 3.5)


def test_the_largest_atoms_of_all_critics_are_dropped() -> None:
    quantiles = torch.tensor([[[1.0, 9.0, 5.0]], [[4.0, 8.0, 7.0]]])
    assert smallest_atoms(quantiles, 1).tolist() == [[1.0, 4.0, 5.0, 7.0]]
