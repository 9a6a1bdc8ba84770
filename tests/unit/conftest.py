"""Fixtures of all unit tests."""

from __future__ import annotations

import os

import pytest


@pytest.fixture(autouse=True)
def _no_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Thousands of files would each wait for the disk; no unit test cuts the power."""
    monkeypatch.setattr(os, "fsync", lambda _: None)
