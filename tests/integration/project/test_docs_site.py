"""The documentation site: built, opened from disk, and searched, without a network."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.integration.devtools import Page

ROOT = Path(__file__).parents[3]
"""Folder for screenshots, such as docs/img."""


@pytest.mark.parametrize("page", ["configuration", "results"])
def test_generated_pages_are_up_to_date(page: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", f"docs.generate_{page}", "--check"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_site_is_built_read_and_searched(
    require_service: Callable[[str], Path], tmp_path: Path
) -> None:
    site = tmp_path / "site"
    done = subprocess.run(
        [sys.executable, str(ROOT / "docs" / "build_site.py"), str(site)],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stdout + done.stderr

    async def read() -> None:
        async with Page(require_service("chromium"), tmp_path, width=1400) as tab:
            for page, words in (
                ("index", ("Two commands", "Comparing values of q")),
                ("configuration", ("tac.entropic_index", "Higher values explore longer")),
                ("api", ("load_sweep", "TACConfig")),
                ("results", ("FetchPush",)),
            ):
                await tab.go((site / f"{page}.html").as_uri())
                await tab.wait_for(*words)
            await tab.go((site / "index.html").as_uri())
            await tab.wait_for("Two commands")
            await tab.picture("docs-site.png")
            await tab.go((site / "search.html").as_uri() + "?q=hindsight")
            await tab.wait_for("Search finished", "Algorithms")
            assert not tab.errors
            assert not tab.requests

    asyncio.run(read())
