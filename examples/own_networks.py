"""Train TAC with networks of your own: layer normalization and SiLU instead of ReLU."""

import torch
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from torch import nn

from music_rllib import TACConfig, TACModule


def network(inputs, width, outputs):
    """[B, inputs] -> [B, outputs]: an encoder of `width` features and a linear layer."""
    encoder = nn.Linear(inputs, width), nn.LayerNorm(width), nn.SiLU(), nn.Linear(width, width)
    return nn.Sequential(*encoder, nn.SiLU(), nn.Linear(width, outputs))


class TwinCritics(nn.ModuleList):
    """[B, inputs] -> [2, B]; if frozen, gradients reach only the inputs."""

    def forward(self, inputs, *, frozen=False):
        weights = [{n: p.detach() if frozen else p for n, p in c.named_parameters()} for c in self]
        values = map(torch.func.functional_call, self, weights, 2 * [inputs])
        return torch.cat(list(values), dim=-1).T


class OwnNetworks(TACModule):
    """TAC with the networks above."""

    def setup(self):
        super().setup()
        inputs, actions, width = self.input_size, self.action_size, self.model_config["width"]
        self.policy = network(inputs, width, 2 * actions)  # means and raw log standard deviations
        self.value = network(inputs, width, 1)
        self.critics = TwinCritics(network(inputs + actions, width, 1) for _ in range(2))
        self.make_target_networks()


spec = RLModuleSpec(module_class=OwnNetworks, model_config={"width": 32})
config = TACConfig().environment("Pendulum-v1").rl_module(rl_module_spec=spec)
algo = config.training(lr=2e-3, replay_ratio=0.5, alpha=0.2).debugging(seed=0).build_algo()
print([round(algo.train()["env_runners"]["episode_return_mean"]) for _ in range(6)])
