"""A user's own networks are checked before they are trained."""

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from torch import Tensor, nn

from music_rllib.config.tac_settings import TACSettings
from music_rllib.tac.networks import Critics
from music_rllib.tac.rl_module import TACModule


class Stacked(nn.ModuleList):
    """Critics as a user may write them: `shape` is that of their outputs for B rows."""

    def __init__(self, shape: str, *, frozen: str = "detach") -> None:
        super().__init__(nn.Linear(7, 1) for _ in range(2))
        self._shape, self._frozen = shape, frozen

    def forward(self, inputs: Tensor, *, frozen: bool = False) -> Tensor:
        weights: list[Tensor] = [each.get_parameter("weight") for each in self]
        if frozen and self._frozen != "ignored":
            weights = [each.detach() for each in weights]
        if frozen and self._frozen == "no_grad":
            inputs = inputs.detach()
        stacked = torch.stack([inputs @ each.T for each in weights])  # [C, B, 1]
        return {"C B": stacked.squeeze(-1), "C B 1": stacked, "B C": stacked[..., 0].T}[self._shape]


def made(name: str, network: Any, **settings: Any) -> TACModule:
    class Own(TACModule):
        def setup(self) -> None:
            super().setup()
            setattr(self, name, network)
            self.make_target_networks()

    spaces = Box(-1, 1, (5,), np.float32), Box(-1, 1, (2,), np.float32)
    config = {"tac": TACSettings(hidden_sizes=(4,), **settings)}
    return Own(observation_space=spaces[0], action_space=spaces[1], model_config=config)


@pytest.mark.parametrize(
    ("name", "network", "message"),
    [
        ("critics", Stacked("C B 1"), r"critics must return the shape \[2, 3\] .* got \[2, 3, 1\]"),
        ("critics", Stacked("B C"), r"critics must return the shape \[2, 3\] .* got \[3, 2\]"),
        ("critics", Stacked("C B", frozen="ignored"), "critics with frozen=True must give"),
        ("critics", Stacked("C B", frozen="no_grad"), "critics with frozen=True must give"),
        ("policy", nn.Linear(5, 2), r"policy must return the shape \[3, 4\] .* got \[3, 2\]"),
        ("value", nn.Linear(5, 2), r"value must return the shape \[3, 1\]"),
    ],
)
def test_networks_that_would_broadcast_are_refused(name: str, network: Any, message: str) -> None:
    """The losses of all of them could be computed, and would be wrong without an error."""
    with pytest.raises(ValueError, match=f"Own.{message}"):
        made(name, network)


@pytest.mark.parametrize(
    ("name", "network", "settings"),
    [
        ("critics", Stacked("C B"), {}),
        ("critics", Stacked("C B").requires_grad_(False), {}),
        ("policy", nn.Linear(5, 2), {"policy": "deterministic", "bootstrap": "critics",
                                     "alpha": 0.0, "behaviour": {"kind": "gaussian_noise"}}),
        ("critics", Critics(7, (4,), 3, layer_norm=True, quantiles=5),
         {"bootstrap": "critics", "critics": 3, "quantiles": 5, "policy_critic": "mean"}),
    ],
)  # fmt: skip
def test_other_networks_are_accepted(name: str, network: Any, settings: dict[str, Any]) -> None:
    with torch.no_grad():  # as if an environment's module had disabled gradients
        assert getattr(made(name, network, **settings), name) is network
