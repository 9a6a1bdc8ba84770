"""Final values of runs against their policy's entropy: whether q or the entropy explains them."""

from __future__ import annotations

from collections.abc import Mapping

from matplotlib.axes import Axes

from music_rllib import names
from music_rllib.report.figures.palette import Style
from music_rllib.report.figures.plots import RATE_LIMITS, Panel, belongs
from music_rllib.results.conditions import Condition
from music_rllib.results.data import Sweep


def entropy_panel(sweep: Sweep, task: str, styles: Mapping[Condition, Style]) -> Panel | None:
    """A point for each finished run on the task: its final value over its final Shannon entropy.

    Returns:
        None if fewer than two runs have an entropy.
    """
    metric = sweep.primary_metric(task)
    is_rate = metric in names.EVAL_RATES
    points = {
        condition: [
            (entropy, score)
            for run in condition.runs
            if sweep.runs[run].task == task
            and sweep.runs[run].status == "FINISHED"
            and (entropy := sweep.final(run, names.SHANNON_ENTROPY)) is not None
            and (score := sweep.final(run, metric)) is not None
        ]
        for condition in styles
    }
    if sum(map(len, points.values())) < 2:
        return None

    def draw(axes: Axes) -> None:
        for number, (condition, pairs) in enumerate(points.items()):
            style = styles[condition]
            entropies, scores = zip(*pairs, strict=True) if pairs else ((), ())
            marks = axes.plot(
                entropies, scores, style.marker,
                color=style.colour, markersize=6, alpha=0.75, mew=0,
            )  # fmt: skip
            belongs(marks, number, condition.label)
        axes.set_xlabel("Shannon entropy at the end (nats)")
        axes.set_ylabel("final success rate" if is_rate else f"final {names.word_of(metric)}")
        if is_rate:
            axes.set_ylim(*RATE_LIMITS)

    return Panel(title=task, draw=draw)
