"""Bounds of targets, and divergence, compared with the reachable returns."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from music_rllib.config.load import load_sweep, warnings_of
from music_rllib.config.tac_settings import Range, TACSettings, cut_off, have_diverged
from music_rllib.intrinsic.settings import MusicSettings

SPARSE = Range(-1.0, 0.0)
DDPG = {
    "policy": "deterministic",
    "bootstrap": "critics",
    "alpha": 0.0,
    "behaviour": {"kind": "gaussian_noise"},
}
MUSIC_R = {"estimator": "frozen", "mi_reward_weight": 1.0}
MUSIC_U = {**MUSIC_R, "estimator": "trained", "task_reward": False}
RAMP = {"schedule": "linear", "start": 0.25, "end": 0.0}


def reached(
    bounds: tuple[float, float], music: dict[str, Any], task: Range = SPARSE, **tac: Any
) -> tuple[float, float] | None:
    """The returns that are said to be cut off; None where nothing is said."""
    settings = TACSettings.model_validate(
        {"gamma": 0.98, "alpha": 0.0, **tac, "target_bounds": bounds}
    )
    found = cut_off(settings, MusicSettings.model_validate(music), task)
    if found is None:
        return None
    low, high = re.findall(r"values, (\S+) to (\S+):", found)[0]
    return float(low), float(high)


@pytest.mark.parametrize(
    ("bounds", "music", "tac", "expected"),
    [
        ((-50, 0), {}, {}, None),
        ((-49, 0), {}, {}, (-50, 0)),
        ((-50, 0), MUSIC_R, {}, (-100, 0)),
        ((-50, 0), MUSIC_R, DDPG, (-100, 0)),
        ((-200, 200), MUSIC_R, DDPG, None),
        ((-50, 0), {**MUSIC_R, "mi_reward_weight": RAMP}, {}, (-62.5, 0)),
        ((-50, 0), MUSIC_U, {}, None),
        ((-40, 0), MUSIC_U, {}, (-50, 0)),
        ((-50, 0), {}, {"gamma": 0.99}, (-100, 0)),
        ((-50, 0), {}, {"gamma": 0.9}, None),
    ],
)
def test_reachable_values_follow_from_rewards(
    bounds: tuple[float, float],
    music: dict[str, Any],
    tac: dict[str, Any],
    expected: tuple[float, float] | None,
) -> None:
    assert reached(bounds, music, **tac) == (expected and pytest.approx(expected, rel=1e-3))


def test_reachable_values_are_the_limit_of_bootstrapping() -> None:
    """Iterating r + gamma V at the largest and the least reward ends where it is said to."""
    low = high = 0.0
    for _ in range(5000):
        low, high = -3.5 + 0.98 * low, 0.5 + 0.98 * high
    music = {**MUSIC_R, "mi_reward_weight": 1.5}
    assert reached((-1, 1), music, Range(-2.0, 0.5)) == pytest.approx((low, high), rel=1e-3)
    # Where every reward is positive an episode's end is the least, and the other way round.
    assert reached((-1, 1), {}, Range(1.0, 2.0)) == pytest.approx((1.0, 100.0))


@pytest.mark.parametrize("q", [1.0, 1.5, 2.0])
def test_the_entropy_of_later_steps_is_part_of_the_target(q: float) -> None:
    most = math.log(2) if q == 1 else (1 - 2 ** (1 - q)) / (q - 1)
    tac: dict[str, Any] = {"alpha": 0.05, "entropic_index": q}
    expected = pytest.approx((-50.0, 0.05 * most * 0.98 / 0.02), rel=1e-3)
    assert reached((-50, 0), {}, **tac) == expected
    assert reached((-50, 5), {}, **tac) is None
    learned = {"learned": True, "initial": 0.05}
    assert reached((-50, 0), {}, entropic_index=q, alpha=learned) == expected


SWEEP = """
name: one
tasks: [FetchPush]
environments:
  Dense: {env_id: FetchPush-v4, horizon: 50, env_kwargs: {reward_type: dense},
          agent_indices: 0:3, surrounding_indices: 3:6}
defaults: {tac: {gamma: 0.98, alpha: 0.0, target_bounds: [-50, 0]}}
stages:
"""
PRETRAIN = "- {name: u, variant: music-u}"


@pytest.mark.parametrize(
    ("stages", "expected"),
    [
        (["- {name: tac, variant: tac}"], []),
        (
            [PRETRAIN, "- {name: r, variant: music-r, init_from: u}"],
            [
                "r/FetchPush: tac.target_bounds -50 to 0 cut off reachable values, "
                "-100 to 0: rewards of -2 to 0 a step at gamma 0.98"
            ],
        ),
        (
            ["- {name: tac, variant: tac, tasks: [FetchReach, Dense]}"],
            [
                "tac/Dense: tac.target_bounds may cut off reachable values: the rewards "
                "of Dense are not known (environments.Dense.reward_range)"
            ],
        ),
        (["- {name: tac, variant: tac, tasks: [Dense], tac: {target_bounds: null}}"], []),
        (
            [
                "- {name: tac, variant: tac, search: {trials: 2, sampler: random, "
                "space: {tac.gamma: {float: [0.9, 0.99]}}}}"
            ],
            [
                "tac/FetchPush: tac.target_bounds -50 to 0 cut off reachable values, "
                "-100 to 0: rewards of -1 to 0 a step at gamma 0.99"
            ],
        ),
    ],
)
def test_the_warning_names_stage_task_and_both_ranges(
    stages: list[str], expected: list[str], tmp_path: Path
) -> None:
    path = tmp_path / "sweep.yaml"
    path.write_text(SWEEP + "\n".join(stages))
    assert warnings_of(load_sweep(path)) == expected


@pytest.mark.parametrize(
    ("means", "bonuses", "expected"),
    [
        ([0, -25, -39, 39], [0, 0, 0, 0], [False] * 4),
        ([0, -41, 41], [0, 0, 0], [False, True, True]),
        # A policy so narrow that its entropies weigh as much as ten rewards, and later not.
        ([-41, -300, -300, -500], [0, -10, 0, 0], [True, False, False, True]),
        ([math.nan, -math.inf, -41], [0, 0, math.nan], [False, True, True]),
        # An entropy that is not known hides nothing that comes later.
        ([0, -41, -41], [math.nan, 0, 0], [False, True, True]),
    ],
)
def test_critics_beyond_reachable_returns_have_diverged(
    means: list[float], bonuses: list[float], expected: list[bool]
) -> None:
    found = have_diverged(np.array(means), np.array(bonuses, float), SPARSE, 0.95)
    assert found.tolist() == expected
