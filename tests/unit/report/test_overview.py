"""The picture of a sweep: which panels it has, and whose lines are in them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from matplotlib.figure import Figure

from music_rllib import names
from music_rllib.report.build import PICTURE, build_report, write_report
from music_rllib.report.figures.choice import overview
from music_rllib.report.figures.palette import styles_of
from music_rllib.results.analysis import analyse
from music_rllib.results.archive import read_archive
from music_rllib.results.conditions import Condition
from music_rllib.results.data import Sweep

DATA = Path(__file__).parents[3] / "docs" / "results" / "data"


def subplots(sweep: Sweep) -> dict[str, list[str]]:
    """What is drawn of each task, and the legend of that."""
    shown = {}
    for subplot in overview(sweep, [one.stage for one in analyse(sweep)]):
        axes = Figure().add_subplot()
        subplot.draw(axes)
        legend = axes.get_legend()
        assert legend is not None
        shown[f"{subplot.title}: {axes.get_ylabel()}"] = [t.get_text() for t in legend.get_texts()]
    return shown


def test_stages_stand_side_by_side_with_what_music_u_has_learnt() -> None:
    assert subplots(read_archive(DATA / "v3-fetch-push-music-f")) == {
        "FetchPush: success rate": ["her", "music-f"],
        "FetchPush: object displacement (m)": ["her", "pretrain", "music-f"],
        "FetchPush: MI bound (nats)": ["pretrain"],
    }


def test_one_stage_is_told_by_its_q(tmp_path: Path) -> None:
    sweep = read_archive(DATA / "proof-fetch-push-her")
    assert subplots(sweep)["FetchPush: success rate"] == ["q = 1", "q = 1.5", "q = 2"]
    success = {names.EVAL_SUCCESS: sweep.history[names.EVAL_SUCCESS]}
    write_report(build_report(replace(sweep, history=success)), tmp_path)
    assert (tmp_path / "figures" / f"{PICTURE}.png").read_bytes().startswith(b"\x89PNG")


def test_six_alphas_of_a_q_have_lines_of_their_own() -> None:
    conditions = tuple(
        Condition(entropic_index="1", others=(("α", str(a)),), runs=()) for a in range(6)
    )
    styles = styles_of(conditions).values()
    assert len({style.line for style in styles}) == 6
