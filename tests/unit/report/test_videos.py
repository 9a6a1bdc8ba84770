"""Which videos a report has."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from music_rllib.report import videos
from music_rllib.report.figures.choice import slug
from music_rllib.results.analysis import analyse
from music_rllib.results.data import RunRecord
from tests.unit.results.test_frames import of_stage


def test_videos_of_schedules_with_the_same_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def made(storage: str, run: RunRecord, q: str, environments: Any) -> videos.Video:
        return videos.Video(label=q, caption="", file=slug(q), data=b"")

    monkeypatch.setattr(videos, "_record", made)
    linear = {"schedule": "linear", "start": 1.0, "end": 2.0}
    steps = {"schedule": "piecewise", "points": [[0, 1.0], [30000, 2.0]]}
    sweep = of_stage(tmp_path, {"grid": {"tac.entropic_index": [linear, steps]}})
    files = [v.file for v in videos.make_videos(sweep, analyse(sweep), "x").videos]
    assert len(set(files)) == 2
    qs = [0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, 2.5]
    sweep = of_stage(tmp_path, {"grid": {"tac.entropic_index": qs}})
    found = videos.make_videos(sweep, analyse(sweep), "x")
    assert len(found.videos) == 6
    assert found.missing == "q = 2, q = 2.5: a report has at most 6 videos"
