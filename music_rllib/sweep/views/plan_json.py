"""A plan as plain data, for `plan --json`."""

from __future__ import annotations

from typing import Any

from music_rllib.config.remarks import remarks
from music_rllib.experiment.open_sweep import OpenSweep, plan_document
from music_rllib.experiment.plan import shared_runs
from music_rllib.redaction import redact
from music_rllib.sweep.views.alpha import adaptive_rows, alpha_rows
from music_rllib.sweep.views.search_budget import search_budget


def plan_answer(opened: OpenSweep, changes: str) -> dict[str, Any]:
    """The plan of a sweep, with what has changed since the sweep ran last."""
    config = opened.config
    searches = [
        {
            "stage": stage.name,
            "mode": stage.search.mode,
            "sampler": stage.search.sampler,
            "studies": len(stage.search.compared()),
            "trials": stage.search.count,
            "runs_at_most": search_budget(stage, len(config.seeds)).runs,
            "space": stage.search.model_dump(mode="json", by_alias=True)["space"],
        }
        for stage in config.stages
        if stage.search is not None
    ]
    finished = opened.finished
    nodes = [
        node | {"finished": node["key"] in finished} for node in plan_document(opened)["nodes"]
    ]
    return {
        "sweep": config.name,
        "storage": redact(opened.storage),
        "seeds": list(config.seeds),
        "runs": len(opened.plan.runs),
        "env_steps": opened.plan.env_steps,
        "env_steps_left": sum(node["env_steps"] for node in nodes if not node["finished"]),
        "nodes": nodes,
        "searches": searches,
        "remarks": [*remarks(config), *shared_runs(opened.plan)],
        "alpha": alpha_rows(opened.plan),
        "adaptive": adaptive_rows(opened.plan),
        "changes": changes or None,
    }
