"""Settings, grids and costs in the text of the results page, from the exported runs."""

from __future__ import annotations

import re

import pandas as pd
import pytest

from tests.unit.test_results_prose import DATA, TEN_Q, TEXT, WORDS, exported, grid
from tests.unit.test_results_recomputed import MEAN, PAGE, curve, runs

GRIDS = [  # studies and stages whose α a grid chose, and the q whose best α is at its edge
    ("joint-music", "music-r", ""),
    ("joint-her", "her", ""),
    ("claims-push", "music-r", ""),
    ("joint-pick", "music-r", ""),
    ("claims-pick-and-place", "music-r", "1"),
    ("claims-pick-and-place", "her", "1"),
    ("joint-slide", "music-r", ""),
    ("joint-slide", "her", ""),
    ("claims-slide", "music-r", "1 2"),
]
SETTINGS = {  # <q,q> is the α that these q share
    "joint-music": (
        "{steps} environment steps after {before} steps of MUSIC-u at q = 1",
        "{seeds} seeds, used before for HER alone only; α = <1,2> for q = 1 and 2, and <1.5> for",
    ),
    "equal-entropy-fixed": ("<1,1.5> for q = 1 and 1.5, <2> for q = 2. The {seeds} seeds are",),
    "joint-her": (
        "**HER alone, joint form** ({seeds} seeds, ",
        "{steps} environment steps with the preset",
        "α = <1,1.5> for q = 1 and 1.5, and <2> for q = 2, each the best",
    ),
    "claims-push": (
        "{steps} environment steps after {before} of MUSIC-u at q = 1, with HER; {seeds} fresh "
        "seeds; α = <1,1.5,2> for each q.",
    ),
    "joint-pick": ("A first study of {seeds} seeds",),
    "joint-pick-fresh": (
        "{steps} environment steps after {before} of MUSIC-u at q = 1, with `preset: "
        "sample-efficient`; {seeds} fresh seeds; α = <1>, <1.5> and <2> for q = 1, 1.5 and 2",
    ),
    "claims-pick-and-place": (
        "{steps} environment steps after {before} steps of MUSIC-u at q = 1; {seeds} fresh seeds; "
        "α = <1> for q = 1 and <1.5,2> for q = 1.5 and 2.",
    ),
    "joint-slide": (
        "{steps} environment steps after {before} of MUSIC-u at q = 1, with `preset: "
        "sample-efficient` and 0.4 updates per step; {seeds} fresh seeds; α = <1,1.5,2> for each q",
    ),
    "equal-entropy-slide": ("({seeds} of the seeds; α = <1>, <1.5> and <2>;",),
    "claims-slide": (
        "{steps} environment steps after {before} of MUSIC-u ({seeds} fresh seeds; α = <1,2> for "
        "q = 1 and 2, and <1.5> for q = 1.5;",
    ),
}


@pytest.mark.parametrize(("study", "stage", "edge"), GRIDS)
def test_each_alpha_is_the_best_of_its_grid(study: str, stage: str, edge: str) -> None:
    stages = ("music-r", "weight") if (study, stage) == ("joint-slide", "music-r") else (stage,)
    found, at_edge = grid(f"{study}-alpha", stages), []
    for q, of in runs(study, stage).groupby("q").alpha.unique().items():
        assert found[q].idxmax() == of.item()
        if of.item() in sorted(found[q].index, key=float)[:: len(found[q]) - 1]:
            at_edge.append(q)
    assert at_edge == edge.split()
    chose = runs(f"{study}-alpha", stage)
    assert chose.seed.nunique() == (
        3 if study in ("joint-music", "joint-her", "claims-push") else 2
    )
    share = chose.budget.min() / runs(study, stage).budget.min()
    assert share == (0.6 if study in ("claims-pick-and-place", "claims-slide") else 1)


@pytest.mark.parametrize("study", SETTINGS)
def test_the_settings_in_the_text_are_those_of_the_runs(study: str) -> None:
    own = runs(study, "her" if study == "joint-her" else "music-r")
    alphas = own.groupby("q").alpha.unique().map(lambda one: one.item()).to_dict()
    words = {"steps": f"{own.budget.unique().item():,}", "seeds": WORDS[own.seed.nunique()]}
    if study != "joint-her":
        words["before"] = f"{runs(study, 'pretrain').budget.unique().item():,}"
        assert (own.groupby("seed").source.nunique() == 1).all()
    for template in SETTINGS[study]:

        def shared(match: re.Match[str]) -> str:
            (alpha,) = {alphas[q] for q in match[1].split(",")}
            return str(alpha)

        assert re.sub("<(.*?)>", shared, template).format(**words) in TEXT


def test_the_settings_of_hindsight_alone() -> None:
    first = {
        (study, stage): runs(study, stage)[["budget", "alpha"]].iloc[0]
        for study, *stages in (
            ("pick-and-place-in-80000-steps", "pretrain", "music-r", "her"),
            ("joint-slide", "her"),
            ("claims-pick-and-place", "her"),
        )
        for stage in stages
    }
    before, own, alone, slide, pick = first.values()
    assert (
        f"{before.budget:,} steps of MUSIC-u and {own.budget:,} of MUSIC-r, against "
        f"{alone.budget:,} of HER alone (α = {own.alpha} and, for HER alone, {alone.alpha})"
    ) in TEXT
    assert f"HER alone has q = 1, α = {slide.alpha} and {slide.budget:,} steps." in TEXT
    assert f"HER alone has q = 1 and α = {pick.alpha} " in TEXT


def test_evaluations_networks_and_random_steps() -> None:
    every = {"FetchPush": 2_500, "FetchPickAndPlace": 5_000, "FetchSlide": 10_000}
    words = ", ".join(f"{steps:,} ({task})" for task, steps in every.items())
    assert f"50 fresh goals every {' or '.join(words.rsplit(', ', 1))} steps" in TEXT
    for study, _ in TEN_Q:
        own = exported(study)[exported(study)["tag.stage"] != "pretrain"]
        assert set(own["param.evaluation.episodes"].astype(int)) == {50}
        found = own["param.evaluation.interval"].astype(int)
        assert (found == own["tag.task"].map(every)).all()
        assert set(own["param.tac.hidden_sizes"]) == {"[128, 128, 128]"}
        assert set(own["param.replay.hindsight_k"].astype(float)) == {4}
        slow = study.startswith("claims") or "FetchSlide" in set(own["tag.task"])
        assert set(own["param.tac.replay_ratio"].astype(float)) == {0.4 if slow else 1.0}


def test_random_steps_and_the_evaluation_of_the_papers_own_setting() -> None:
    assert "Runs begin with 1,000 random steps." in TEXT
    for study in (*(study for study, _ in TEN_Q), "pick-and-place-in-80000-steps"):
        assert set(exported(study)["param.tac.random_steps"].astype(int)) == {1_000}, study
    names = ("evaluation.episodes", "evaluation.interval", "tac.random_steps")
    own = exported("claims-paper-setting")
    goals, every, steps = (int(own[f"param.{name}"].unique().item()) for name in names)
    assert f"has {goals} goals every {every:,} steps, and {steps:,} random ones." in TEXT


def test_core_minutes_with_the_pretraining() -> None:
    table = exported("pick-and-place-in-80000-steps")
    before = table.set_index("tag.node_key").trained_seconds
    seconds = table.trained_seconds + table["tag.source_node"].map(before).fillna(0)
    for stage, minutes in (seconds.groupby(table["tag.stage"]).mean() / 60).items():
        assert stage == "pretrain" or re.search(rf"\| {stage} \|.*\| {minutes:.1f} \| 10 \|", PAGE)


def test_pretrainings_repeated_on_another_machine() -> None:
    values = []
    for study in ("joint-music", "equal-entropy"):
        table = pd.read_parquet(DATA / study / "metrics.parquet").dropna()
        own = runs(study, "pretrain").set_index("run").key
        table = table[table.run.isin(own.index) & ~table.metric.str.startswith("system/")]
        keys = ["key", "metric", "env_steps"]
        values.append(table.assign(key=table.run.map(own)).set_index(keys).value.sort_index())
    assert values[0].equals(values[1])
    assert values[0].index.get_level_values("key").nunique() == 20


def test_the_factorial_learns_at_two_of_five_alphas() -> None:
    study = "q-entropy-factorial"
    own = runs(study, "her")
    learned = pd.Series([curve(study, run, MEAN)[1][-1] >= 0.5 for run in own.run], own.alpha)
    assert sorted(learned.groupby(level=0).sum() < 3) == [False] * 2 + [True] * 3
    assert (own.q.nunique(), own.alpha.nunique()) == (7, 5)
