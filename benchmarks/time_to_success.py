"""CPU seconds of training until a policy succeeds in 90% of FetchPush's episodes.

`python -m benchmarks.time_to_success NAME SEED SECONDS` trains one program once. It stops when 90%
of 50 evaluation episodes succeed, or after SECONDS of CPU time. Evaluations are not counted.
"""

from __future__ import annotations

import functools
import importlib
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import Row, ratio_row, told_turns
from benchmarks.peer import ENV_ID
from benchmarks.whole_training import is_installed

__all__ = ["PROGRAMS", "rows"]

SUCCESS, EPISODES, EVERY = 0.9, 50, 2_500
LONGEST = 1_200.0
"""Limit of CPU seconds for ours."""
FACTOR = 5.0
"""Limit of the others, as a multiple of the CPU seconds of ours."""


def rows(repeats: int) -> Iterator[Row]:
    """Ours against others with hindsight, for `repeats` seeds."""
    if not (is_installed("sbx") and is_installed("sb3_contrib")):
        return
    others = [name for name in PROGRAMS if name != "ours"]
    ratios: dict[str, list[float]] = {name: [] for name in others}
    notes: dict[str, list[str]] = {name: [] for name in others}
    own = []
    for seed in told_turns(repeats):
        ours = _trained("ours", seed, LONGEST)
        print(f"  ours: {ours}", file=sys.stderr, flush=True)
        own.append(ours["seconds"] if ours["success"] >= SUCCESS else math.inf)
        for name in others:
            found = _trained(name, seed, FACTOR * ours["seconds"])
            print(f"  {name}: {found}", file=sys.stderr, flush=True)
            ratios[name].append(found["seconds"] / own[-1])
            notes[name].append(f"{found['success']:.0%} after {found['steps']:,} steps")
    for name in others:
        yield ratio_row(
            "time to success", f"{ENV_ID}, 90%", float(np.median(own)), "CPU s",
            against=f"{name}, stopped at {FACTOR:g} x: {'; '.join(notes[name])}",
            ratios=ratios[name], at_least=FACTOR,
        )  # fmt: skip


def _trained(name: str, seed: int, seconds: float) -> dict[str, Any]:
    """CPU seconds, environment steps and last success rate of a training."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.time_to_success", name, str(seed), str(seconds)],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, check=True,
        env=os.environ | {
            "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1",
            "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
        },
    )  # fmt: skip
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


SWEEP = """
name: bench
tasks: [FetchPush]
preset: sample-efficient
stages: [{name: her, variant: tac, env_steps: 1000000, evaluation: {interval: 1000000}}]
"""
Advance = Callable[[], int]
Evaluate = Callable[[], float]


def ours(seed: int) -> tuple[Advance, Evaluate]:
    """TAC at q = 1 (SAC), preset `sample-efficient`, as a sweep trains it."""
    from music_rllib import names
    from music_rllib.config.load import load_config
    from music_rllib.training.run import TrainingRun

    with tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
        file.write(SWEEP)
        file.flush()
        settings = load_config(Path(file.name)).stages[0].points[0].runs["FetchPush"]
    run = TrainingRun(settings.model_copy(update={"seed": seed}))
    run.advance()

    def advance() -> int:
        goal = run.env_steps + EVERY
        while run.env_steps < goal:
            run.algorithm.train()
        return run.env_steps

    return advance, lambda: run.evaluate()[names.EVAL_SUCCESS]


def tqc(seed: int, *, library: str, zoo: bool) -> tuple[Advance, Evaluate]:
    """TQC of SBX or of Stable-Baselines3 (`sb3_contrib`) with the HerReplayBuffer.

    `zoo`: with the settings of RL Baselines3 Zoo for FetchPush; otherwise with our networks, batch,
    and updates of four episodes in one compiled call.
    """
    import gymnasium as gym
    from stable_baselines3 import HerReplayBuffer
    from stable_baselines3.common.vec_env import DummyVecEnv

    from music_rllib.envs.make import make_env

    make_env(ENV_ID).close()  # registers the robotics tasks
    environments = 1 if zoo else 4
    how: dict[str, Any] = (
        {"batch_size": 2048, "policy_kwargs": {"net_arch": [512] * 3, "n_critics": 2}}
        if zoo
        else {
            "batch_size": 256, "policy_kwargs": {"net_arch": [128] * 3, "n_critics": 2},
            "train_freq": (50, "step"), "gradient_steps": 200,
        }
    )  # fmt: skip
    model = importlib.import_module(library).TQC(
        "MultiInputPolicy",
        DummyVecEnv([functools.partial(gym.make, ENV_ID)] * environments),
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        learning_rate=1e-3, gamma=0.95, tau=0.05, learning_starts=1_000, seed=seed, **how,
    )  # fmt: skip
    env = gym.make(ENV_ID)

    def advance() -> int:
        # With the larger networks, a call with all steps would exceed the time limit.
        model.learn(200 if zoo else EVERY, reset_num_timesteps=False)
        return int(model.num_timesteps)

    def evaluate() -> float:
        successes = []
        for episode in range(EPISODES):
            observation, _ = env.reset(seed=10_000 + episode)
            ended = False
            while not ended:
                action, _ = model.predict(observation, deterministic=True)
                observation, _, terminated, truncated, info = env.step(action)
                ended = terminated or truncated
            successes.append(info["is_success"])
        return float(np.mean(successes))

    return advance, evaluate


PROGRAMS: dict[str, Callable[[int], tuple[Advance, Evaluate]]] = {
    "ours": ours,
    "SBX TQC+HER, Zoo's settings": functools.partial(tqc, library="sbx", zoo=True),
    "SBX TQC+HER, our networks": functools.partial(tqc, library="sbx", zoo=False),
    "SB3 TQC+HER, Zoo's settings": functools.partial(tqc, library="sb3_contrib", zoo=True),
    "SB3 TQC+HER, our networks": functools.partial(tqc, library="sb3_contrib", zoo=False),
}


def main() -> None:
    """Train one program until it succeeds or its time is over."""
    from music_rllib.runtime.quiet import prepare_environment, quiet_third_parties

    prepare_environment()
    answers, sys.stdout = sys.stdout, sys.stderr
    import torch

    torch.set_num_threads(1)
    name, seed, limit = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
    if name == "ours":
        from benchmarks.measure import start_ray

        start_ray(1)
    quiet_third_parties()
    advance, evaluate = PROGRAMS[name](seed)
    used, evaluated, success = 0.0, 0, 0.0
    while used < limit and success < SUCCESS:
        begin = time.process_time()
        steps = advance()
        used += time.process_time() - begin
        if steps - evaluated >= EVERY or used >= limit:
            evaluated, success = steps, evaluate()
    answer = {"seconds": used, "steps": steps, "success": success}
    print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
