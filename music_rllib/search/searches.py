"""The searches of a sweep: checked before the sweep starts, then opened with their studies."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from optuna.trial import FrozenTrial

from music_rllib import names
from music_rllib.config.schema import Stage
from music_rllib.config.search import Rung, SearchSettings
from music_rllib.experiment.open_sweep import OpenSweep
from music_rllib.experiment.plan import Run, node_key
from music_rllib.results.statistics import Array
from music_rllib.search.storage import check_database, open_studies
from music_rllib.search.study import OptunaStudy

STUDY_FILE = "study.db"
"""File in the sweep's folder."""


@dataclass(eq=False)
class RunningTrial:
    """A trial that this driver runs."""

    study: OptunaStudy
    trial: FrozenTrial
    runs: list[Run] = field(default_factory=list)
    """Its runs at the rung."""
    rung: int = 0


@dataclass
class Finalist:
    """A trial that runs again on fresh seeds."""

    number: int
    values: Mapping[str, Any]
    """Its point, with the compared values."""
    searched: tuple[float, ...]
    """Its objective values in the search."""
    runs: list[Run]
    scores: list[Array] | None = None
    """For each objective `[seeds, tasks]` on fresh seeds; None until all runs have ended."""
    failure: str = ""

    @property
    def over(self) -> bool:
        """Whether it has its scores, or can't have them."""
        return self.scores is not None or bool(self.failure)


@dataclass
class Search:
    """A searched stage."""

    stage: Stage
    settings: SearchSettings
    rungs: tuple[Rung, ...]
    """The rungs of a trial; the last one is its end."""
    studies: list[OptunaStudy]
    """A study for each compared value, or one study."""
    running: list[RunningTrial] = field(default_factory=list)
    finalists: list[Finalist] | None = None
    """None until all studies have ended."""

    @property
    def over(self) -> bool:
        """Whether its ranking is complete, or can't be."""
        return self.finalists is not None and all(one.over for one in self.finalists)

    def label(self, study: OptunaStudy) -> str:
        """`finetune tac.alpha=0.1`, for messages."""
        values = (f"{name}={value}" for name, value in study.compared.items())
        return " ".join((self.stage.name, *values))


def check_studies(sweep: OpenSweep) -> None:
    """Check that the searches' databases can be used.

    Nothing is created, so that a sweep that is only planned leaves nothing behind.

    Raises:
        StorageError: A database can't be used.
    """
    for stage in sweep.plan.searched:
        assert stage.search is not None
        storage = _storage(sweep, stage.search)
        # The sweep's folder may not exist yet.
        if stage.search.storage or Path(storage).exists():
            check_database(storage)


def open_searches(sweep: OpenSweep, *, alone: bool = False) -> list[Search]:
    """Open the studies of a sweep's searched stages; missing studies are created.

    `alone` says that no other driver runs the sweep.

    Raises:
        StorageError: A study's storage can't be used.
    """
    return [_open_search(sweep, stage, alone) for stage in sweep.plan.searched]


def _base(sweep: OpenSweep, stage: Stage) -> str:
    """The beginning of the names of a stage's studies."""
    assert stage.search is not None
    return f"{stage.search.study or sweep.config.name}/{stage.name}"


def _storage(sweep: OpenSweep, settings: SearchSettings) -> str:
    own = Path(os.environ.get(names.VARIABLE_STUDIES) or sweep.folder)
    return settings.storage or str(own / STUDY_FILE)


def _open_search(sweep: OpenSweep, stage: Stage, alone: bool) -> Search:
    settings = stage.search
    assert settings is not None
    sweep.folder.mkdir(parents=True, exist_ok=True)
    storage, determined_by = open_studies(_storage(sweep, settings)), _determined_by(sweep, stage)
    studies = [
        OptunaStudy(
            storage,
            _base(sweep, stage),
            settings,
            determined_by,
            compared=values,
            # Only drivers of this sweep use the file in its folder.
            alone=alone and settings.storage is None,
        )
        for values in settings.compared()
    ]
    rungs = _rungs(sweep, stage, settings)
    return Search(stage=stage, settings=settings, rungs=rungs, studies=studies)


def _rungs(sweep: OpenSweep, stage: Stage, settings: SearchSettings) -> tuple[Rung, ...]:
    seeds, env_steps = len(sweep.plan.seeds), stage.most_env_steps
    end = Rung(seeds=seeds)
    rungs = [
        Rung(
            seeds=rung.seeds or seeds,
            # At the whole budget a run ends, so it is not paused.
            env_steps=None if (rung.env_steps or env_steps) >= env_steps else rung.env_steps,
        )
        for rung in (settings.pruning.rungs if settings.pruning else ())
    ]
    return (*dict.fromkeys(rung for rung in rungs if rung != end), end)


def _determined_by(sweep: OpenSweep, stage: Stage) -> dict[str, Any]:
    """Plain data of the settings that the stage's runs share, except the searched ones."""
    (point,) = stage.points
    above = sweep.config.source_of(stage)
    source_runs = above.points[0].runs if above else {}
    checkpoint = stage.source.checkpoint if stage.source else None
    # Values of another environment do not count. The earliest stands for all equal ones.
    codes = {run.code for run in (*point.runs.values(), *source_runs.values())}
    tasks = sorted(codes & sweep.environments.now.keys())
    environments = {task: sweep.environments.earliest(task) for task in tasks}
    return {
        **({"environments": environments} if environments else {}),
        "seeds": list(sweep.plan.seeds),
        "runs": {task: node_key(run, None) for task, run in point.runs.items()},
        "source": {task: node_key(run, None) for task, run in source_runs.items()},
        "checkpoint": None if checkpoint is None else checkpoint.manifest.content_hash,
    }
