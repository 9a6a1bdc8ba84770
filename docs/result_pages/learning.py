"""Learning curves over total environment steps, with pretraining; the picture of the README."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes

from docs.result_pages.exports import is_complete
from docs.result_pages.figures import figure
from docs.result_pages.summary import BETWEEN_STAGES, STUDIES, compared, complete_studies
from music_rllib import names
from music_rllib.report.figures.choice import Drawing
from music_rllib.report.figures.draw import files
from music_rllib.report.figures.plots import Style, Subplot, curve_subplot, styles_of
from music_rllib.results import statistics as st
from music_rllib.results.analysis import METRICS, Curve, curve
from music_rllib.results.conditions import Condition, find_stages
from music_rllib.results.data import Sweep
from music_rllib.results.scores import with_pretraining
from music_rllib.results.statistics import Array
from music_rllib.results.study import study_of

PRETRAINING = ("MUSIC-u (pretraining)", Style("#9a9a9a", "o"))
IN_THE_PICTURE = (
    "joint-music",
    "joint-pick-fresh",
    "joint-slide",
    "joint-her",
    "claims-push",
    "pick-and-place-in-80000-steps",
)
"""Studies with a subplot, six of which fit. The first row has those of the README's table."""
SCRATCH = ("HER alone, q = 1", Style("#4d4d4d", "D", (6, 3)))
(SUCCESS,) = (metric for metric in METRICS if metric.name == names.EVAL_SUCCESS)


def learning_figure(sweep: Sweep, figures: dict[str, Drawing]) -> Iterator[str]:
    """The mean action and the sampled policy side by side."""
    (task,) = {run.task for run in sweep.runs}
    legend = _legend(sweep)
    evaluated = [_shifted(sweep, curve(sweep, c, task, names.EVAL_SUCCESS)) for c in legend]
    sampled = [_shifted(sweep, _sampled(sweep, c, task)) for c in legend]
    drawing = Drawing(
        stage="all stages",
        title="Success",
        caption="",
        subplots=(
            _subplot("mean action", evaluated, legend),
            _subplot("sampled policy", sampled, legend),
        ),
        legend=list(legend.values()),
    )
    yield from figure(sweep, drawing, figures)


def peers_figure(sweep: Sweep, figures: dict[str, Drawing]) -> Iterator[str]:
    """A subplot for each stage that a plan compares with another one; none until it is complete."""
    if not is_complete(sweep):
        return
    styles = {"HER alone": SCRATCH[1], "with the reward": Style("#1f7fc4", "o")}
    subplots = []
    for claim in study_of(sweep).planned:
        ((own, other),) = claim.pairs
        legend = dict(zip((other, own), styles.items(), strict=True))
        curves = [_shifted(sweep, curve(sweep, c, claim.task, SUCCESS.name)) for c in legend]
        subplots.append(_subplot(claim.first.removeprefix(BETWEEN_STAGES), curves, legend))
    drawing = Drawing(
        stage="rewards",
        title="Success",
        caption="",
        subplots=tuple(subplots),
        legend=list(styles.items()),
    )
    yield from figure(sweep, drawing, figures)


def overview() -> bytes:
    """A PNG of one complete study of each task, and of three others."""
    subplots: list[Subplot] = []
    entries: dict[str, Style] = {}
    studies = {sweep.name: (sweep, study) for sweep, study in complete_studies()}
    for sweep, study in (studies[name] for name in IN_THE_PICTURE if name in studies):
        legend = _legend(sweep)
        first = study.planned[0]
        curves = [_shifted(sweep, curve(sweep, c, first.task, SUCCESS.name)) for c in legend]
        setting = STUDIES[sweep.name].replace(", ", "\n")
        title = f"{first.task}, {first.contrast.seeds[0]} seeds\n{setting}"
        subplots.append(_subplot(title, curves, legend))
        entries |= dict(legend.values())
    ordered = sorted(entries.items(), key=lambda entry: not entry[0].startswith("q"))
    return files(subplots, ordered)[".png"]


def _legend(sweep: Sweep) -> dict[Condition, tuple[str, Style]]:
    """Label and style of the conditions that the plan compares, and of the pretraining.

    Conditions compared by q have the color of their q.
    """
    pairs = [pair for claim in compared(study_of(sweep)) for pair in claim.pairs]
    planned = [condition for pair in pairs for condition in pair]
    legend: dict[Condition, tuple[str, Style]] = {}
    for stage in find_stages(sweep):
        if not stage.has_task_reward:
            legend |= dict.fromkeys(stage.conditions, PRETRAINING)
            continue
        shown = tuple(condition for condition in stage.conditions if condition in planned)
        from_scratch = stage.variant == "tac" and len(shown) == 1
        for condition, style in styles_of(shown).items():
            own = f"q = {condition.entropic_index}", style
            legend[condition] = SCRATCH if from_scratch else own
    return legend


def _subplot(
    title: str, curves: list[Curve], legend: dict[Condition, tuple[str, Style]]
) -> Subplot:
    styles = {condition: style for condition, (_, style) in legend.items()}
    metric = replace(SUCCESS, target=None)
    subplot = curve_subplot(metric, title, curves, styles)

    def draw(axes: Axes) -> None:
        subplot.draw(axes)
        axes.set_xlabel("total environment steps")

    return replace(subplot, draw=draw)


def _shifted(sweep: Sweep, found: Curve | None) -> Curve:
    """The curve shifted by the pretraining steps of its runs."""
    assert found is not None, "runs of a complete study have been evaluated"
    own, whole = (
        one.least_budget(found.task, found.condition.runs)
        for one in (sweep, with_pretraining(replace(sweep, history={})))
    )
    return replace(found, steps=found.steps + whole - own)


def _sampled(sweep: Sweep, condition: Condition, task: str) -> Curve | None:
    """Success rate of training episodes, averaged between two evaluations."""
    evaluated = curve(sweep, condition, task, names.EVAL_SUCCESS)
    if evaluated is None:
        return None
    runs = condition.runs
    values = np.stack([_between(sweep, run, evaluated.steps) for run in runs])
    return replace(
        evaluated,
        steps=evaluated.steps[1:],
        values=values,
        estimate=st.estimate(values[:, np.newaxis], np.inf),
        runs=np.full(values.shape[1], len(runs)),
    )


def _between(sweep: Sweep, run: int, ends: Array) -> Array:
    steps, values = sweep.finite(run, names.TRAIN_SUCCESS)
    return np.array([values[(steps > a) & (steps <= b)].mean() for a, b in pairwise(ends)])
