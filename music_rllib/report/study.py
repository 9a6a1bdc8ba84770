"""The claims of a study: tables for the page, CSV files and figures."""

from __future__ import annotations

from collections.abc import Iterator

from music_rllib.report.figures.choice import SETTINGS, Drawing
from music_rllib.report.figures.palette import styles_of
from music_rllib.report.figures.study import alpha_panels, area_profile_panels
from music_rllib.report.pieces import DASH, TextTable, estimate_cells, number_cell
from music_rllib.report.tables import Table
from music_rllib.results.answer import (
    claim_rows,
    interval_in_words,
    mean_rows,
    not_excluded,
    p_in_words,
    verdict_in_words,
)
from music_rllib.results.statistics import SHOW_SEEDS_BELOW, number
from music_rllib.results.study import Study, alpha_sensitivity


def study_tables(study: Study) -> list[TextTable]:
    """The comparisons, planned ones first, and the primary metric of each condition."""
    return [_claims_table(study), _means_table(study)]


def _kind(study: Study) -> str:
    """What conditions are compared by: `area under the curve`."""
    return study.means[0].measure.kind_in_words if study.means else "area under the curve"


def _claims_table(study: Study) -> TextTable:
    claims = (*study.planned, *study.unplanned)
    measures = " or ".join(dict.fromkeys(claim.measure.words for claim in claims))
    return TextTable(
        title=f"Comparisons by the {_kind(study)}",
        header=("Task", "Pair", "Difference", "Interval", "p", "Verdict", "Planned", "Seeds"),
        rows=[
            (
                claim.task,
                f"{claim.first} against {claim.second}",
                number_cell(f"{float(claim.contrast.difference.value):+.3g}"),
                interval_in_words(claim),
                p_in_words(claim).removeprefix("p = ") or DASH,
                f"{verdict_in_words(claim)}{not_excluded(claim)}",
                "yes" if claim.planned else "no",
                " and ".join(map(str, dict.fromkeys(claim.contrast.seeds))),
            )
            for claim in claims
        ],
        note=f"Differences in {measures}, of paired seeds where both sides have the same ones "
        "(Student's t, Welch's otherwise); equivalence by two one-sided tests (TOST). The planned "
        "comparisons, or without a plan all of them, are one family with adjusted p-values (Holm). "
        "A failed run counts with the worst value.",
    )


def _means_table(study: Study) -> TextTable:
    rows = [
        (
            mean.task,
            mean.condition.short_label,
            mean.measure.words,
            *estimate_cells(mean.estimate),
            " ".join(map(number, sorted(mean.scores.by_seed.values())))
            if len(mean.scores.by_seed) < SHOW_SEEDS_BELOW
            else DASH,
            f"{mean.scores.finished} of {mean.runs}",
        )
        for mean in study.means
    ]
    return TextTable(
        title=f"{_kind(study).capitalize()} of each condition",
        header=("Task", "Condition", "Measure", "Mean", "95 % interval", "Each seed", "Finished"),
        rows=rows,
        note="The area is the mean over the budget, by the trapezoid rule. A failed run counts "
        "with the worst value.",
    )


def study_csv(study: Study) -> Iterator[Table]:
    """The same numbers unrounded, and the primary metric as a function of α."""
    means = [row | {"by_seed": _seed_scores(row["by_seed"])} for row in mean_rows(study)]
    claims = [row | {"seeds": " ".join(map(str, row["seeds"]))} for row in claim_rows(study)]
    for row in claims:
        row["in_words"] = "; ".join(filter(None, row["in_words"]))
    for name, rows in (("area_under_curve", means), ("comparisons", claims)):
        columns = " ".join(rows[0]) if rows else ""
        yield Table(name=name, columns=columns, rows=[list(row.values()) for row in rows])
    yield Table(
        name="alpha_sensitivity",
        columns="task entropic_index others alpha mean lower upper seeds",
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
            for line in alpha_sensitivity(study.means)
            for point, mean in enumerate(line.means)
        ],
    )


def _seed_scores(by_seed: dict[str, float]) -> str:
    return " ".join(f"{seed}:{score:g}" for seed, score in by_seed.items())


def study_drawings(study: Study) -> Iterator[Drawing]:
    """The performance profile of the primary metric, and its dependence on α."""
    if study.stage is None:
        return
    styles, kind = styles_of(study.stage.compared), _kind(study)
    shown = list(dict.fromkeys(mean.condition for mean in study.means))
    if profiles := area_profile_panels(study.means, styles):
        yield Drawing(
            stage=study.stage.name,
            title=f"Performance profile of the {kind}",
            caption="Share of finished runs above each value, with 95 % bands at each point.",
            panels=tuple(profiles),
            legend=[(condition.short_label, styles[condition]) for condition in shown],
        )
    if lines := alpha_panels(study.means, styles):
        by_q = {one.entropic_index: styles[one] for one in reversed(shown)}
        yield Drawing(
            stage=study.stage.name,
            title=f"{kind.capitalize()} against α",
            group=SETTINGS,
            caption="Mean over the seeds with its 95 % interval, a line for each q: what a "
            "comparison at one α would have found stands at that α.",
            panels=tuple(lines),
            legend=[(f"q = {q}", style) for q, style in reversed(by_q.items())],
        )
