"""A study in a report: its tables, on the page and as CSV, and its figures."""

from __future__ import annotations

from collections.abc import Iterator

from music_rllib.report.figures.choice import SETTINGS, Drawing
from music_rllib.report.figures.palette import style_of
from music_rllib.report.figures.study import alpha_panels, area_profile_panels
from music_rllib.report.pieces import TextTable, number
from music_rllib.report.tables import Table
from music_rllib.results.claims.contrasts import Verdict
from music_rllib.results.claims.sensitivity import alpha_sensitivity
from music_rllib.results.claims.study import Claim, Study, label_of
from music_rllib.results.claims.tables import claim_rows, mean_rows
from music_rllib.results.comparison import SHOW_SEEDS_BELOW, interval_text, p_text
from music_rllib.results.comparison import number as in_short

__all__ = ["AGAINST_ALPHA", "study_csv", "study_drawings", "study_tables"]

DASH = "–"
AGAINST_ALPHA = "Area under the curve against α"


def study_tables(study: Study) -> list[TextTable]:
    """The comparisons, the planned ones first, and the primary metric of each condition."""
    return [_claims(study), _means(study)]


def _claims(study: Study) -> TextTable:
    return TextTable(
        title="Comparisons by the area under the curve",
        header=("Task", "Pair", "Difference", "95 % interval", "p", "Verdict", "Planned", "Seeds"),
        rows=[
            (
                one.task,
                f"{one.first} against {one.second}",
                number(in_short(one.contrast.difference.value)),
                interval_text(one.contrast.difference),
                _p(one),
                f"{one.verdict} within {one.margin:g}"
                if one.verdict is Verdict.EQUIVALENT
                else str(one.verdict),
                "yes" if one.planned else "no",
                " and ".join(map(str, dict.fromkeys(one.contrast.seeds))),
            )
            for one in (*study.planned, *study.afterwards)
        ],
        note="Differences of a seed where seeds are shared (Student's t, Welch's otherwise); "
        "equivalence by two one-sided tests. Holm's correction over what was planned, and over the "
        "rest.",
    )


def _p(claim: Claim) -> str:
    if claim.verdict is Verdict.EQUIVALENT and claim.p_equivalent is not None:
        return p_text(claim.p_equivalent)
    return p_text(claim.p_value)


def _means(study: Study) -> TextTable:
    rows = [
        (
            one.task,
            label_of(one.condition),
            one.measure.words,
            number(in_short(one.estimate.value)),
            interval_text(one.estimate),
            " ".join(map(in_short, sorted(one.scores.by_seed.values())))
            if len(one.scores.by_seed) < SHOW_SEEDS_BELOW
            else DASH,
            f"{len(one.scores.by_seed)} of {one.runs}",
        )
        for one in study.means
    ]
    return TextTable(
        title="Area under the learning curve",
        header=("Task", "Condition", "Measure", "Mean", "95 % interval", "Each seed", "Finished"),
        rows=rows,
        note="Mean over the budget by the trapezoid rule, of finished runs.",
    )


def study_csv(study: Study) -> Iterator[Table]:
    """The same unrounded, and the curve over α."""
    means = [row | {"by_seed": _seeds(row["by_seed"])} for row in mean_rows(study)]
    claims = [row | {"seeds": " ".join(map(str, row["seeds"]))} for row in claim_rows(study)]
    for name, rows in (("area_under_curve", means), ("comparisons", claims)):
        columns = list(rows[0]) if rows else []
        yield Table(name=name, columns=columns, rows=[list(row.values()) for row in rows])
    lines = alpha_sensitivity(study.means)
    yield Table(
        name="alpha_sensitivity",
        columns=("task", "entropic_index", "others", "alpha", "mean", "lower", "upper", "seeds"),
        rows=[
            (
                line.task,
                line.entropic_index,
                ", ".join(f"{name} = {value}" for name, value in line.others),
                float(line.alphas[point]),
                float(line.estimate.value[point]),
                float(line.estimate.lower[point]),
                float(line.estimate.upper[point]),
                len(mean.scores.by_seed),
            )
            for line in lines
            for point, mean in enumerate(line.means)
        ],
    )


def _seeds(by_seed: dict[str, float]) -> str:
    return " ".join(f"{seed}:{score:g}" for seed, score in by_seed.items())


def study_drawings(study: Study) -> Iterator[Drawing]:
    """The primary metric's performance profile, and how it depends on α."""
    if study.stage is None:
        return
    shown = list(dict.fromkeys(mean.condition for mean in study.means))
    siblings = study.stage.compared
    legend = [(label_of(one), style_of(one, siblings)) for one in shown]
    if profiles := area_profile_panels(study):
        yield Drawing(
            stage=study.stage.name,
            title="Performance profile of the area under the curve",
            caption="Share of finished runs above each area, with 95 % bands at each point.",
            panels=tuple(profiles),
            legend=legend,
        )
    if lines := alpha_panels(study):
        by_q = {one.entropic_index: style_of(one, siblings) for one in reversed(shown)}
        yield Drawing(
            stage=study.stage.name,
            title=AGAINST_ALPHA,
            group=SETTINGS,
            caption="Mean over the seeds with its 95 % interval, a line for each q: what a "
            "comparison at one α would have found stands at that α.",
            panels=tuple(lines),
            legend=[(f"q = {q}", style) for q, style in reversed(by_q.items())],
        )
