"""One training program in a process of its own: `python -m benchmarks.peer NAME WIDTH RATIO`.

WIDTH is the width of its three hidden layers, RATIO its updates per environment step (1 or 0.4).
Reads a number of seconds per line from its input, trains for at least this time, and prints one
line of JSON: the environment steps and the elapsed seconds.
"""

from __future__ import annotations

import functools
import importlib
import json
import sys
import time
from collections.abc import Callable
from typing import Any

from music_rllib.runtime.quiet import prepare_environment, quiet_third_parties

__all__ = ["PEERS"]

ENV_ID = "FetchPush-v4"
WARM_UP = 1_000
BATCH = 256
ENVIRONMENTS = 4
"""Sub-environments of the programs that are faster with several."""
OWN_TQC: dict[str, Any] = {
    "bootstrap": "critics",
    "policy_critic": "mean",
    "quantiles": 25,
    "dropped_quantiles": 2,
}
"""Settings of TQC, with two critics like the default of both other libraries."""


def ours(width: int, ratio: float, *, tqc: bool = False) -> Callable[[], int]:
    """TAC with HER at q = 1 (SAC); `tqc`: with its critics of quantiles."""
    from music_rllib import TACConfig

    config = TACConfig().environment(ENV_ID)
    config.env_runners(num_envs_per_env_runner=ENVIRONMENTS)
    config.training(
        random_steps=WARM_UP, hidden_sizes=[width] * 3, batch_size=BATCH, replay_ratio=ratio,
        **(OWN_TQC if tqc else {}),
    )  # fmt: skip
    config.replay(hindsight_k=4.0).reporting(min_sample_timesteps_per_iteration=1)
    config.debugging(seed=0)
    algo = config.build_algo()

    def some_more() -> int:
        algo.train()
        return int(algo.env_steps)

    return some_more


def rllib_sac(width: int, ratio: float, *, plain: bool = True) -> Callable[[], int]:
    """RLlib's SAC, without hindsight (it has none); not `plain`: with its default networks."""
    import gymnasium as gym
    from ray.rllib.algorithms.sac import SACConfig
    from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
    from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, NUM_ENV_STEPS_SAMPLED_LIFETIME
    from ray.tune.registry import register_env

    from music_rllib.envs.make import make_env

    def flat(_: Any) -> gym.Env[Any, Any]:
        make_env(ENV_ID).close()  # registers the robotics tasks
        env = gym.make(ENV_ID)
        kept: Any = gym.wrappers.FilterObservation(env, ["observation", "desired_goal"])
        return gym.wrappers.FlattenObservation(kept)

    register_env("flat-push", flat)
    env_steps, updates = OFTEN[ratio]
    config = SACConfig().environment("flat-push")
    config.env_runners(num_env_runners=0, rollout_fragment_length=env_steps)
    config.training(
        train_batch_size_per_learner=BATCH,
        training_intensity=BATCH * updates / env_steps,
        num_steps_sampled_before_learning_starts=WARM_UP,
        initial_alpha=0.05,
    )
    if plain:
        model = DefaultModelConfig(
            fcnet_hiddens=[width] * 3, fcnet_activation="relu", head_fcnet_hiddens=[]
        )
        config.rl_module(model_config=model)
    config.reporting(min_sample_timesteps_per_iteration=20, min_time_s_per_iteration=0)
    config.debugging(seed=0)
    algo = config.build_algo()

    def some_more() -> int:
        result = algo.train()
        return int(result[ENV_RUNNER_RESULTS][NUM_ENV_STEPS_SAMPLED_LIFETIME])

    return some_more


def sb3(width: int, ratio: float, *, algorithm: str) -> Callable[[], int]:
    """SAC of Stable-Baselines3 or TQC of its contributions, with its HerReplayBuffer."""
    import gymnasium as gym
    from stable_baselines3 import HerReplayBuffer

    from music_rllib.envs.make import make_env

    make_env(ENV_ID).close()  # registers the robotics tasks
    train_freq, gradient_steps = OFTEN[ratio]
    library = {"SAC": "stable_baselines3", "TQC": "sb3_contrib"}[algorithm]
    model = getattr(importlib.import_module(library), algorithm)(
        "MultiInputPolicy",
        gym.make(ENV_ID),
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        batch_size=BATCH,
        learning_starts=WARM_UP,
        train_freq=train_freq,
        gradient_steps=gradient_steps,
        ent_coef=0.05,
        policy_kwargs={"net_arch": [width] * 3},
        seed=0,
        device="cpu",
    )

    def some_more() -> int:
        model.learn(50, reset_num_timesteps=False)
        return int(model.num_timesteps)

    return some_more


def sbx(width: int, ratio: float, *, algorithm: str) -> Callable[[], int]:
    """SAC or TQC with HerReplayBuffer of SBX, which is Stable-Baselines3 in JAX.

    It compiles all updates of a call into one, so a call has those of four episodes, as ours does.
    """
    import gymnasium as gym
    from stable_baselines3 import HerReplayBuffer
    from stable_baselines3.common.vec_env import DummyVecEnv

    from music_rllib.envs.make import make_env

    make_env(ENV_ID).close()  # registers the robotics tasks
    steps = ENVIRONMENTS * 50
    model = getattr(importlib.import_module("sbx"), algorithm)(
        "MultiInputPolicy",
        DummyVecEnv([functools.partial(gym.make, ENV_ID)] * ENVIRONMENTS),
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        batch_size=BATCH,
        learning_starts=WARM_UP,
        train_freq=(50, "step"),
        gradient_steps=round(steps * ratio),
        ent_coef=0.05,
        policy_kwargs={"net_arch": [width] * 3},
        seed=0,
    )

    def some_more() -> int:
        model.learn(steps, reset_num_timesteps=False)
        return int(model.num_timesteps)

    return some_more


OFTEN = {1.0: (1, 1), 0.4: (5, 2)}
"""By replay ratio: environment steps and updates per call."""
PEERS: dict[str, Callable[[int, float], Callable[[], int]]] = {
    "ours": ours,
    "RLlib SAC": functools.partial(rllib_sac, plain=False),
    "RLlib SAC, same networks": rllib_sac,
    "SB3 SAC+HER": functools.partial(sb3, algorithm="SAC"),
    "SBX SAC+HER": functools.partial(sbx, algorithm="SAC"),
    "ours, TQC": functools.partial(ours, tqc=True),
    "SB3 TQC+HER": functools.partial(sb3, algorithm="TQC"),
    "SBX TQC+HER": functools.partial(sbx, algorithm="TQC"),
}


def main() -> None:
    """Warm up until training has started, then serve turns."""
    prepare_environment()
    answers, sys.stdout = sys.stdout, sys.stderr
    import torch

    torch.set_num_threads(1)
    name, width, ratio = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
    if not name.startswith("SB"):
        from benchmarks.measure import start_ray

        start_ray(1)
    quiet_third_parties()
    train = PEERS[name](width, ratio)
    while (steps := train()) < WARM_UP + 50:
        pass
    print(json.dumps({"ready": steps}), file=answers, flush=True)
    for line in sys.stdin:
        first, begin = steps, time.perf_counter()
        while time.perf_counter() - begin < float(line):
            steps = train()
        taken = time.perf_counter() - begin
        print(json.dumps({"steps": steps - first, "seconds": taken}), file=answers, flush=True)


if __name__ == "__main__":
    main()
