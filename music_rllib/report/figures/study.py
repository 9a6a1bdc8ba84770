"""Figures of a study's primary metric: its performance profile, and how it depends on α."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogFormatter

from music_rllib.report.figures.palette import style_of
from music_rllib.report.figures.plots import RATE_LIMITS, Panel
from music_rllib.results import statistics as st
from music_rllib.results.claims.sensitivity import AlphaLine, alpha_sensitivity
from music_rllib.results.claims.study import MOST_CONDITIONS, Mean, Study
from music_rllib.results.conditions import Condition

__all__ = ["alpha_panels", "area_profile_panels"]

MOST_TICKS = 8


def area_profile_panels(study: Study) -> list[Panel]:
    """Share of finished runs above each mean success, a panel for each task that has one."""
    rates = [mean for mean in study.means if mean.measure.is_rate]
    by_task = groupby(rates, key=lambda mean: mean.task)
    found = [(task, list(means)) for task, means in by_task]
    return [
        _profile(task, means, study) for task, means in found if 1 < len(means) <= MOST_CONDITIONS
    ]


def _profile(task: str, means: Sequence[Mean], study: Study) -> Panel:
    thresholds = np.linspace(0.0, 1.0, 101)

    def draw(axes: Axes) -> None:
        for mean in means:
            scores = np.array(list(mean.scores.by_seed.values()))[:, np.newaxis]
            profile = st.performance_profile(scores, thresholds)
            style = style_of(mean.condition, _siblings(study))
            axes.step(
                thresholds, profile.value, where="post", color=style.colour, linestyle=style.stroke
            )
            axes.fill_between(
                thresholds,
                profile.lower,
                profile.upper,
                color=style.colour,
                alpha=0.2,
                linewidth=0,
                step="post",
            )
        axes.set_xlabel(f"{means[0].measure.words} τ")
        axes.set_ylabel("share of runs above τ")
        axes.set_ylim(*RATE_LIMITS)

    return Panel(title=task, draw=draw)


def alpha_panels(study: Study) -> list[Panel]:
    """The primary metric against α with its 95 % intervals, a line for each q; a panel per task."""
    lines = groupby(alpha_sensitivity(study.means), key=lambda line: line.task)
    return [_alpha(task, list(found), study) for task, found in lines]


def _alpha(task: str, lines: Sequence[AlphaLine], study: Study) -> Panel:
    def draw(axes: Axes) -> None:
        for line in lines:
            style = style_of(line.means[0].condition, _siblings(study))
            value, lower, upper = line.estimate.value, line.estimate.lower, line.estimate.upper
            axes.plot(line.alphas, value, color=style.colour, marker=style.marker, linewidth=1.8)
            axes.fill_between(
                line.alphas, lower, upper, color=style.colour, alpha=0.15, linewidth=0
            )
        places = np.concatenate([line.alphas for line in lines])
        if places.min() > 0 and places.max() / places.min() > 5:
            axes.set_xscale("log")
        distinct = np.unique(places)
        if len(distinct) <= MOST_TICKS:
            axes.set_xticks(distinct, [f"{place:g}" for place in distinct], minor=False)
            axes.set_xticks([], minor=True)
        elif axes.get_xscale() == "log":
            # The scale's own labels are formulas, which nothing is read as.
            axes.xaxis.set_major_formatter(LogFormatter())
        axes.set_xlabel("α")
        axes.set_ylabel(lines[0].means[0].measure.words)

    return Panel(title=task, draw=draw)


def _siblings(study: Study) -> tuple[Condition, ...]:
    return study.stage.compared if study.stage else ()
