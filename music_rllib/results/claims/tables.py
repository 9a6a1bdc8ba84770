"""Rows with a study's numbers, for `compare --json`, the report and its CSV files."""

from __future__ import annotations

from typing import Any

from music_rllib.results.claims.answer import (
    interval_in_words,
    not_excluded,
    p_in_words,
    verdict_in_words,
)
from music_rllib.results.claims.study import Study, label_of


def mean_rows(study: Study) -> list[dict[str, Any]]:
    """The primary metric of each condition on each task, and of each of its seeds."""
    return [
        {
            "stage": study.stage.name if study.stage else "",
            "task": mean.task,
            "condition": label_of(mean.condition),
            "metric": mean.measure.metric,
            "measure": mean.measure.words,
            "seeds": mean.scores.finished,
            "failed": mean.scores.failed,
            "runs": mean.runs,
            "value": float(mean.estimate.value),
            "lower": float(mean.estimate.lower),
            "upper": float(mean.estimate.upper),
            "by_seed": dict(mean.scores.by_seed),
        }
        for mean in study.means
    ]


def claim_rows(study: Study) -> list[dict[str, Any]]:
    """Every comparison, the planned ones first."""
    return [
        {
            "task": claim.task,
            "first": claim.first,
            "second": claim.second,
            "measure": claim.measure.words,
            "difference": float(claim.contrast.difference.value),
            "lower": float(claim.contrast.difference.lower),
            "upper": float(claim.contrast.difference.upper),
            "lower_90": float(claim.contrast.within.lower),
            "upper_90": float(claim.contrast.within.upper),
            "p_value": float(claim.contrast.p_value),
            "p_value_adjusted": claim.p_value,
            "margin": claim.margin,
            "p_tost": claim.contrast.p_values[1],
            "p_tost_adjusted": claim.p_equivalent,
            "verdict": str(claim.verdict),
            "why": claim.why,
            "collapses_not_excluded": claim.collapses,
            "in_words": [
                verdict_in_words(claim) + not_excluded(claim),
                interval_in_words(claim),
                p_in_words(claim),
            ],
            "planned": claim.planned,
            "hypothesis": claim.hypothesis.text if claim.hypothesis else None,
            "as_expected": claim.confirmed,
            "paired": claim.contrast.paired,
            "seeds": list(claim.contrast.seeds),
            "pairs_of_conditions": len(claim.pairs),
        }
        for claim in (*study.planned, *study.afterwards)
    ]


def study_data(study: Study) -> dict[str, Any]:
    """The study as plain data."""
    version = study.plan or study.latest
    plan = None
    if version is not None:
        plan = {name: getattr(version, name) for name in ("version", "recorded", "hash")}
        plan["before_the_first_result"] = study.plan is not None
    return {
        "plan": plan,
        "conditions": mean_rows(study),
        "comparisons": claim_rows(study),
        "not_tested": list(study.untested),
    }
