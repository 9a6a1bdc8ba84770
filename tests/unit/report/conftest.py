"""Figures of pages and of files are empty, except in tests that look at them."""

from __future__ import annotations

import pytest

from music_rllib.report import build, page
from music_rllib.report.figures.choice import Drawing


def no_files(*_: object) -> dict[str, bytes]:
    return {".png": b"", ".svg": b""}


def no_pictures(drawing: Drawing) -> tuple[str, ...]:
    return ("<svg></svg>",) * len(drawing.subplots)


@pytest.fixture
def drawn() -> None:
    """The page and the files have their figures, which take most of a report's time."""


@pytest.fixture(autouse=True)
def _undrawn(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "drawn" not in request.fixturenames:
        monkeypatch.setattr(build, "files", no_files)
        monkeypatch.setattr(page, "inline", no_pictures)
