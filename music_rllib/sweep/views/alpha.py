"""Rows of the plan for alpha that is scaled by q, and for settings that follow a measurement."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import closing
from typing import Any

from rich.table import Table

from music_rllib.config.tac_settings import MatchedAlpha, NormalisedAlpha, alpha_at, setting_text
from music_rllib.envs.make import make_env
from music_rllib.envs.tasks import Task
from music_rllib.experiment.plan import Node, Plan
from music_rllib.schedules import QUANTITIES, Linear, Measured, Piecewise, value_at
from music_rllib.sweep.views.tables import new_table


def alpha_rows(plan: Plan) -> list[dict[str, Any]]:
    """Alpha at the start and at the end of a run, for each stage, scaled alpha and q.

    Plain and learned alphas have no row: a plain one is as given, a learned one is not known yet.
    """
    scaled = [
        node
        for node in plan.nodes
        if isinstance(node.run.tac.alpha, MatchedAlpha | NormalisedAlpha)
    ]
    # Only the joint entropy's scale depends on the number of dimensions of an action.
    joint = {n.run.task.name: n.run.task for n in scaled if n.run.tac.entropy_form == "joint"}
    dimensions = {name: _action_dimensions(task) for name, task in joint.items()}
    rows = [_alpha_row(node, dimensions.get(node.run.task.name, 1)) for node in scaled]
    unique = {tuple(row.values()): row for row in rows}
    return sorted(unique.values(), key=lambda row: (row["stage"], row["alpha"], row["q_at_start"]))


def _alpha_row(node: Node, action_dimensions: int) -> dict[str, Any]:
    tac, budget = node.run.tac, node.run.env_steps
    q_at_start = value_at(tac.entropic_index, 0, budget)
    q_at_end = _final_q(tac.entropic_index, budget)
    return {
        "stage": node.stage,
        "alpha": setting_text(tac.alpha),
        "q": setting_text(tac.entropic_index),
        "q_at_start": q_at_start,
        "at_start": alpha_at(tac, q_at_start, 0, budget, action_dimensions),
        "at_end": alpha_at(tac, q_at_end, budget, budget, action_dimensions),
    }


def _final_q(q: float | Linear | Piecewise | Measured, budget: int) -> float:
    """The q at the end of a run; one that follows a measurement ends at its last point."""
    if isinstance(q, Measured):
        return q.points[-1 if q.follows == "success_rate" else 0][1]
    return value_at(q, budget, budget)


def _action_dimensions(task: Task) -> int:
    with closing(make_env(task.env_id, **task.env_kwargs)) as env:
        return int(env.action_space.shape[0])  # type: ignore[index]


def alpha_table(rows: Iterable[dict[str, Any]]) -> Table:
    """`alpha_rows` as a table."""
    heads = ("stage", "alpha", "q", "α at the start", "at the end")
    table = new_table("α at each q", heads, left=heads[:2])
    for row in rows:
        numbers = (f"{row['at_start']:.4g}", f"{row['at_end']:.4g}")
        table.add_row(row["stage"], row["alpha"], row["q"], *numbers)
    return table


def adaptive_rows(plan: Plan) -> list[dict[str, Any]]:
    """The settings of each stage that follow a measurement, with their points."""
    rows = [
        {"stage": node.stage, "setting": name} | setting.model_dump(mode="json")
        for node in plan.nodes
        for name, setting in (
            ("tac.entropic_index", node.run.tac.entropic_index),
            ("music.mi_reward_weight", node.run.music.mi_reward_weight),
        )
        if isinstance(setting, Measured)
    ]
    return list({repr(row): row for row in rows}.values())


def adaptive_text(row: dict[str, Any]) -> str:
    """`her: tac.entropic_index follows the success rate: 2 at 0.2, 1 at 0.9`."""
    points = ", ".join(f"{value:g} at {measured:g}" for measured, value in row["points"])
    text = f"{row['stage']}: {row['setting']} follows the {QUANTITIES[row['follows']]}: {points}"
    if row["smoothing"]:
        text += f"; averaged over {row['smoothing']:g} env steps"
    return text + ("; never goes back" if row["monotone"] else "")
