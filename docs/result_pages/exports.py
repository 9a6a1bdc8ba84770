"""Sweeps of tune_configs, and what has been exported of their runs."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from music_rllib.config.load import load_sweep
from music_rllib.config.schema import SweepConfig
from music_rllib.experiment.plan import make_plan
from music_rllib.results.archive import is_archive, of_plan, read_archive
from music_rllib.results.data import Sweep
from music_rllib.version import ALGORITHM_VERSION

ROOT = Path(__file__).parents[2]
DATA, CONFIGS = ROOT / "docs" / "results" / "data", ROOT / "tune_configs"
EARLIER = tuple(str(version) for version in range(int(ALGORITHM_VERSION) - 1, 1, -1))
"""Earlier versions of the algorithm, the latest first: their runs stand in for missing ones."""


@cache
def sweep_called(name: str) -> Sweep | None:
    """What has been exported of a sweep's runs; None where nothing has."""
    config = config_of(name)
    if config is not None and not (plan := make_plan(config)).searched:
        earlier = [make_plan(config, algorithm=version) for version in EARLIER]
        return of_plan(plan, exports(), *earlier)
    return read_archive(DATA / name) if is_archive(DATA / name) else None


@cache
def config_of(name: str) -> SweepConfig | None:
    """The sweep of that name in tune_configs; None where there is none."""
    files = sorted(CONFIGS.glob("**/*.yaml"))
    found = (file for file in files if f"name: {name}\n" in file.read_text("utf-8"))
    file = next(found, None)
    return load_sweep(file) if file else None


@cache
def exports() -> list[Sweep]:
    """All that there are."""
    return [read_archive(folder) for folder in sorted(DATA.iterdir()) if is_archive(folder)]


def progress(sweep: Sweep) -> tuple[int, int]:
    """Runs that have finished, and those that the sweep's file plans."""
    config = config_of(sweep.name)
    planned = len(make_plan(config).nodes) if config else len(sweep.runs)
    return sum(run.status == "FINISHED" for run in sweep.runs), planned


def is_complete(sweep: Sweep) -> bool:
    """Whether every planned run has finished."""
    finished, planned = progress(sweep)
    return finished == planned


def progress_text(name: str) -> str:
    """How far a sweep of tune_configs is, in words."""
    sweep = sweep_called(name)
    if sweep is None:
        return "not begun"
    finished, planned = progress(sweep)
    return f"{'complete' if is_complete(sweep) else 'under way'}, {finished} of {planned} runs"


def hours_text(name: str) -> str:
    """Wall time of a sweep's runs, summed, in hours."""
    sweep = sweep_called(name)
    return f"{sum(run.seconds or 0.0 for run in sweep.runs) / 3600:.1f}" if sweep else "0"
