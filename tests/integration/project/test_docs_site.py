"""The documentation site: built, opened from disk, and searched, without a network."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

from tests.integration.devtools import Page
from tests.processes import fresh

ROOT = Path(__file__).parents[3]
"""Folder for screenshots, such as docs/img."""


def test_the_page_of_settings_is_up_to_date() -> None:
    fresh("-m", "docs.generate_configuration", "--check", cwd=ROOT)


def test_the_site_is_built_read_and_searched(
    require_service: Callable[[str], Path], tmp_path: Path
) -> None:
    site = tmp_path / "site"
    fresh(ROOT / "docs" / "build_site.py", site, cwd=tmp_path)

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
