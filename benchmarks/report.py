"""A report on 500 runs with 500 points each, written by the user's command."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import psutil

from benchmarks.measure import Row, Taken, middle, taken_by
from music_rllib import names
from music_rllib.config.load import load_config
from music_rllib.config.schema import SweepConfig
from music_rllib.experiment.open_sweep import open_sweep
from music_rllib.experiment.plan import make_plan
from music_rllib.experiment.record import keep_record
from music_rllib.report.build import PAGE
from music_rllib.store.history import HISTORY, Report, RunResult, last_values, to_json_lines

__all__ = ["rows"]

POINTS = 500
METRICS = (
    names.EVAL_SUCCESS,
    names.EVAL_SUCCESS_ANY,
    names.MI_BOUND,
    names.MI_REWARD,
    names.ENTROPY,
    names.SHANNON_ENTROPY,
    names.Q_BIAS,
    names.ENV_STEPS,
    names.GRAD_UPDATES,
)
CONFIG = """
name: large
tasks: [FetchPush]
seeds: [{seeds}]
storage: unused
defaults: {{env_steps: 500000, evaluation: {{interval: 1000}}}}
stages:
  - name: train
    variant: tac
    grid: {{tac.entropic_index: [1.0, 1.25, 1.5, 1.75, 2.0], tac.alpha: [.01, .02, .05, .1, .2]}}
"""
PR_SET_CHILD_SUBREAPER = 36
"""Linux's constant of this name."""
TARGET = 15.0
OPENS, SIZE = 2.0, 8.0
"""Seconds until Chromium has drawn the page, and the page's size in megabytes."""


def rows(repeats: int) -> Iterator[Row]:
    """Seconds from the command to the finished page and figures."""
    with TemporaryDirectory() as folder:
        sweep = make_sweep(Path(folder))
        command = [sys.executable, "-m", "music_rllib", "report", str(sweep)]
        wall, cpu = middle([taken_by(lambda: _run(command)) for _ in range(repeats)])
        what = f"{len(make_plan(config(Path(folder))).nodes)} runs of {POINTS} points"
        yield Row("report", what, wall, "s", cpu=cpu, target=f"<= {TARGET:g} s", met=wall <= TARGET)
        page = sweep / "report" / PAGE
        size = page.stat().st_size / 1e6
        yield Row("report", "its page", size, "MB", target=f"<= {SIZE:g} MB", met=size <= SIZE)
        if chromium := shutil.which("chromium"):
            blank, _ = middle([_opened(chromium, "about:blank") for _ in range(repeats)])
            shown, cpu = middle([_opened(chromium, page.as_uri()) for _ in range(repeats)])
            took, target = shown - blank, f"<= {OPENS:g} s"
            yield Row("report", "it opens", took, "s", cpu=cpu, target=target, met=took <= OPENS)


def _opened(chromium: str, address: str) -> Taken:
    """Wall and CPU seconds of Chromium's start, a page with its script run, and Chromium's end."""
    with TemporaryDirectory() as profile:
        command = [chromium, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run"]
        command += [f"--user-data-dir={profile}", "--dump-dom", "--window-size=1400,1000", address]
        return taken_by(lambda: _run(command))


def _run(command: Sequence[str]) -> None:
    """Run a command until its child processes have ended too, so that their CPU time is known."""
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    own = psutil.Process()
    before = own.children()  # Ray, in `python -m benchmarks`
    subprocess.run(command, check=True, capture_output=True)
    for child in set(own.children()) - set(before):
        os.waitpid(child.pid, 0)


def config(storage: Path) -> SweepConfig:
    """Plan of 500 runs: 25 conditions on 20 seeds."""
    file = storage / "large.yaml"
    file.write_text(CONFIG.format(seeds=", ".join(map(str, range(20)))))
    return load_config(file)


def make_sweep(storage: Path) -> Path:
    """The folder of a sweep with rising, noisy learning curves."""
    sweep, folder = config(storage), storage / "large"
    opened = open_sweep(sweep, make_plan(sweep), str(storage))
    keep_record(opened)
    rng, now = np.random.default_rng(0), int(time.time() * 1000)
    for node in opened.plan.nodes:
        climb = np.clip(np.linspace(0, rng.uniform(0.2, 1.0), POINTS), 0, 1)
        values = climb[:, np.newaxis] + rng.normal(0, 0.02, (POINTS, len(METRICS)))
        reports = [
            Report(
                env_steps=1000 * (point + 1),
                seconds=point,
                timestamp_ms=now + point,
                metrics=dict(zip(METRICS, map(float, row), strict=True)),
            )
            for point, row in enumerate(values)
        ]
        with TemporaryDirectory() as made:
            (Path(made) / HISTORY).write_bytes(to_json_lines(reports))
            last = RunResult(
                label=node.label,
                env_steps=reports[-1].env_steps,
                seconds=reports[-1].seconds,
                metrics=last_values(reports),
            )
            opened.store.publish(node.key, Path(made), last)
    return folder
