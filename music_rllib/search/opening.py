"""The searches of a sweep, opened: their studies, storages and rungs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from music_rllib.config.schema import Stage
from music_rllib.config.search import Rung, SearchSettings, WarmStart
from music_rllib.config.search_check import most_env_steps
from music_rllib.experiment.open_sweep import OpenSweep
from music_rllib.experiment.plan import node_key
from music_rllib.search.storage import known_studies, names_of, open_studies, same_database
from music_rllib.search.study import Study
from music_rllib.search.trials import Arm, Search
from music_rllib.search.warm_start import no_study_error

STUDY_FILE = "study.db"
"""File in the sweep's folder."""


def check_studies(sweep: OpenSweep) -> None:
    """Check that the searches' databases and the studies that they learn from are there.

    Nothing is made, so that a sweep that is only planned leaves nothing.

    Raises:
        StorageError: A database can't be used, or there is no such study.
    """
    above: list[tuple[str, str]] = []
    for stage in sweep.plan.searched:
        settings = stage.search
        assert settings is not None
        base, storage = _base(sweep, stage), _storage(sweep, settings)
        # The sweep's folder need not be there yet.
        known = known_studies(storage) if settings.storage or Path(storage).exists() else []
        # A study that is there has learnt already.
        is_made = any(name.startswith((f"{base} @", f"{base}/")) for name in known)
        if settings.warm_start is not None and not is_made:
            place = settings.warm_start.storage or storage
            # The studies of earlier stages are made before this one's.
            made = [name for name, other in above if same_database(other, place)]
            _check_warm_start(settings.warm_start, known, made)
        above.append((base, storage))


def _base(sweep: OpenSweep, stage: Stage) -> str:
    """The beginning of the names of a stage's studies."""
    assert stage.search is not None
    return f"{stage.search.study or sweep.config.name}/{stage.name}"


def _storage(sweep: OpenSweep, settings: SearchSettings) -> str:
    return settings.storage or str(sweep.folder / STUDY_FILE)


def _check_warm_start(warm: WarmStart, known: Sequence[str], made: Sequence[str]) -> None:
    """Check that the study to learn from is there, or has one of the beginnings `made`."""
    if warm.storage is not None:
        known = names_of(open_studies(warm.storage, warm_start=True))
    if any(name.startswith(warm.study) for name in known):
        return
    if not any(name.startswith(warm.study) or warm.study.startswith(name) for name in made):
        raise no_study_error(warm, known)


def open_searches(sweep: OpenSweep) -> list[Search]:
    """Open the studies of a sweep's searched stages, which are made where they are missing.

    Raises:
        StorageError: A study's storage can't be used.
    """
    return [_open_search(sweep, stage) for stage in sweep.plan.searched]


def _open_search(sweep: OpenSweep, stage: Stage) -> Search:
    settings = stage.search
    assert settings is not None
    sweep.folder.mkdir(parents=True, exist_ok=True)
    storage = open_studies(_storage(sweep, settings))
    search = Search(stage=stage, settings=settings, rungs=_rungs(sweep, stage, settings))
    for position, values in enumerate(settings.compared()):
        study = Study(
            storage,
            _base(sweep, stage),
            settings,
            _determined_by(sweep, stage),
            arm=values,
            # The sweep's folder is locked by this process, and the file is in it.
            alone=settings.storage is None,
        )
        search.arms.append(Arm(search=search, values=values, study=study, position=position))
    return search


def learnings(searches: Sequence[Search]) -> list[str]:
    """One line for each study with a warm start, with the studies that it learns from."""
    return [
        f"{arm.label}: {arm.study.learnt}"
        for search in searches
        for arm in search.arms
        if arm.study.learnt
    ]


def _rungs(sweep: OpenSweep, stage: Stage, settings: SearchSettings) -> tuple[Rung, ...]:
    """The rungs of a trial; the last one is its end."""
    seeds, env_steps = len(sweep.plan.seeds), most_env_steps(settings, stage.points)
    end = Rung(seeds=seeds)
    rungs = [
        Rung(
            seeds=rung.seeds or seeds,
            # The whole budget is the end of a run, where nothing is paused.
            env_steps=None if (rung.env_steps or env_steps) >= env_steps else rung.env_steps,
        )
        for rung in (settings.pruning.rungs if settings.pruning else ())
    ]
    return (*dict.fromkeys(rung for rung in rungs if rung != end), end)


def _determined_by(sweep: OpenSweep, stage: Stage) -> dict[str, Any]:
    """Plain data of what the stage's runs have in common, apart from what is searched."""
    (point,) = stage.points
    source = stage.source
    source_runs = next(
        (
            above.points[0].runs
            for above in sweep.config.stages
            if source is not None and above.name == source.stage
        ),
        {},
    )
    checkpoint = source.checkpoint if source is not None else None
    # Values of another environment are not this search's. The earliest stands for all the same.
    tasks = sorted({*point.runs, *source_runs} & sweep.environments.now.keys())
    environments = {task: sweep.environments.earliest(task) for task in tasks}
    return {
        **({"environments": environments} if environments else {}),
        "seeds": list(sweep.plan.seeds),
        "runs": {task: node_key(run, None) for task, run in point.runs.items()},
        "source": {task: node_key(run, None) for task, run in source_runs.items()},
        "checkpoint": None if checkpoint is None else checkpoint.manifest.content_hash,
    }
