"""Use TAC as any RLlib algorithm: configure, train, save, restore."""

import sys
from tempfile import TemporaryDirectory

from music_rllib import TAC, TACConfig

STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 5_000

config = (
    TACConfig()
    .environment("Pendulum-v1")
    .env_runners(num_envs_per_env_runner=4)
    .training(entropic_index=1.5, alpha=0.2, lr=1e-3, replay_ratio=0.5, hidden_sizes=[64, 64])
    .debugging(seed=0)
)
algo = config.build_algo()
steps = 0
while steps < STEPS:
    result = algo.train()
    steps = result["num_env_steps_sampled_lifetime"]
    print(f"{steps:6,.0f} steps: return {result['env_runners']['episode_return_mean']:.0f}")

with TemporaryDirectory() as folder:
    algo.save_to_path(folder)
    algo.stop()
    restored = TAC.from_checkpoint(folder)  # continues exactly where `algo` stopped
    print(f"restored: {restored.train()['num_env_steps_sampled_lifetime']:,.0f} steps")
