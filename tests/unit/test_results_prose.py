"""Numbers of the results page's prose, and of README.md, from the exported runs."""

from __future__ import annotations

import re
from collections import Counter
from functools import cache

import numpy as np
import pandas as pd
from scipy import stats

from tests.unit.test_results_recomputed import (
    BETWEEN_Q,
    DETAILS,
    DOCS,
    ENTROPIES,
    MEAN,
    MOVED,
    PAGE,
    SAMPLED,
    STUDIES,
    Array,
    area,
    areas,
    areas_of_all_steps,
    compared,
    curve,
    early,
    in_words,
    interval,
    last,
    median_wait,
    planned,
    rate_interval,
    runs,
    table,
)

TEXT = " ".join(PAGE.split())
DATA = DOCS / "results" / "data"
README = " ".join((DOCS.parent / "README.md").read_text("utf-8").split())
Q = ("1", "1.5", "2")
TEN_Q = list(STUDIES.values())
WORDS = {4: "four", 6: "six", 8: "Eight", 10: "ten", 15: "15", 20: "20", 35: "35"}


@cache
def exported(study: str) -> pd.DataFrame:
    return pd.read_parquet(DATA / study / "runs.parquet")


def extremes(study: str, metric: str) -> pd.DataFrame:
    """Smallest and largest value of each run."""
    values = pd.read_parquet(DATA / study / "metrics.parquet", filters=[("metric", "==", metric)])
    return values.dropna().groupby("run").value.agg(["min", "max"])


def ends(study: str, stage: str = "music-r") -> str:
    """Lowest and highest mean success of the three q at the end."""
    rates = [last(study, MEAN, stage, q).mean() for q in Q]
    return f"ll q end at {100 * min(rates):.0f} to {max(rates):.0%}"


def apart(study: str, metric: str, decimals: int, stage: str = "music-r") -> list[str]:
    """How far q = 1.5 and 2 end from q = 1 in the mean, without the sign."""
    one, *others = (last(study, metric, stage, q) for q in Q)
    return [f"{abs((other - one).mean()):.{decimals}f}" for other in others]


def rate(count: int, trials: int) -> str:
    """Clopper and Pearson's interval."""
    low = stats.beta.ppf(0.025, count, trials - count + 1)
    return (
        f"(95% CI of the rate: {low:.1%} to {stats.beta.ppf(0.975, count + 1, trials - count):.1%})"
    )


def spread(study: str) -> list[float]:
    """Standard deviations of the differences within a seed."""
    found = [[areas(study, "music-r", q, MEAN) for q in pair] for pair in BETWEEN_Q]
    return [(first - second).std() for first, second in found]


def grid(study: str, stages: tuple[str, ...]) -> pd.Series:
    """Mean area of each q and α; of MUSIC's weights the best one."""
    own = pd.concat([runs(study, stage) for stage in stages])
    own["area"] = [area(*curve(study, r.run, MEAN), r.budget) for r in own.itertuples()]
    weights = exported(study).set_index("run").get("tag.mi_reward_weight", pd.Series(dtype=str))
    own["weight"] = own.run.map(weights).fillna("")
    return own.groupby(["q", "alpha", "weight"]).area.mean().groupby(["q", "alpha"]).max()


def test_counts_of_verdicts_and_of_intervals() -> None:
    verdicts, sides = [], []
    for at, (first, second) in enumerate(BETWEEN_Q):
        if second != "1":
            continue
        pair = f"q = {first} against q = 1: "
        found = Counter(planned(*each)[at]["verdict"].split()[0] for each in TEN_Q)
        verdicts.append(pair + ", ".join(f"{n} {word}" for word, n in found.most_common()))
        limits = [planned(*each, SAMPLED)[at]["95"] for each in TEN_Q]
        below, above = sum(high < 0 for _, high in limits), sum(low > 0 for low, _ in limits)
        counts = {"include 0": len(TEN_Q) - below - above, "below 0": below, "above 0": above}
        sides.append(pair + ", ".join(f"{n} {word}" for word, n in counts.items() if n))
    assert f"Verdicts on {'; '.join(verdicts)}. Mean difference" in TEXT
    assert f"adjusted) for {'; '.join(sides)}. Mean" in TEXT
    assert f"at most {4 * np.log(2):.2f};" in TEXT


def test_observations_about_exploration() -> None:
    moved, entropy = {}, {}
    for study, stage in TEN_Q:
        one = early(study, stage, "1", MOVED), early(study, stage, "1", ENTROPIES[0])
        for q in Q[1:]:
            moved[study, q] = compared(100 * early(study, stage, q, MOVED), 100 * one[0])
            entropy[study, q] = (early(study, stage, q, ENTROPIES[0]) - one[1]).mean()
    farther = {study for (study, _), claim in moved.items() if claim["95"][0] > 0}
    nearer = [study for study, _ in TEN_Q if moved[study, "1.5"]["95"][1] < 0]
    assert farther == {"claims-slide"}
    narrow = ["joint-music", "claims-pick-and-place"]
    assert sorted(nearer) == sorted([*narrow, "joint-pick-fresh", "joint-slide"])
    assert all(entropy[study, "1.5"] < -1 for study in narrow)
    pick, slide = (-entropy[study, "1.5"] for study in ("joint-pick-fresh", "joint-slide"))
    said = f"by {pick:.1f} nats on FetchPickAndPlace (35 seeds) and by {slide:.1f} nats on FetchSl"
    assert said in TEXT
    broad, p = entropy["claims-slide", "1.5"], moved["claims-slide", "1.5"]["p"]
    assert f"{broad:.1f} nats broader and moves the puck farther (p = {p:.2g})" in TEXT
    equal = ("equal-entropy-fixed", "equal-entropy", "equal-entropy-slide")
    less = {q: [f"{-moved[study, q]['difference']:.1f}" for study in equal] for q in Q[1:]}
    far = "{} and {} cm less far on FetchPush (fixed and learned α) and {} cm on FetchSlide"
    assert far.format(*less["1.5"]) in TEXT
    assert "q = 2 {}, {} and {} cm (exclude 0)".format(*less["2"]) in TEXT
    assert all(moved[study, "1.5"]["95"][1] > 0 > moved[study, "2"]["95"][1] for study in equal)
    fixed, learned, slide = (entropy[study, "2"] for study in equal)
    assert (
        f"policies of q = 2 are {-fixed:.1f} and {-learned:.1f} nats narrower than those of q = 1 "
        f"on FetchPush, and {slide:.1f} nats broader on FetchSlide."
    ) in TEXT
    wide = ("joint-her", "joint-pick", "joint-pick-fresh")
    broader = [entropy[study, "2"] for study in wide]
    assert f"of q = 2 are {min(broader):.1f} to {max(broader):.1f} nats broader" in TEXT
    assert all(moved[study, "2"]["95"][0] < 0 < moved[study, "2"]["95"][1] for study in wide)
    final = [last("claims-pick-and-place", MEAN, "music-r", q).mean() for q in Q]
    assert f"ends at {final[0]:.0%} success, q = 1.5 at {final[1]:.0%}." in TEXT
    early_on = [early(*each, q, ENTROPIES[0]).mean() for each in TEN_Q[1:2] for q in Q]
    (wider,) = {f"{early_on[0] - other:.1f}" for other in early_on[1:]}
    assert f"early in training q = 1 is {wider} nats broader" in TEXT


def test_the_grid_behind_the_joint_form_on_fetchpush() -> None:
    study = "joint-music-alpha"
    own, found = runs(study, "music-r"), grid(study, ("music-r",))
    final = own.assign(end=[curve(study, run, ENTROPIES[0])[1][-1] for run in own.run])
    by = {key: f"{end:.1f}" for key, end in final.groupby(["q", "alpha"]).end.mean().items()}
    assert (
        f"q = 1 ends at {by['1', '0.02']}, {by['1', '0.2']} and {by['1', '0.5']} nats at α = 0.02, "
        f"0.2 and 0.5; q = 1.5 at {by['1.5', '0.02']} at α = 0.02; q = 2 at {by['2', '0.2']} and "
        f"{by['2', '0.5']} at α = 0.2 and 0.5. q = 2 also learns at a larger α: at 0.5 it has an "
        f"area of {found['2', '0.5']:.2f}, q = 1 one of {found['1', '0.5']:.2f}."
    ) in TEXT
    assert f"q = 1.5 by only {found['1.5', '0.05'] - found['1.5', '0.1']:.2f}." in TEXT


def test_how_the_studies_on_fetchpush_end() -> None:
    assert f"the medians are equal; a{ends('joint-music')}." in TEXT
    assert f"q = 1.5 end {apart('joint-music', ENTROPIES[0], 1)[0]} nats narrower" in TEXT
    behind = -planned("equal-entropy-fixed", "music-r")[0]["difference"]
    assert f"(next section) the difference is {behind:.2f} and not decided" in TEXT
    study = "equal-entropy-fixed"
    final = [last(study, ENTROPIES[0], "music-r", q).mean() for q in Q]
    assert max(final) - min(final) < 0.01
    assert planned(study, "music-r")[0]["95"][1] < 0.015
    assert f"of 0.015 or more. A{ends(study)} success." in TEXT
    assert f"hindsight-alone). A{ends('joint-her', 'her')} success." in TEXT
    assert f"for each q. A{ends('claims-push')} success" in TEXT
    broader = " and ".join(apart("claims-push", ENTROPIES[0], 2))
    assert f"Policies of q = 1.5 and 2 end {broader} nats broader" in TEXT
    gap = compared(
        *(areas_of_all_steps("joint-music", s, MEAN, 30_000) for s in ("music-r", "her"))
    )
    low, high = (f"{-end:.2f}" for end in gap["95"])
    below = (
        f"{-gap['difference']:.2f} below that of HER alone (95% CI {high} to {low}, not planned)"
    )
    assert f"its area at q = 1 is {below}" in TEXT
    deviations = [
        f"{min(found):.2f} to {max(found):.2f}" for found in map(spread, ("equal-entropy", study))
    ]
    assert "deviation of {}, against {} with a fixed α".format(*deviations) in TEXT


def test_runs_that_diverged() -> None:
    diverged = {}
    for study, stage in TEN_Q:
        most = extremes(study, "critics/mean").abs().max(axis=1)
        for run in runs(study, stage).itertuples():
            if most[run.run] > 100:
                diverged[study, run.q, run.seed] = curve(study, run.run, MEAN)[1][-1]
    assert [key[:2] for key in diverged] == [("equal-entropy", "2")] * 2 + [
        ("joint-pick-fresh", "1.5"),
        ("claims-pick-and-place", "2"),
    ]
    key, final = list(diverged.items())[2]
    (run,) = runs("joint-pick-fresh", "music-r").query("q == '1.5' and seed == @key[2]").run
    lowest = curve("joint-pick-fresh", run, ENTROPIES[0])[1].min()
    seeds = len(last("joint-pick-fresh", MEAN, "music-r", "1.5"))
    assert f"One run of {seeds} with q = 1.5 diverged {rate(1, seeds)}, as" in TEXT
    assert f"narrowed to {lowest:.1f} nats (seed {key[2]}), and ended at {final:.0%}" in TEXT
    larger, between, _ = planned("joint-pick-fresh", "music-r", left_out=key[2])
    assert (larger["verdict"], between["verdict"]) == ("undecided", "worse")
    words = in_words(between, planned=True).split("**, ")[1].split(";")[0]
    assert f"would be undecided, and q = 2 worse than q = 1.5: {words})" in TEXT
    seeds = len(last("equal-entropy", MEAN, "music-r", "2"))
    assert f"**diverged in two of {seeds} runs** {rate(2, seeds)}" in TEXT
    *_, (key, final) = diverged.items()
    forms = ("claims-push", "claims-pick-and-place", "claims-slide")
    every = sum(len(last(study, MEAN, "music-r", "2")) for study in forms)
    assert f"(seed {key[2]}) and ended at {final:.0%} success." in TEXT
    assert f"one run of {every} with q = 2 {rate(1, every)}" in TEXT
    at = [last("claims-pick-and-place", MEAN, "music-r", q)[1004] for q in Q]
    assert f"there all q end at {100 * min(at):.0f} to {max(at):.0%}." in TEXT
    bounded = runs("equal-entropy-bounded", "music-r").query("seed in [7501, 7507]").run
    assert min(curve("equal-entropy-bounded", run, MEAN)[1][-1] for run in bounded) > 0.9


def test_the_observations_in_the_joint_form_on_fetchpickandplace() -> None:
    study = "joint-pick-fresh"
    final = {q: last(study, MEAN, "music-r", q) for q in Q}
    one, larger, two = (f"{final[q].mean():.0%}" for q in Q)
    gap = interval(final["1.5"] - final["1"], ".0%")
    behind = 100 * (final["1"] - final["2"])
    assert (
        f"q = 1.5 ends at {larger}, q = 1 at {one} (95% CI of the difference {gap}), and q = 2 at "
        f"{two}, {behind.mean():.0f} percentage points below q = 1 (95% CI "
        f"{interval(behind, '.0f')}; not planned)."
    ) in TEXT
    many = [sum(final[q] >= 0.9) for q in Q]
    broader = apart(study, ENTROPIES[0], 1)[1]
    assert (
        f"{many[0]} of {len(final['1'])} runs reach 90% at q = 1, {many[1]} at q = 1.5, and "
        f"{many[2]} at q = 2, whose policies end {broader} nats broader than those of q = 1."
    ) in TEXT
    both = {
        q: pd.concat([areas(each, "music-r", q, MEAN) for each in (study, "joint-pick")]) for q in Q
    }
    larger, two = (
        in_words(compared(both[q], both["1"]), planned=False).split(";")[0] for q in Q[1:]
    )
    assert (
        f"With the seeds of the first study, {len(both['1'])} in all (not planned), the area at "
        f"q = 1.5 minus that at q = 1 is {larger}), and q = 2 minus q = 1 {two})."
    ) in TEXT


def test_the_success_of_all_runs_of_music_on_fetchpickandplace() -> None:
    others = "pick-and-place-in-80000-steps", "intrinsic-rewards-pick"
    studies = ("joint-pick-fresh", "joint-pick", *others)
    finals = [last(study, MEAN, "music-r", "1") for study in studies]
    every = pd.concat(finals)
    _, low, high = rate_interval(every.to_numpy(), 50)
    first, second, _, other = (f"{one.mean():.0%}" for one in finals)
    assert (
        f"MUSIC-r with the same settings ends at {first} and {second} in the studies of 35 and of "
        f"ten seeds in the section above, and at {other} on those ten: on all {len(every)} seeds "
        f"at {every.mean():.0%} (95% CI {low:.0%} to {high:.0%}), {sum(every >= 0.9)} of them at "
        "90% or more."
    ) in TEXT
    assert f"({every.mean():.0%} over {len(every)} seeds of four studies)" in README


def test_the_median_that_the_plan_asked_for() -> None:
    median = last("pick-and-place-in-80000-steps", MEAN, "music-r", "1").median()
    assert f"it is ahead (median {median:.0%}; the plan asked for 90%)" in TEXT


def test_fetchpickandplace_at_equal_total_steps() -> None:
    study, total = "claims-pick-and-place", 200_000
    claim = compared(*(areas_of_all_steps(study, s, MEAN, total) for s in ("music-r", "her")))
    grid_of = np.arange(50_000, total + 1, 5_000)
    own, alone = runs(study, "music-r").query("q == '1'").run, runs(study, "her").run

    def mean(of: pd.Series, after: int) -> Array:
        curves = [curve(study, run, MEAN) for run in of]
        found: Array = np.mean(
            [np.interp(grid_of, steps + after, v) for steps, v in curves], axis=0
        )
        return found

    first, second = mean(own, 50_000), mean(alone, 0)
    ahead = first > second
    low, high = sorted((grid_of[ahead.argmax()], grid_of[~ahead][-1]))
    assert (
        f"differs from that of HER alone by {in_words(claim, planned=False)}; success at the end "
        f"is {first[-1]:.0%} against {second[-1]:.0%}, and the mean curves cross between {low:,} "
        f"and {high:,} steps."
    ) in TEXT


def test_fetchslide_in_both_forms() -> None:
    assert (
        max(abs(end) for one in planned("joint-slide", "music-r")[:3] for end in one["90"]) < 0.03
    )
    below = -planned("joint-slide", "music-r")[3]["difference"]
    assert f"its area at q = 1 is {below:.2f} below that of HER alone" in TEXT
    assert f"fetchslide)), a{ends('claims-slide')}." in TEXT
    broader = " and ".join(apart("claims-slide", ENTROPIES[0], 1))
    sides = [areas("claims-slide", "music-r", q, SAMPLED) for q in Q]
    gaps = [in_words(compared(one, sides[0]), planned=False).split(";")[0] for one in sides[1:]]
    assert f"Policies of q = 1.5 and 2 end {broader} nats broader than those of q = 1" in TEXT
    assert f"the areas differ by {gaps[0]}) and {gaps[1]}; not planned)" in TEXT


def test_the_papers_own_setting() -> None:
    every, rates, starts, planned_runs = 320, {}, [], []
    studies = ("claims-paper-setting", "paper-setting-alpha", "paper-setting-long")
    for study in studies:
        assert set(exported(study)["param.evaluation.episodes"].astype(int)) == {every}
        assert set(exported(study)["param.music.batch_trajectories"]) == {"32"}
        values = pd.read_parquet(DATA / study / "metrics.parquet").sort_values("env_steps")
        moved = values[values.metric == "evaluation/object_moved_share"].groupby("run").value
        for run in runs(study, "music-r").itertuples():
            rates[study, run.alpha, run.q] = curve(study, run.run, MEAN)[1]
            assert round(10 * moved.get_group(run.run).iloc[-12:].mean()) >= 9
        (before,) = runs(study, "pretrain").run
        starts.append(curve(study, before, MEAN)[1][0])
        assert f"complete, {len(exported(study))} of {len(exported(study))} runs" in TEXT
        epochs = {run.budget // 80_000 for run in runs(study, "music-r").itertuples()}
        planned_runs.append((runs(study, "pretrain").budget.item() // 80_000, *epochs))
    assert planned_runs == [(5, 15), (5, 15), (10, 25)]
    first, pilot, longer = studies
    assert "20 of the paper's 100 epochs (5 of MUSIC-u and 15 of MUSIC-r" in TEXT
    assert "35 epochs (10 and 25), at α = 0.2 with q = 1 and 1.5 (" in TEXT
    late = [rates[first, "0.2", "1"][-5:]]
    late += [rates[pilot, alpha, "1"][-5:] for alpha in ("0.02", "0.05", "0.5")]
    counts = [round(one.sum() * every) for one in late]
    shares = "{:.1%}, {:.1%}, {:.1%} and {:.1%}".format(*(one.mean() for one in late))
    each = "{} (α = 0.2), {} (0.02), {} (0.05) and {} (0.5)".format(*counts)
    assert f"succeed in {each} of {5 * every:,} episodes ({shares}), " in TEXT
    one, half = (rates[longer, "0.2", q][-10:] for q in ("1", "1.5"))
    each = f"{one.sum() * every:.0f} (q = 1) and {half.sum() * every:.0f} (q = 1.5)"
    shares = f"{one.mean():.1%} and {half.mean():.1%}"
    assert f"the longer runs in {each} of {10 * every:,} ({shares}), before" in TEXT
    ends = "{:.0f}, {:.0f} and {:.0f}".format(*(start * every for start in starts))
    share = "{:.1%}, {:.1%} and {:.1%}".format(*starts)
    assert f"before any training in {ends} of {every} ({share})" in TEXT
    # Thresholds: 50 % for the first run and the longer ones, 15 % for other α.
    assert max(map(np.mean, (late[0], one, half))) < 0.5
    assert max(map(np.mean, late[1:])) < 0.15


def test_the_bonus_for_moving_the_object() -> None:
    rows = {row[0]: row for row in table("## Intrinsic rewards on FetchPickAndPlace", DETAILS)}
    _, verdict, _, final, *_ = rows["displacement"]  # recomputed with the table
    numbers = verdict.rsplit(";", 1)[0]
    assert f"it is {numbers}, and ends at {final.split()[0]} ([eight rewards]" in TEXT
    rows = {row[0]: row for row in table("## Intrinsic rewards on FetchPush", DETAILS)}
    _, verdict, *_, seeds = rows["music-r"]
    numbers = verdict.rsplit(";", 1)[0]
    assert f"20,000 steps ({WORDS[int(seeds)]} seeds) it is {numbers} ([eight rewards]" in TEXT


def test_figures_of_the_readme() -> None:
    study = "push-in-30000-steps"
    curves = [curve(study, run, MEAN) for run in runs(study, "her").run]
    reached = np.array([rates.max() >= 0.9 for _, rates in curves])
    waits = np.array([steps[np.argmax(rates >= 0.9)] for steps, rates in curves])
    assert reached.all()
    median, low, high = re.findall(r"[\d,]+\d", median_wait(waits, reached))
    assert f"[{median} steps]" in README
    assert f"(median of ten seeds, 95% CI {low} to {high})" in README
    for (task, _), (of, stage) in STUDIES.items():
        if of in ("joint-music", "joint-pick-fresh", "joint-slide"):
            assert re.search(
                rf"\[{task}\]\S*, joint entropy, {len(last(of, MEAN, stage, '1'))} seeds", README
            )
