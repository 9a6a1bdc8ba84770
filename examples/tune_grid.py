"""Compare entropic indices with Ray Tune alone: a grid of q and two seeds, 1 CPU a trial."""

import sys

from ray import tune

from music_rllib import TACConfig

STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 4_000

config = (
    TACConfig()
    .environment("Pendulum-v1")
    .env_runners(num_envs_per_env_runner=4)
    .training(entropic_index=tune.grid_search([1.0, 1.5, 2.0]), lr=1e-3, hidden_sizes=[64, 64])
    .debugging(seed=tune.grid_search([0, 1]))
)
tuner = tune.Tuner(
    config.algo_class,
    param_space=config,
    run_config=tune.RunConfig(stop={"num_env_steps_sampled_lifetime": STEPS}, verbose=0),
)
results = tuner.fit().get_dataframe()
returns = results.groupby("config/entropic_index")["env_runners/episode_return_mean"]
print(returns.agg(["mean", "min", "max"]).round(0))
