"""Record of a sweep's analysis plan in its folder: made before any run, each change a version.

`analysis_plan.json` holds the versions, `analysis_plan.md` is the same for readers.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

from music_rllib.experiment.session import Sweep
from music_rllib.experiment.sweep_files import ANALYSIS_PLAN, as_json, keep, read
from music_rllib.redaction import redact
from music_rllib.results.claims.plan import (
    PlanVersion,
    analysis_plan,
    as_document,
    as_markdown,
    checked_plans,
    with_plan,
)
from music_rllib.store.object_folder import StorageError

PLANS_TO_READ = "analysis_plan.md"


def plans_in(storage: str, name: str) -> tuple[PlanVersion, ...]:
    """Versions of a sweep's plan, the oldest first; empty where none was recorded.

    Raises:
        StorageError: The versions can't be read, or are not what was recorded.
    """
    document = read(storage, f"{name}/{ANALYSIS_PLAN}")
    try:
        return () if document is None else checked_plans(document)
    except ValueError as error:
        reason = str(error).splitlines()[-1].strip()
        raise StorageError(
            f"{redact(storage)}/{name}/{ANALYSIS_PLAN} must hold the versions of an analysis plan "
            f"as they were recorded: {reason}"
        ) from error


def record_plan(sweep: Sweep) -> Sequence[PlanVersion]:
    """Keep the plan of the sweep's file, as a new version where it changed; return all versions.

    Raises:
        StorageError: The plan can't be kept, or earlier versions can't be read.
    """
    before = plans_in(sweep.storage, sweep.config.name)
    plan = analysis_plan(sweep.config)
    if plan is None:
        return before
    versions = with_plan(before, plan, int(time.time() * 1000))
    if len(versions) > len(before):
        keep(sweep, ANALYSIS_PLAN, as_json(as_document(versions)))
        keep(sweep, PLANS_TO_READ, as_markdown(sweep.config.name, versions))
    return versions
