"""Each number of the results page follows from the exported runs with plain pandas and scipy.

Nothing here uses the package: the definitions of docs/comparing_q.md and docs/reports.md are
implemented a second time.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from scipy import stats

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "results.md").read_text("utf-8")
DETAILS = (DOCS / "lab" / "claims.md").read_text("utf-8")
MARGIN = 0.05
MEAN, SAMPLED = "evaluation/success_rate", "training/success_rate"
ENTROPIES = ("entropy/shannon", "entropy/tsallis")
MOVED = "training/object_displacement"
JOINT, MUSIC = "joint entropy, HER alone", "per-dimension entropy, MUSIC-r"
AT = "joint entropy, 1.5 nats by"
STUDIES = {  # export and compared stage
    ("FetchPush", "joint entropy, MUSIC-r"): ("joint-music", "music-r"),
    ("FetchPush", f"{AT} a fixed α, MUSIC-r"): ("equal-entropy-fixed", "music-r"),
    ("FetchPush", f"{AT} a learned α, MUSIC-r"): ("equal-entropy", "music-r"),
    ("FetchPush", JOINT): ("joint-her", "her"),
    ("FetchPush", MUSIC): ("claims-push", "music-r"),
    ("FetchPickAndPlace", "joint entropy, MUSIC-r"): ("joint-pick-fresh", "music-r"),
    ("FetchPickAndPlace", "joint entropy, MUSIC-r, first study"): ("joint-pick", "music-r"),
    ("FetchPickAndPlace", MUSIC): ("claims-pick-and-place", "music-r"),
    ("FetchSlide", "joint entropy, MUSIC-r"): ("joint-slide", "music-r"),
    ("FetchSlide", f"{AT} a fixed α, MUSIC-r"): ("equal-entropy-slide", "music-r"),
    ("FetchSlide", MUSIC): ("claims-slide", "music-r"),
}
TOTALS = {"claims-pick-and-place": 200_000, "joint-music": 30_000}
"""Steps with pretraining at which MUSIC-r is compared with HER alone."""
COUNTED = {
    **dict.fromkeys(("joint-music", "equal-entropy-fixed", "equal-entropy"), 30_000),
    **dict.fromkeys(("joint-pick-fresh", "joint-pick"), 80_000),
    "pick-and-place-in-80000-steps": 80_000,
    **dict.fromkeys(("joint-slide", "equal-entropy-slide"), 200_000),
}
"""Steps of the studies whose metric counts the pretraining."""
IN_DETAIL = {
    "equal-entropy-fixed": "## FetchPush at equal entropy\n",
    "equal-entropy": "**With a learned α**",
    "joint-her": "## FetchPush in the joint form, HER alone\n",
    "claims-push": "## FetchPush\n",
    "joint-pick": "**The first study**",
    "claims-pick-and-place": "## FetchPickAndPlace\n",
    "claims-slide": "## FetchSlide\n",
    "equal-entropy-slide": "## FetchSlide at equal entropy\n",
}
"""Studies whose tables are on the page of details: the text before them."""
WITH_HER = ("claims-pick-and-place", "joint-slide")
"""Studies whose plan also compares MUSIC-r at q = 1 with HER alone."""
BETWEEN_Q = (("1.5", "1"), ("2", "1.5"), ("2", "1"))
KINDS = ("p", "tost")
Claim = dict[str, Any]
Array = NDArray[np.float64]


@cache
def runs(study: str, stage: str) -> pd.DataFrame:
    """The runs of a stage."""
    table = pd.read_parquet(DOCS / "results/data" / study / "runs.parquet")
    names = {"tag.entropic_index": "q", "tag.seed": "seed", "param.env_steps": "budget"}
    names |= {"tag.source_node": "source", "tag.node_key": "key", "tag.alpha": "alpha"}
    own = table[table["tag.stage"] == stage].rename(columns=names)
    # `query` reads the names of all columns: with the other hundred it took most of the time.
    own = own.loc[:, own.columns.isin(["run", "status", *names.values()])]
    assert len(own)
    assert (own.status == "FINISHED").all()
    return own.astype({"budget": int, "seed": int}).sort_values("seed")


@cache
def curves(study: str) -> dict[tuple[int, str], tuple[Array, Array]]:
    path = DOCS / "results/data" / study / "metrics.parquet"
    table = pd.read_parquet(path, filters=[("metric", "in", [MEAN, SAMPLED, MOVED, *ENTROPIES])])
    groups = table.dropna().sort_values("env_steps").groupby(["run", "metric"])
    steps, values = groups.env_steps.agg(np.array), groups.value.agg(np.array)
    return {key: (steps[key].astype(float), values[key]) for key in groups.groups}


def curve(study: str, run: int, metric: str) -> tuple[Array, Array]:
    return curves(study)[run, metric]


def area(steps: Array, values: Array, budget: float) -> float:
    at = np.union1d(steps[(steps > 0) & (steps < budget)], [0, budget])
    return float(np.trapezoid(np.interp(at, steps, values), at)) / budget


@cache
def areas(study: str, stage: str, q: str, metric: str) -> pd.Series:
    """The area of each seed, averaged over the values of alpha."""
    if study in COUNTED:
        return areas_of_all_steps(study, stage, metric, COUNTED[study], q)
    own = runs(study, stage).query("q == @q")
    values = [area(*curve(study, run, metric), own.budget.min()) for run in own.run]
    return pd.Series(values, own.seed).groupby(level=0).mean()


def areas_of_all_steps(study: str, stage: str, metric: str, total: int, q: str = "1") -> pd.Series:
    """The area of each seed over `total` steps, starting with those of the pretraining."""
    own = runs(study, stage).query("q == @q")
    values = []
    for run, source in zip(own.run, own.source, strict=True):
        steps, rates = curve(study, run, metric)
        if pd.notna(source):
            before = runs(study, "pretrain").set_index("key").loc[source]
            first, early = curve(study, before.run, metric)
            steps = np.concatenate([first, steps + before.budget])
            rates = np.concatenate([early, rates])
        values.append(area(steps, rates, total))
    return pd.Series(values, own.seed)


def compared(x: pd.Series, y: pd.Series) -> Claim:
    """Paired t-test and two one-sided tests of two conditions."""
    assert list(x.index) == list(y.index)
    gap = (x - y).to_numpy()
    mean, error, freedom = gap.mean(), stats.sem(gap), len(gap) - 1
    distances = np.array([abs(mean), mean + MARGIN, MARGIN - mean])
    none, beyond, within = stats.t.sf(distances / error, freedom)  # each call takes a millisecond
    half, narrow = stats.t.ppf([0.975, 0.95], freedom) * error
    away = np.abs(gap - np.median(gap))
    far = np.sum(away > max(5 * 1.4826 * np.median(away), MARGIN)) if len(gap) >= 16 else 0
    return {
        "difference": mean,
        "p": 2 * none,
        "tost": max(beyond, within),
        "95": (mean - half, mean + half),
        "90": (mean - narrow, mean + narrow),
        "seeds": len(gap),
        "collapses": stats.beta.ppf(0.8, far + 1, len(gap) - far),
    }


def decided(family: list[Claim]) -> list[Claim]:
    """Holm's method with Shaffer's multiplier; returns the comparisons with a remaining test."""
    tests = sorted((claim[kind], i, kind) for i, claim in enumerate(family) for kind in KINDS)
    left, highest = [set(KINDS) for _ in family], 0.0
    for p, i, kind in tests:
        highest = max(highest, min(1.0, p * sum(map(bool, left))))
        family[i]["adjusted " + kind] = highest
        left[i].discard(kind)
    for claim in family:
        side = "superior" if claim["difference"] > 0 else "worse"
        claim["verdict"] = side if claim["adjusted p"] < 0.05 else "undecided"
        if claim["adjusted tost"] < 0.05:
            claim["verdict"] = "equivalent within 0.05"
    return family


@cache
def planned(study: str, stage: str, metric: str = MEAN, left_out: int | None = None) -> list[Claim]:
    """The planned comparisons of a study in their order, of all seeds or without one."""

    def of(stage: str, q: str) -> pd.Series:
        scores = areas(study, stage, q, metric)
        return scores if left_out is None else scores.drop(left_out)

    claims = [compared(of(stage, first), of(stage, second)) for first, second in BETWEEN_Q]
    if study in WITH_HER:
        claims.append(compared(of(stage, "1"), of("her", "1")))
    return decided(claims)


def in_words(claim: Claim, *, planned: bool) -> str:
    """`**worse**, -0.05 (95% CI -0.08 to -0.02; p = 0.003, adjusted 0.0089)`."""
    alike = planned and claim["verdict"] == "equivalent within 0.05"
    kind, level = ("tost", "90") if alike else ("p", "95")
    low, high = map(two_decimals, claim[level])
    interval = f"{two_decimals(claim['difference'], '+')} ({level}% CI {low} to {high}"
    own = p_text(claim[kind])
    if not planned:
        return f"{interval}; unadjusted {own})"
    adjusted = p_text(claim["adjusted " + kind])
    more = "" if own == adjusted else f", adjusted {adjusted.removeprefix('p = ')}"
    return f"**{claim['verdict']}**, {interval}; {'TOST ' * alike}{own}{more})"


def not_excluded(claim: Claim) -> str:
    """The rate of collapses beside a verdict; empty if it is small."""
    if claim["verdict"] == "undecided" or claim["collapses"] < 0.05:
        return ""
    return f"; collapses in up to {100 * claim['collapses']:.0f}% of seeds are not excluded"


def two_decimals(value: float, sign: str = "") -> str:
    return f"{value:{sign}.2f}"


def p_text(p: float) -> str:
    return "p < 0.001" if p < 0.001 else f"p = {p:.2g}"


def table(after: str, page: str = PAGE) -> list[list[str]]:
    """The cells of the first table after a text of a page."""
    lines = page[page.index(after) :].splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("|"))
    stop = next(i for i in range(start, len(lines)) if not lines[i].startswith("|"))
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[start:stop]]


def test_every_row_of_the_summary() -> None:
    header, _, *rows = table("# Results")
    assert header[3:] == ["the paper", "mean action", "sampled policy", "seeds"]
    expected = []
    for study, stage in STUDIES.values():
        pairs = zip(planned(study, stage), planned(study, stage, SAMPLED), strict=True)
        expected += [(mean, in_words(mean, planned=True), other) for mean, other in pairs]
        if total := TOTALS.get(study):
            mean, other = (
                compared(
                    areas_of_all_steps(study, stage, metric, total),
                    areas_of_all_steps(study, "her", metric, total),
                )
                for metric in (MEAN, SAMPLED)
            )
            expected.append((mean, in_words(mean, planned=False), other))
        if study == "joint-pick":  # the next study compares no q
            mean, other = (
                compared(
                    *(areas("pick-and-place-in-80000-steps", s, "1", m) for s in (stage, "her"))
                )
                for m in (MEAN, SAMPLED)
            )
            decided([mean])
            expected.append((mean, in_words(mean, planned=True), other))
    found = [row[4:] for row in rows]
    assert found == [
        [text, in_words(other, planned=False), str(mean["seeds"])] for mean, text, other in expected
    ]


@pytest.mark.parametrize(("metric", "after"), [(MEAN, "# Results"), (SAMPLED, "How to read")])
def test_the_averages_over_tasks(metric: str, after: str) -> None:
    """Each task, the mean of its settings, is one observation."""
    found = []
    for q in ("1.5", "2"):
        pairs = [[areas(*each, of, metric) for of in (q, "1")] for each in STUDIES.values()]
        each = pd.Series([compared(*pair)["difference"] for pair in pairs])
        gaps = each.groupby([task for task, _ in STUDIES]).mean()
        ends = stats.t.interval(0.95, len(gaps) - 1, np.mean(gaps), stats.sem(gaps))
        interval = f"{ends[0]:.2f} to {ends[1]:.2f}"
        found.append(f"q = {q} minus q = 1, {np.mean(gaps):+.2f} (95% CI {interval})")
    text = "under the success curve over the 3 tasks, each the mean of its settings (not planned): "
    line = next(one for one in PAGE[PAGE.index(after) :].splitlines() if text in one)
    assert f"{text}{'; '.join(found)}." in line


def test_all_comparisons_as_one_family() -> None:
    pairs = [(each, first, second) for each in STUDIES.values() for first, second in BETWEEN_Q]
    claims = [compared(areas(*each, a, MEAN), areas(*each, b, MEAN)) for each, a, b in pairs]
    found = [claim["verdict"] for claim in decided(claims)]
    alike = found.count("equivalent within 0.05")
    differences = len(found) - found.count("undecided") - alike
    text = f"With all {len(found)} comparisons of q as one family, {differences} differences and "
    assert f"{text}{alike} equivalences would be decided." in PAGE


def test_the_collapses_that_verdicts_do_not_exclude() -> None:
    claims = [one for each in STUDIES.values() for one in planned(*each)]
    rates: dict[int, float] = {}
    for claim in claims:
        if not_excluded(claim):
            rates[claim["seeds"]] = max(claim["collapses"], rates.get(claim["seeds"], 0.0))
    parts = [f"{rates[n]:.0%} ({n} seeds)" for n in sorted(rates, reverse=True)]
    assert f"Collapses in up to {', '.join(parts)} of the seeds are not excluded" in PAGE


def test_the_verdicts_at_several_alphas() -> None:
    """Planned comparisons of the factorial, in the order of its plan."""
    pairs = (("1.5", "1"), ("2", "1"), ("2", "1.5"))
    sides = {q: areas("q-entropy-factorial", "her", q, MEAN) for q in ("1", "1.5", "2")}
    claims = decided([compared(sides[a], sides[b]) for a, b in pairs])
    found = re.findall(
        r"^- q = .*, averaged over the 5 settings that both have: (.*)\.$", DETAILS, re.MULTILINE
    )
    texts = [in_words(one, planned=True) + not_excluded(one) for one in claims]
    assert found == [text.replace("**", "") for text in texts]


def early(study: str, stage: str, q: str, metric: str) -> pd.Series:
    """Mean of each seed over the first quarter of the steps."""
    own = runs(study, stage).query("q == @q")
    values = []
    for run, budget in zip(own.run, own.budget, strict=True):
        steps, found = curve(study, run, metric)
        values.append(found[(steps > 0) & (steps <= budget / 4)].mean())
    return pd.Series(values, own.seed)


def test_every_row_of_the_table_of_exploration() -> None:
    _, _, *rows = table("## What q does to exploration")
    expected = []
    for (task, setting), (study, stage) in STUDIES.items():
        by_q = ("1", "1.5", "2")
        entropies = [early(study, stage, q, ENTROPIES[0]).mean() for q in by_q]
        moved = [100 * early(study, stage, q, MOVED) for q in by_q]
        cells = [", ".join(f"{entropy:.2f}" for entropy in entropies)]
        cells.append(", ".join(f"{one.mean():.1f}" for one in moved))
        for one in moved[1:]:
            gap = one - moved[0]
            low, high = stats.t.interval(0.95, len(gap) - 1, gap.mean(), stats.sem(gap))
            cells.append(f"{gap.mean():+.1f} (95% CI {low:.1f} to {high:.1f})")
        expected.append([task, setting, *cells])
    assert rows == expected


def rate_interval(values: Array, episodes: float) -> tuple[float, float, float]:
    """Korn and Graubard's interval of a mean rate."""
    n, mean = len(values), values.mean()
    if values.std() == 0:
        trials = n * episodes
    else:
        alike = min(mean * (1 - mean) / (values.var(ddof=1) / n), n * episodes)
        trials = alike * (stats.norm.ppf(0.975) / stats.t.ppf(0.975, n - 1)) ** 2
    won, lost = mean * trials, (1 - mean) * trials
    low = stats.beta.ppf(0.025, won, lost + 1) if won > 0 else 0.0
    return mean, low, stats.beta.ppf(0.975, won + 1, lost) if lost > 0 else 1.0


def median_wait(steps: Array, reached: NDArray[np.bool_]) -> str:
    """Kaplan and Meier's median, and the interval from the order of the runs."""
    data = stats.CensoredData(uncensored=steps[reached], right=steps[~reached])
    survival = stats.ecdf(data).sf
    below = np.flatnonzero(survival.probabilities <= 0.5 + 1e-12)
    median = survival.quantiles[below[0]] if len(below) else np.inf
    missed = 2 * stats.binom.cdf(np.arange(len(steps)), len(steps), 0.5)
    order = np.flatnonzero(missed <= 1 - 0.93)[-1]
    ends = np.sort(steps)[order], np.sort(np.where(reached, steps, np.inf))[-1 - order]
    words = [f"{x:,.0f}" if np.isfinite(x) else "not reached" for x in (median, *ends)]
    return f"{words[0]} [{words[1]}, {words[2]}]"


def outcomes(study: str, stage: str, q: str) -> list[str]:
    """A column of a task's table."""
    own = runs(study, stage).query("q == @q")

    def interval(values: tuple[float, float, float]) -> str:
        return "{} [{}, {}]".format(*map(two_decimals, values))

    lines = [
        interval(rate_interval(areas(study, stage, q, metric).to_numpy(), episodes))
        for metric, episodes in ((MEAN, np.inf), (SAMPLED, np.inf))
    ]
    curves = [curve(study, run, MEAN) for run in own.run]
    finals = rate_interval(np.array([rates[-1] for _, rates in curves]), 50)
    lines.append("{:.0%} [{:.0%}, {:.0%}]".format(*finals))
    for threshold in (0.5, 0.85):
        first = [(np.argmax(rates >= threshold), steps, rates) for steps, rates in curves]
        reached = [bool(rates[at] >= threshold) for at, _, rates in first]
        waits = [
            steps[at if there else -1] for (at, steps, _), there in zip(first, reached, strict=True)
        ]
        lines.append(median_wait(np.array(waits), np.array(reached)))
    for metric in ENTROPIES:
        last = np.array([curve(study, run, metric)[1][-1] for run in own.run])
        half = stats.t.ppf(0.975, len(last) - 1) * stats.sem(last)
        lines.append(interval((last.mean(), last.mean() - half, last.mean() + half)))
    return lines


@pytest.mark.parametrize(("study", "stage"), STUDIES.values())
def test_every_number_of_a_tasks_table(study: str, stage: str) -> None:
    after, page = f"{study}-all-stages-success", PAGE
    if study in IN_DETAIL:
        after, page = IN_DETAIL[study], DETAILS
    header, _, *rows = table(after, page)
    columns = [[line[at] for line in rows] for at in range(1, len(header))]
    expected = [outcomes(study, stage, q) for q in ("1", "1.5", "2")]
    if study in WITH_HER:
        expected.insert(0, outcomes(study, "her", "1"))
    assert columns == expected


def test_the_verdicts_without_one_seed() -> None:
    expected, few = [], []
    for (task, setting), (study, stage) in STUDIES.items():
        for at, claim in enumerate(planned(study, stage)[:3]):
            if claim["verdict"] == "undecided":
                continue
            first, second = BETWEEN_Q[at]
            seeds = set(runs(study, stage).seed)
            again = [planned(study, stage, MEAN, seed)[at]["verdict"] for seed in seeds]
            same = again.count(claim["verdict"])
            word = claim["verdict"].removesuffix(" within 0.05")
            expected.append(
                f"- q = {first} against q = {second} on {task} ({setting}): {word} in {same} of "
                f"{claim['seeds']} cases"
            )
            if same < claim["seeds"] - 1:
                few.append(expected[-1].removeprefix("- "))
    assert re.findall(r"^(- q = .* cases)[;.]", DETAILS, re.MULTILINE) == expected
    stable = (
        f"{len(expected) - len(few)} of {len(expected)} stay in all or all but one of the cases"
    )
    assert f"{stable}. The others: {'; '.join(few)}." in PAGE


@pytest.mark.parametrize(
    ("study", "total", "page"),
    [
        ("intrinsic-rewards", 20_000, DETAILS),
        ("intrinsic-rewards-pick", 80_000, DETAILS),
        ("pick-and-place-in-80000-steps", 80_000, PAGE),
    ],
)
def test_every_row_of_a_table_of_stages(study: str, total: int, page: str) -> None:
    """Each planned stage against hindsight alone."""
    after = {
        "intrinsic-rewards": "## Intrinsic rewards on FetchPush",
        "intrinsic-rewards-pick": "## Intrinsic rewards on FetchPickAndPlace",
    }
    header, _, *lines = table(after.get(study, f"{study}-all-stages-success"), page)
    assert header[1:4] == ["verdict, difference", "area over all steps [95% CI]", header[3]]
    rows = {row[0]: row for row in lines}
    assert len(rows) == (9 if study in after else 2)
    scores = {stage: areas_of_all_steps(study, stage, MEAN, total) for stage in rows}
    stages = [stage for stage in rows if stage != "her"]
    claims = decided([compared(scores[stage], scores["her"]) for stage in stages])
    for stage, claim in zip(stages, claims, strict=True):
        assert rows[stage][1] == in_words(claim, planned=True) + not_excluded(claim)
    if study == "intrinsic-rewards-pick":  # the results page quotes one of them
        assert rows["displacement"][1].split(";")[0] in " ".join(PAGE.split())
    for stage, row in rows.items():
        values = rate_interval(scores[stage].to_numpy(), np.inf)
        assert row[2] == "{} [{}, {}]".format(*map(two_decimals, values))
        finals = [curve(study, run, MEAN)[1][-1] for run in runs(study, stage).run]
        assert row[3] == "{:.0%} [{:.0%}, {:.0%}]".format(*rate_interval(np.array(finals), 50))
        assert row[5] == str(len(finals))


def test_every_figure_of_the_readme_is_on_the_page() -> None:
    readme = (DOCS.parent / "README.md").read_text("utf-8").replace("−", "-")
    section = readme[readme.index("## Results") : readme.index("## In your own")]
    verdicts = "worse|undecided|superior|equivalent within 0.05"
    found = re.findall(rf"({verdicts}), ([+-]\d\.\d\d \(9[05]% CI [\d.-]+ to [\d.-]+)\)", section)
    numbers_of = r"([+-]\d\.\d\d \(9[05]% CI [\d.-]+ to [\d.-]+\))"
    averages = re.findall(rf"\sby {numbers_of}", section)
    assert 3 <= len(found) == section.count("% CI") - len(averages)
    assert averages == re.findall(
        rf"minus q = 1, {numbers_of}", PAGE[: PAGE.index("The paper (Kim")]
    )
    for verdict, numbers in found:
        assert f"**{verdict}**, {numbers};" in " ".join(PAGE.split())
    for percent in re.findall(r"\d+%(?! CI)", section):
        assert f"| {percent} [" in PAGE or f"{percent} (95% CI" in " ".join(PAGE.split())


def last(study: str, metric: str, stage: str, q: str) -> pd.Series:
    """The last value of each seed."""
    own = runs(study, stage).query("q == @q")
    return pd.Series([curve(study, run, metric)[1][-1] for run in own.run], own.seed)


def interval(gap: pd.Series, decimals: str) -> str:
    """Student's interval."""
    ends = stats.t.interval(0.95, len(gap) - 1, gap.mean(), stats.sem(gap))
    return " to ".join(f"{end:{decimals}}" for end in ends)


def broader(study: str) -> str:
    """How much broader policies of q = 1.5 and 2 end than those of q = 1."""
    one, *others = (last(study, ENTROPIES[0], "music-r", q) for q in ("1", "1.5", "2"))
    means = " and ".join(f"{(other - one).mean():.2f}" for other in others)
    intervals = " and ".join(interval(other - one, ".2f") for other in others)
    return f"{means} nats broader than those of q = 1 (95% CI {intervals})"


def test_entropies_at_equal_entropy_on_fetchslide() -> None:
    text = " ".join(PAGE.split())
    assert f"policies of q = 1.5 and 2 end {broader('equal-entropy-slide')}" in text


def test_the_observations_in_the_joint_form_on_fetchslide() -> None:
    study, text = "joint-slide", " ".join(PAGE.split())
    gaps = [
        areas(study, "music-r", a, MEAN) - areas(study, "music-r", b, MEAN) for a, b in BETWEEN_Q
    ]
    spread = [gap.std() for gap in gaps]
    assert f"standard deviation of {min(spread):.2f} to {max(spread):.2f}" in text
    ends = [last(study, MEAN, "music-r", q).mean() for q in ("1", "1.5", "2")]
    assert f"All q end at {100 * min(ends):.0f} to {max(ends):.0%}." in text
    one, *others = (last(study, ENTROPIES[0], "music-r", q) for q in ("1", "1.5", "2"))
    means = " and ".join(f"{(one - other).mean():.2f}" for other in others)
    intervals = " and ".join(interval(one - other, ".2f") for other in others)
    found = f"{means} nats narrower than those of q = 1 (95% CI {intervals}; not planned)"
    assert found in text
    behind = 100 * (last(study, MEAN, "her", "1") - last(study, MEAN, "music-r", "1"))
    points = f"{behind.mean():.0f} percentage points below (95% CI {interval(behind, '.0f')}"
    assert points in text
    alone, own = (
        pd.Series([area(*curve(study, run, MEAN), 150_000) for run in of.run], of.seed)
        for of in (runs(study, "her"), runs(study, "music-r").query("q == '1'"))
    )
    assert (
        f"its 150,000 steps have an area of {own.mean():.2f}, the first 150,000 of HER alone "
        f"{alone.mean():.2f} (95% CI of the difference {interval(own - alone, '.2f')}, which"
    ) in text
