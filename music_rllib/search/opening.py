"""A sweep's searches opened: their studies, where they are, and what they learn from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from music_rllib.config.schema import Stage
from music_rllib.config.search.check import most_env_steps
from music_rllib.config.search.settings import Rung, SearchSettings, WarmStart
from music_rllib.experiment.plan import node_key
from music_rllib.experiment.session import Sweep
from music_rllib.search.storage import (
    known_studies,
    open_studies,
    same_database,
)
from music_rllib.search.study import Study
from music_rllib.search.trials import Arm, Search
from music_rllib.search.warm_start import no_study_error

__all__ = ["check_studies", "learnings", "open_searches"]

STUDY_FILE = "study.db"
"""In the sweep's folder."""


def check_studies(sweep: Sweep) -> None:
    """Reach the databases that searches name, and look for the studies that they learn from.

    Nothing is made there, so that a sweep that is only planned leaves nothing.

    Raises:
        StorageError: One can't be used, or there is no such study.
    """
    above: list[tuple[str, str]] = []
    for stage in sweep.plan.searched:
        settings = stage.search
        assert settings is not None
        base, own = _base(sweep, stage), settings.storage or str(sweep.folder / STUDY_FILE)
        # The sweep's folder need not be there yet.
        mine = known_studies(own) if settings.storage or Path(own).exists() else []
        if settings.warm_start is not None:
            _check_warm_start(settings.warm_start, base, own, mine, above)
        above.append((base, own))


def _base(sweep: Sweep, stage: Stage) -> str:
    """What its studies' names begin with."""
    assert stage.search is not None
    return f"{stage.search.study or sweep.config.name}/{stage.name}"


def _check_warm_start(
    warm: WarmStart, base: str, own: str, mine: Sequence[str], above: Sequence[tuple[str, str]]
) -> None:
    """Look for the study to learn from.

    Args:
        warm: Names it.
        base: What the names of the search's own studies begin with.
        own: The search's storage.
        mine: The studies in it.
        above: `base` and `own` of the stages above.
    """
    if any(name.startswith((f"{base} @", f"{base}/")) for name in mine):
        return  # it has learnt already, and looks no more
    known = mine if warm.storage is None else known_studies(warm.storage, must_exist=True)
    # Those of the stages above are made before this one's.
    made = [name for name, place in above if same_database(place, warm.storage or own)]
    if any(name.startswith(warm.study) for name in known):
        return
    if not any(name.startswith(warm.study) or warm.study.startswith(name) for name in made):
        raise no_study_error(warm, known)


def open_searches(sweep: Sweep) -> list[Search]:
    """Open or make the studies of a sweep's searched stages.

    Raises:
        StorageError: A study's storage can't be used.
    """
    return [_open_search(sweep, stage) for stage in sweep.plan.searched]


def _open_search(sweep: Sweep, stage: Stage) -> Search:
    settings = stage.search
    assert settings is not None
    sweep.folder.mkdir(parents=True, exist_ok=True)
    storage = open_studies(settings.storage or str(sweep.folder / STUDY_FILE))
    arms = [
        Arm(
            values=values,
            position=position,
            study=Study(
                storage,
                _base(sweep, stage),
                settings,
                _determined_by(sweep, stage),
                arm=values,
                # The sweep's folder is locked by this process, and the file is in it.
                alone=settings.storage is None,
            ),
        )
        for position, values in enumerate(settings.arms())
    ]
    return Search(stage=stage, settings=settings, arms=arms, rungs=_rungs(sweep, stage, settings))


def learnings(searches: Sequence[Search]) -> list[str]:
    """From what each study with a warm start learns, in a line."""
    return [
        f"{search.stage.name}{''.join(f' {name}={value}' for name, value in arm.values.items())}: "
        f"{learnt}"
        for search in searches
        for arm in search.arms
        if (learnt := arm.study.learnt)
    ]


def _rungs(sweep: Sweep, stage: Stage, settings: SearchSettings) -> tuple[Rung, ...]:
    """Where a trial is looked at, its end last."""
    seeds, env_steps = len(sweep.plan.seeds), most_env_steps(settings, stage.points)
    end = Rung(seeds=seeds)
    found = [
        Rung(
            seeds=rung.seeds or seeds,
            # The whole budget is the end of a run, where nothing is paused.
            env_steps=None if (rung.env_steps or env_steps) >= env_steps else rung.env_steps,
        )
        for rung in (settings.pruning.rungs if settings.pruning else ())
    ]
    return (*dict.fromkeys(rung for rung in found if rung != end), end)


def _determined_by(sweep: Sweep, stage: Stage) -> dict[str, Any]:
    """What the stage's runs have in common, beside what is searched."""
    (point,) = stage.points
    source = stage.source
    above = next(
        (one for one in sweep.config.stages if source is not None and one.name == source.stage),
        None,
    )
    return {
        "seeds": list(sweep.plan.seeds),
        "runs": {task: node_key(run, None) for task, run in point.runs.items()},
        "source": {
            task: node_key(run, None)
            for task, run in (above.points[0].runs if above else {}).items()
        },
        "checkpoint": source.checkpoint.manifest.content_hash
        if source is not None and source.checkpoint is not None
        else None,
    }


# --- what came of them -------------------------------------------------------------------------
