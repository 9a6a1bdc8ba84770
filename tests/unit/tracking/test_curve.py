"""The learning curve shows what was measured, on readable axes."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np

from music_rllib import names
from music_rllib.store.history import Report
from music_rllib.tracking.curve import learning_curve, learning_curve_png


def report(step: int, metrics: dict[str, float]) -> Report:
    return Report(env_steps=step, seconds=step, timestamp_ms=step, metrics=metrics)


HISTORY = [
    report(
        step,
        {
            names.EVAL_SUCCESS: step / 10_000,
            names.EVAL_SUCCESS_ANY: step / 5_000,
            names.MI_BOUND: 0.1,
            names.MI_REWARD: -0.9,
            names.TRAIN_RETURN: -50.0,
        },
    )
    for step in (2000, 4000)
]


def test_success_above_and_mutual_information_below() -> None:
    figure = learning_curve(HISTORY, title="finetune q=1.5")
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels == ["success rate", "MI bound (nats)", "MI reward per step"]
    assert figure.axes[-1].get_xlabel() == "environment steps"
    last, any_step = figure.axes[0].lines
    np.testing.assert_array_equal(last.get_xdata(), [2000, 4000])
    np.testing.assert_array_equal(last.get_ydata(), [0.2, 0.4])
    np.testing.assert_array_equal(any_step.get_ydata(), [0.4, 0.8])
    assert last.get_color() != any_step.get_color()
    assert last.get_linestyle() != any_step.get_linestyle()


def test_a_run_without_mutual_information_has_no_empty_panel() -> None:
    history = [report(1, {names.EVAL_SUCCESS: 0.5})]
    assert len(learning_curve(history, title="tac").axes) == 1


def test_a_task_without_success_has_its_return() -> None:
    without = [report(1, {names.EVAL_RETURN: -7.5})]
    (axes,) = learning_curve(without, title="reacher").axes
    assert axes.get_ylabel() == "return of an episode"
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), [-7.5])
    both = [report(1, {names.EVAL_RETURN: -7.5, names.EVAL_SUCCESS: 0.5})]
    (axes,) = learning_curve(both, title="push").axes
    assert axes.get_ylabel() == "success rate"


def test_a_run_without_evaluation_says_so() -> None:
    history = [report(1, {names.TRAIN_RETURN: 0.5})]
    texts = [text.get_text() for text in learning_curve(history, title="cut").axes[0].texts]
    assert texts == ["nothing was evaluated"]


def test_a_nan_is_a_gap_and_the_picture_is_a_png() -> None:
    history = [*HISTORY, report(6000, {names.EVAL_SUCCESS: math.nan})]
    assert learning_curve_png(history, title="é$x$").startswith(b"\x89PNG")


def test_no_pyplot_and_so_no_display() -> None:
    code = "import sys, music_rllib.tracking.curve; print('matplotlib.pyplot' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
