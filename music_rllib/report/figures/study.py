"""Figures of a study's primary metric: its performance profile, and its dependence on α."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogFormatter

from music_rllib.report.figures.palette import Style
from music_rllib.report.figures.plots import RATE_LIMITS, Panel
from music_rllib.results import statistics as st
from music_rllib.results.conditions import Condition
from music_rllib.results.study import MOST_CONDITIONS, AlphaLine, Mean, alpha_sensitivity

MOST_TICKS = 8
"""Largest number of values of α that each have a tick."""


def area_profile_panels(means: Sequence[Mean], styles: Mapping[Condition, Style]) -> list[Panel]:
    """Share of finished runs above each mean success rate: a panel per task that has a success."""
    rates = [mean for mean in means if mean.measure.is_rate]
    by_task = [(task, list(found)) for task, found in groupby(rates, key=lambda mean: mean.task)]
    return [
        _profile(task, found, styles)
        for task, found in by_task
        if 1 < len(found) <= MOST_CONDITIONS
    ]


def _profile(task: str, means: Sequence[Mean], styles: Mapping[Condition, Style]) -> Panel:
    thresholds = np.linspace(0.0, 1.0, 101)

    def draw(axes: Axes) -> None:
        for mean in means:
            scores = np.array(list(mean.scores.by_seed.values()))[:, np.newaxis]
            profile = st.performance_profile(scores, thresholds)
            colour, line = styles[mean.condition].colour, styles[mean.condition].stroke
            axes.step(thresholds, profile.value, where="post", color=colour, linestyle=line)
            ends = (profile.lower, profile.upper)
            axes.fill_between(thresholds, *ends, color=colour, alpha=0.2, linewidth=0, step="post")
        axes.set_xlabel(f"{means[0].measure.words} τ")
        axes.set_ylabel("share of runs above τ")
        axes.set_ylim(*RATE_LIMITS)

    return Panel(title=task, draw=draw)


def alpha_panels(means: Sequence[Mean], styles: Mapping[Condition, Style]) -> list[Panel]:
    """The primary metric against α with 95 % intervals, a line for each q: a panel per task."""
    lines = groupby(alpha_sensitivity(means), key=lambda line: line.task)
    return [_against_alpha(task, list(found), styles) for task, found in lines]


def _against_alpha(
    task: str, lines: Sequence[AlphaLine], styles: Mapping[Condition, Style]
) -> Panel:
    def draw(axes: Axes) -> None:
        for line in lines:
            style = styles[line.means[0].condition]
            value, ends = line.estimate.value, (line.estimate.lower, line.estimate.upper)
            axes.plot(line.alphas, value, color=style.colour, marker=style.marker, linewidth=1.8)
            axes.fill_between(line.alphas, *ends, color=style.colour, alpha=0.15, linewidth=0)
        alphas = np.unique(np.concatenate([line.alphas for line in lines]))
        if alphas[0] > 0 and alphas[-1] / alphas[0] > 5:
            axes.set_xscale("log")
        if len(alphas) <= MOST_TICKS:
            axes.set_xticks(alphas, [f"{alpha:g}" for alpha in alphas], minor=False)
            axes.set_xticks([], minor=True)
        elif axes.get_xscale() == "log":
            # The scale's own labels are formulas, but text.parse_math is off.
            axes.xaxis.set_major_formatter(LogFormatter())
        axes.set_xlabel("α")
        axes.set_ylabel(lines[0].means[0].measure.words)

    return Panel(title=task, draw=draw)
