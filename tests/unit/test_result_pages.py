"""The results page: totals with pretraining, and the first sentence."""

from __future__ import annotations

from dataclasses import replace

import pytest

from docs.result_pages import summary
from docs.result_pages.totals import at_equal_total
from music_rllib import names
from music_rllib.results.claims import Verdict
from music_rllib.results.conditions import find_stages
from music_rllib.results.data import Points, RunRecord, Sweep, columns
from music_rllib.results.study import study_of

SEEDS = ("0", "1", "2", "3", "4")
LEVELS = {"pretrain": 0.0, "music-r": 0.9, "her": 0.5}
BUDGETS = {"pretrain": 100, "music-r": 300, "her": 300}


def sweep() -> Sweep:
    """Runs with a constant success rate in each stage; MUSIC-r starts at 0."""
    records, points = [], []
    for stage, level in LEVELS.items():
        for seed in SEEDS:
            tags = {
                names.TAG_STAGE: stage,
                names.TAG_TASK: "FetchPush",
                names.TAG_SEED: seed,
                names.TAG_NODE_KEY: f"{stage}-{seed}",
                names.TAG_ENTROPIC_INDEX: "1",
                names.TAG_VARIANT: "tac" if stage == "her" else "music-r",
            }
            if stage == "music-r":
                tags[names.TAG_SOURCE_NODE] = f"pretrain-{seed}"
            records.append(
                RunRecord(
                    run_id=f"{stage}{seed}",
                    name=stage,
                    status="FINISHED",
                    tags=tags,
                    params={"env_steps": str(BUDGETS[stage])},
                )
            )
            value = level + 0.001 * int(seed) * (stage == "music-r")
            steps = range(0, BUDGETS[stage] + 1, 50)
            rate = [names.EVAL_SUCCESS] * len(steps)
            values = [0.0 if stage == "music-r" and step == 0 else value for step in steps]
            points.append(Points(rate, list(steps), list(steps), values))
    return Sweep(name="s", runs=records, history=columns(points))


def test_pretraining_counts_towards_an_equal_total() -> None:
    runs = sweep()
    stages = {stage.name: stage.conditions[0] for stage in find_stages(runs)}
    found = at_equal_total(runs, stages["music-r"], stages["her"], "FetchPush", names.EVAL_SUCCESS)
    assert found is not None
    assert found.total == 300  # HER alone has no more
    # 100 steps at 0, 50 rising to 0.902 (mean of the seeds) and 150 there, against 0.5 throughout
    assert found.claim.contrast.difference.value == pytest.approx(0.902 * 175 / 300 - 0.5)
    assert found.finals == pytest.approx((0.902, 0.5))
    assert found.crossing == (150, 100)


@pytest.mark.parametrize(
    ("verdicts", "answer", "end"),
    [
        (
            (Verdict.UNDECIDED, Verdict.UNDECIDED, Verdict.WORSE),
            "No study here shows that q = 1.5 is better than q = 1.",
            "",
        ),
        (
            (Verdict.SUPERIOR, Verdict.UNDECIDED, Verdict.UNDECIDED),
            "q = 1.5 is better than q = 1 on FetchPush (joint entropy, HER alone).",
            "",
        ),
        (
            (Verdict.UNDECIDED, Verdict.UNDECIDED, Verdict.UNDECIDED),
            "No study here shows that q = 1.5 is better than q = 1.",
            " No comparison of q is decided on FetchPush.",
        ),
    ],
)
def test_the_first_sentence_follows_the_verdicts(
    verdicts: tuple[Verdict, ...], answer: str, end: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = sweep()
    stages = {stage.name: stage.conditions[0] for stage in find_stages(runs)}
    found = at_equal_total(runs, stages["music-r"], stages["her"], "FetchPush", names.EVAL_SUCCESS)
    assert found is not None
    pairs = (("q = 1.5", "q = 1"), ("q = 2", "q = 1.5"), ("q = 2", "q = 1"))
    claims = tuple(
        replace(found.claim, first=first, second=second, verdict=verdict)
        for (first, second), verdict in zip(pairs, verdicts, strict=True)
    )
    study = replace(study_of(runs), planned=claims)
    monkeypatch.setattr(
        summary, "complete_studies", lambda: [(replace(runs, name="joint-her"), study)]
    )
    counts = f"q = 1.5 against q = 1: 1 {verdicts[0]}; q = 2 against q = 1: 1 {verdicts[2]}"
    assert summary.headline() == f"**{answer}** Verdicts on {counts}.{end}"
