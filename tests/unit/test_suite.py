"""The suite itself: its slowest files start first."""

from __future__ import annotations

from pathlib import Path

from tests.conftest import LONG

TESTS = Path(__file__).parents[1]


def test_the_files_that_are_begun_first_exist() -> None:
    assert [name for name in LONG if not (TESTS / name).is_file()] == []


def test_make_keeps_that_order() -> None:
    """Without the option, pytest-xdist starts with the files that have many tests."""
    makefile = (TESTS.parent / "Makefile").read_text(encoding="utf-8")
    assert "--dist loadscope --no-loadscope-reorder" in makefile
