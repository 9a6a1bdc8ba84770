"""The report's page as a reader has it: in every size, pointed at, printed, without a script."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from music_rllib.report.build import build_report
from music_rllib.report.page import render
from music_rllib.results.archive.folder import read_archive
from music_rllib.results.archive.merge import merged
from music_rllib.results.data import Sweep
from tests.integration.devtools import Page

DATA = Path(__file__).parents[2] / "docs" / "results" / "data"
PICTURES = os.environ.get("MUSIC_RLLIB_PICTURES")
"""Folder in which the pictures are kept, such as docs/img."""

LOOK = Path(__file__).with_name("look.js").read_text()
"""Finds text that is cut or too faint, and controls without a name."""
DRAWN = "document.querySelectorAll('.live .chart').length"
CURVES = "document.querySelectorAll('#learning-curves .curve').length"
CHOOSE = """(([label, value]) => {
  const list = [...document.querySelectorAll("#controls select")]
    .find((one) => one.parentElement.textContent.startsWith(label));
  list.value = value;
  list.dispatchEvent(new Event("change"));
})(%r)"""
ENDED = '[aria-label="What runs ended at"]'
AXIS = "document.querySelector('#learning-curves .chart').textContent"


def two_tasks() -> Sweep:
    """Success on one task, the return on the other."""
    push = read_archive(DATA / "proof-fetch-push-her")
    cheetah = read_archive(DATA / "proof-locomotion")
    runs = [replace(run, tags={**run.tags, "stage": "train"}) for run in cheetah.runs]
    return replace(merged(push, replace(cheetah, runs=runs)), name="two-tasks", config=push.config)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = build_report(two_tasks(), command="python -m music_rllib.report results/two-tasks")
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(render(made))
    return path


async def drawn(page: Page, path: Path) -> None:
    await page.go(path.as_uri())
    for _ in range(600):
        if await page.evaluate(DRAWN):
            return
        await asyncio.sleep(0.1)
    raise AssertionError(page.errors)


@pytest.fixture
def open_page(require_service: Callable[[str], Path], tmp_path: Path) -> Callable[[], Page]:
    return lambda: Page(require_service("chromium"), tmp_path)


async def picture(page: Page, folder: Path, name: str) -> None:
    await asyncio.sleep(0.5)
    await page.picture(Path(PICTURES or folder) / name)


def test_the_page_can_be_read_in_every_size_light_and_dark(
    open_page: Callable[[], Page], page: Path, tmp_path: Path
) -> None:
    async def look() -> list[tuple[int, dict[str, Any]]]:
        seen = []
        async with open_page() as tab:
            for width, dark in ((400, False), (800, False), (1400, False), (1400, True)):
                await tab.view(width, 1000, dark=dark)
                await drawn(tab, page)
                await tab.evaluate("[...pending.keys()].forEach(drawNow)")
                seen.append((width, await tab.evaluate(LOOK)))
                await picture(tab, tmp_path, f"report-{width}{'-dark' * dark}.png")
            assert not tab.errors
            assert not tab.requests
        return seen

    for width, seen in asyncio.run(look()):
        assert seen["width"] <= width
        assert seen["charts"] >= 6
        for fault in ("faint", "cut", "small", "nameless", "twice"):
            assert not seen[fault], (width, fault)


def test_what_the_reader_chooses_is_drawn(open_page: Callable[[], Page], page: Path) -> None:
    async def use() -> None:
        async with open_page() as tab:
            await tab.view(1400, 1200)
            await drawn(tab, page)
            whole = await tab.evaluate(CURVES)
            await tab.evaluate("document.querySelectorAll('.chip input')[2].click()")
            await asyncio.sleep(0.5)
            assert 0 < await tab.evaluate(CURVES) < whole
            for axis, words in (
                ("updates", "gradient updates"),
                ("seconds", "wall time (min)"),
                ("epochs", "epochs of 80,000 steps"),
            ):
                await tab.evaluate(CHOOSE % ["against", axis])
                await asyncio.sleep(0.5)
                assert words in await tab.evaluate(AXIS)
            rough = await tab.evaluate(
                "document.querySelector('#learning-curves .curve').outerHTML"
            )
            await tab.evaluate(CHOOSE % ["smooth", "5"])
            await asyncio.sleep(0.5)
            assert rough != await tab.evaluate(
                "document.querySelector('#learning-curves .curve').outerHTML"
            )
            await tab.evaluate(CHOOSE % ["metric", "entropy/tsallis"])
            await asyncio.sleep(0.5)
            assert "Tsallis entropy" in await tab.evaluate(AXIS)
            place = await tab.evaluate(
                "(({x, y, width, height}) => [x + width / 2, y + height / 2])"
                "(document.querySelector('#learning-curves .chart').getBoundingClientRect())"
            )
            await tab.point_at(*place)
            tip = (
                "[...document.querySelectorAll('.tip')].filter((one) => !one.hidden)[0]?.innerText"
            )
            assert "q = 1" in str(await tab.evaluate(tip))
            order = (
                f"[...document.querySelectorAll('{ENDED} tbody tr')]"
                ".map((row) => parseFloat(row.cells[3].textContent.replace(',', '')))"
            )
            button = f"document.querySelectorAll('{ENDED} th button')[3].click()"
            await tab.evaluate(button)
            rising = await tab.evaluate(order)
            assert rising == sorted(rising)
            await tab.evaluate(button)
            assert await tab.evaluate(order) == rising[::-1]
            assert not tab.errors

    asyncio.run(use())


def test_printed_and_without_a_script_everything_is_there(
    open_page: Callable[[], Page], page: Path
) -> None:
    async def use() -> tuple[int, dict[str, Any]]:
        async with open_page() as tab:
            await drawn(tab, page)
            await tab.view(800, 1000, medium="print")
            await tab.evaluate("dispatchEvent(new Event('beforeprint'))")
            charts = await tab.evaluate(DRAWN)
            await tab.view(800, 1000)
            await tab.without_script()
            await tab.go(page.as_uri())
            await tab.wait_for("How to read this")
            seen = await tab.evaluate(LOOK)
            panels = await tab.evaluate(
                "[...document.querySelectorAll('.panels svg')]"
                ".filter((one) => one.clientWidth > 200).length"
            )
            return charts, {**seen, "panels": panels}

    charts, seen = asyncio.run(use())
    assert charts >= 8
    assert seen["charts"] == 0
    assert seen["panels"] >= 8
    assert seen["width"] <= 800
    assert not seen["cut"]
    assert not seen["faint"]
