"""The overview of a sweep: its subplots and their lines."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from music_rllib.report.figures.choice import overview
from music_rllib.results.analysis import analyse
from music_rllib.results.archive import read_archive
from music_rllib.results.data import Sweep

DATA = Path(__file__).parents[3] / "docs" / "results" / "data"


def subplots(sweep: Sweep) -> dict[str, list[str]]:
    """Task and axis of each subplot, and its legend."""
    shown = {}
    found, below = overview(sweep, [one.stage for one in analyse(sweep)])
    assert not below
    for subplot in found:
        axes = Figure().add_subplot()
        subplot.draw(axes)
        legend = axes.get_legend()
        assert legend is not None
        shown[f"{subplot.title}: {axes.get_ylabel()}"] = [t.get_text() for t in legend.get_texts()]
    return shown


def test_the_overview_shows_all_stages_and_the_bound_of_music_u() -> None:
    assert subplots(read_archive(DATA / "v3-fetch-push-music-f")) == {
        "FetchPush: success rate": ["her", "music-f"],
        "FetchPush: object displacement (m)": ["her", "pretrain", "music-f"],
        "FetchPush: MI bound (nats)": ["pretrain"],
    }


def test_conditions_of_a_single_stage_are_labelled_by_q() -> None:
    sweep = read_archive(DATA / "proof-fetch-push-her")
    assert subplots(sweep)["FetchPush: success rate"] == ["q = 1", "q = 1.5", "q = 2"]


def test_many_conditions_have_one_legend_below_the_subplots() -> None:
    """A legend of nine lines in each subplot would hide them."""
    sweep = read_archive(DATA / "intrinsic-rewards")
    found, below = overview(sweep, [one.stage for one in analyse(sweep)])
    assert {"her", "displacement", "pretrain"} <= {label for label, _ in below}
    for subplot in found:
        axes = Figure().add_subplot()
        subplot.draw(axes)
        assert axes.get_legend() is None
