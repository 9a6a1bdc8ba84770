"""A study's numbers as rows: what `compare --json`, the report and its CSV files have in common."""

from __future__ import annotations

from typing import Any

from music_rllib.results.claims.study import Claim, Mean, Study, label_of


def mean_rows(study: Study) -> list[dict[str, Any]]:
    """The primary metric of each condition on each task, and each of its seeds."""
    return [_mean_row(study, one) for one in study.means]


def _mean_row(study: Study, mean: Mean) -> dict[str, Any]:
    return {
        "stage": study.stage.name if study.stage else "",
        "task": mean.task,
        "condition": label_of(mean.condition),
        "metric": mean.measure.metric,
        "measure": mean.measure.words,
        "seeds": len(mean.scores.by_seed),
        "runs": mean.runs,
        "value": float(mean.estimate.value),
        "lower": float(mean.estimate.lower),
        "upper": float(mean.estimate.upper),
        "by_seed": dict(mean.scores.by_seed),
    }


def claim_rows(study: Study) -> list[dict[str, Any]]:
    """Every comparison, the planned ones first."""
    return [_claim_row(one) for one in (*study.planned, *study.afterwards)]


def _claim_row(claim: Claim) -> dict[str, Any]:
    difference = claim.contrast.difference
    return {
        "task": claim.task,
        "first": claim.first,
        "second": claim.second,
        "measure": claim.measure.words,
        "difference": float(difference.value),
        "lower": float(difference.lower),
        "upper": float(difference.upper),
        "p_value_holm": claim.p_value,
        "margin": claim.margin,
        "p_equivalent_holm": claim.p_equivalent,
        "verdict": str(claim.verdict),
        "planned": claim.planned,
        "hypothesis": claim.hypothesis.text if claim.hypothesis else None,
        "as_expected": claim.confirmed,
        "paired": claim.contrast.paired,
        "seeds": list(claim.contrast.seeds),
        "pairs_of_conditions": claim.cells,
    }


def study_data(study: Study) -> dict[str, Any]:
    """All of it as plain data."""
    plan = study.plan or study.latest
    return {
        "plan": None
        if plan is None
        else {
            "version": plan.version,
            "recorded": plan.recorded,
            "hash": plan.hash,
            "before_the_first_result": study.plan is not None,
        },
        "conditions": mean_rows(study),
        "comparisons": claim_rows(study),
        "not_tested": list(study.untested),
    }
