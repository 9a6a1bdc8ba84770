"""The report's page in a browser: sizes, pointer, keyboard, print, no script, hostile text."""

from __future__ import annotations

import asyncio
import json
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import axe_core_python
import numpy as np
import pytest

from music_rllib import names
from music_rllib.experiment.sweep_files import SweepLocation
from music_rllib.report import live
from music_rllib.report.build import build_report
from music_rllib.report.live import Progress
from music_rllib.report.page import SweepReport, render
from music_rllib.results.archive import merged, read_archive
from music_rllib.results.data import Sweep
from tests.integration.devtools import Page
from tests.unit.report.test_live import write_state
from tests.unit.report.test_page import SCRIPT, hostile

DATA = Path(__file__).parents[3] / "docs" / "results" / "data"
LOOK = Path(__file__).with_name("look.js").read_text()
"""Finds truncated or low-contrast text in figures, and controls without a name."""
AXE = Path(axe_core_python.__file__).with_name("axe.min.js").read_text()
"""Deque's checks of accessibility: contrast, names, roles, order of headings."""
VIOLATIONS = """axe.run().then((found) => found.violations.map(
  (one) => [one.id, one.nodes.slice(0, 3).map((node) => node.html.slice(0, 200))]))"""
FOCUSED = """(({tagName, type, textContent, id}) => [tagName, type ?? "", textContent.trim(), id])(
  document.activeElement)"""
DRAWN = "document.querySelectorAll('.live .chart').length"
CURVES = "document.querySelectorAll('#learning-curves .curve').length"
CHOOSE = """(([label, value]) => {
  const list = [...document.querySelectorAll("#controls select")]
    .find((one) => one.parentElement.textContent.startsWith(label));
  list.value = value;
  list.dispatchEvent(new Event("change"));
})(%r)"""
ENDED = '[aria-label="Final values"]'
AXIS = "document.querySelector('#learning-curves .chart').textContent"


def two_tasks() -> Sweep:
    """Success on one task, the return on the other."""
    push = read_archive(DATA / "proof-fetch-push-her")
    cheetah = read_archive(DATA / "proof-locomotion")
    runs = [replace(run, tags={**run.tags, "stage": "train"}) for run in cheetah.runs]
    return replace(merged(push, replace(cheetah, runs=runs)), name="two-tasks", config=push.config)


@pytest.fixture(scope="module")
def page(report: SweepReport, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(render(report))
    return path


async def drawn(page: Page, path: Path) -> None:
    await page.go(path.as_uri())
    for _ in range(600):
        if await page.evaluate(DRAWN):
            return
        await asyncio.sleep(0.1)
    raise AssertionError(page.errors)


@pytest.fixture(scope="module")
def report() -> SweepReport:
    return build_report(two_tasks(), command="music-rllib report results/two-tasks")


@pytest.fixture
def open_page(require_service: Callable[[str], Path], tmp_path: Path) -> Callable[[], Page]:
    return lambda: Page(require_service("chromium"), tmp_path)


def test_the_page_is_readable_in_every_size_light_and_dark(
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
                if dark or width == 400:  # takes seconds; LOOK checks the rest
                    await tab.evaluate(AXE)
                    assert await tab.evaluate(VIOLATIONS) == []
                name = "-dark" if dark else "" if width == 1400 else f"-{width}"
                await tab.picture(f"report{name}.png")
            assert not tab.errors
            assert not tab.requests
        return seen

    for width, seen in asyncio.run(look()):
        assert seen["width"] <= width
        assert seen["charts"] >= 6
        for fault in ("faint", "cut", "small", "nameless", "twice"):
            assert not seen[fault], (width, fault)


def test_every_control_works_with_the_keyboard(open_page: Callable[[], Page], page: Path) -> None:
    async def use() -> None:
        async with open_page() as tab:
            await tab.view(1400, 1200)
            await drawn(tab, page)
            whole = await tab.evaluate(CURVES)
            wanted = await tab.evaluate(
                "[...document.querySelectorAll('#controls :is(select, input, button)')]"
                ".filter((one) => one.checkVisibility()).length"
            )
            seen: list[list[str]] = []
            for _ in range(200):
                await tab.press("Tab")
                seen.append(await tab.evaluate(FOCUSED))
                if seen[-1][:2] == ["INPUT", "checkbox"] and whole == await tab.evaluate(CURVES):
                    await tab.press("Space")
                    await asyncio.sleep(0.3)
                    assert await tab.evaluate(CURVES) < whole
                if seen[-1][0] == "BODY":
                    break
            controls = [one for one in seen if one[0] in ("SELECT", "INPUT", "BUTTON")]
            assert len(controls) >= wanted > 3
            await tab.evaluate("document.querySelector('#controls select').focus()")
            await tab.evaluate("controls()")
            assert (await tab.evaluate(FOCUSED))[0] == "SELECT"

    asyncio.run(use())


def test_selections_change_the_curves(open_page: Callable[[], Page], page: Path) -> None:
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
                ("seconds", "training time (min)"),
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
            for cell, key in (("95% CI -0.06 to 0.00", -0.06), ("TOST p < 0.001", 0.001)):
                assert await tab.evaluate(f"sortKey({{textContent: '{cell}'}})") == key
            ticks = await tab.evaluate("ticksOf(0, 0.00061, 3).map(([, text]) => +text)")
            assert ticks == [0, 0.00025, 0.0005]
            await tab.evaluate("location.hash = '#group-performance'")
            await asyncio.sleep(0.3)
            heading = await tab.evaluate(
                "(({x, y, height}) => document.elementFromPoint(x + 5, y + height / 2).tagName)"
                "(document.querySelector('#group-performance h2').getBoundingClientRect())"
            )
            assert heading == "H2", "the controls cover it"
            assert not tab.errors

    asyncio.run(use())


def test_print_and_pages_without_script_have_all_figures(
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
            await tab.wait_for("Method")
            seen = await tab.evaluate(LOOK)
            subplots = await tab.evaluate(
                "[...document.querySelectorAll('.subplots svg')]"
                ".filter((one) => one.clientWidth > 200).length"
            )
            return charts, {**seen, "subplots": subplots}

    charts, seen = asyncio.run(use())
    assert charts >= 8
    assert seen["charts"] == 0
    assert seen["subplots"] >= 8
    assert seen["width"] <= 800
    assert not seen["cut"]
    assert not seen["faint"]


def test_a_script_in_a_sweep_does_not_run(open_page: Callable[[], Page], tmp_path: Path) -> None:
    """Neither escaped text nor injected text runs, thanks to the page's policy."""
    page = render(build_report(hostile()))
    bare = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page)
    injected = f"{SCRIPT[2:]}--><img src=http://127.0.0.1:9/x.png></body>"

    async def seen(tab: Page, text: str) -> tuple[str, list[str]]:
        tab.errors.clear()
        tab.requests.clear()
        (tmp_path / "page.html").write_text(text)
        await tab.go((tmp_path / "page.html").as_uri())
        await tab.wait_for("Method")
        await asyncio.sleep(1.0)
        return " ".join(tab.errors), list(tab.requests)

    async def look() -> None:
        async with open_page() as tab:
            for text in (page, bare):
                assert await seen(tab, text) == ("", [])
            errors, requests = await seen(tab, bare.replace("</body>", injected))
            assert "steal is not defined" in errors, "a script that runs would be noticed"
            assert requests == ["http://127.0.0.1:9/x.png"], "so would a request"
            errors, _ = await seen(tab, page.replace("</body>", injected))
            assert "Content Security Policy" in errors
            assert "steal is not defined" not in errors

    asyncio.run(look())


@pytest.fixture
def serve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[Callable[[], str]], str]]:
    """Serves the page of the sweep `tiny`; yields its address."""
    monkeypatch.setattr(live, "LEAST_PAUSE", 0.2)
    monkeypatch.setattr(live, "PAUSE_FACTOR", 1.0)
    place, opened = SweepLocation(storage=str(tmp_path), name="tiny"), ExitStack()

    def start(make_page: Callable[[], str]) -> str:
        shown = live.LivePage(make_page, Progress(place))
        opened.callback(shown.close)
        http = live.make_server(shown, 0)
        opened.callback(http.server_close)
        threading.Thread(target=http.serve_forever, daemon=True).start()
        opened.callback(http.shutdown)
        return f"http://127.0.0.1:{http.server_port}/"

    with opened:
        yield start


def test_the_live_page_updates_in_place(
    open_page: Callable[[], Page],
    serve: Callable[[Callable[[], str]], str],
    report: SweepReport,
    tmp_path: Path,
) -> None:
    write_state(tmp_path, 100, time.time())
    pages = {"html": render(report, live=True)}
    address = serve(lambda: pages["html"])

    async def use() -> None:
        async with open_page() as tab:
            await tab.view(1400, 1000)
            await tab.go(address)
            text = await tab.wait_for("The sweep is running", "train/B failed: <b>no</b>")
            assert "1 started, 2 waiting" in text
            assert not (seen := await tab.evaluate(LOOK))["nameless"]
            assert not seen["faint"]
            await tab.evaluate(CHOOSE % ["against", "epochs"])
            await tab.evaluate("scrollTo(0, 700)")
            missing = replace(report, limitations=["A run that has just failed."])
            write_state(tmp_path, 200, time.time())
            pages["html"] = render(missing, live=True)
            await tab.wait_for("A run that has just failed.")
            assert "epochs of 80,000" in await tab.evaluate(AXIS)
            assert abs(await tab.evaluate("scrollY") - 700) < 150
            assert await tab.evaluate(DRAWN) >= 3
            assert "music-rllib stop tiny --storage" in await tab.wait_for("To stop it:")
            command = "document.querySelector('#live code')"
            await tab.evaluate(f"getSelection().selectAllChildren({command})")
            write_state(tmp_path, 12_345, time.time())
            await tab.wait_for("12,345 environment steps")
            assert await tab.evaluate("getSelection().toString()") == await tab.evaluate(
                f"{command}.textContent"
            )
            assert not tab.errors
            assert all(url.startswith(address) for url in tab.requests)

    asyncio.run(use())


@pytest.mark.thorough
def test_the_live_page_of_a_study_half_way(
    open_page: Callable[[], Page], serve: Callable[[Callable[[], str]], str], tmp_path: Path
) -> None:
    """FetchPush on fresh seeds, at the time when half of its runs had ended."""
    whole = read_archive(DATA / "claims-push")
    sweep = as_of(whole, sorted(run.ended or 0 for run in whole.runs)[len(whole.runs) // 2])
    running = [i for i, run in enumerate(sweep.runs) if run.status == "RUNNING"]
    write_state(tmp_path, 0, time.time())
    file = tmp_path / "tiny" / "state.json"
    done = sum(map(sweep.last_step, range(len(sweep.runs))))
    state = {
        "env_steps": {"done": done, "left": 7_000_000 - done, "to_come": 0},
        "stages": [
            {
                "name": stage,
                "variant": variant,
                "trials": planned // 20,
                "runs": _counts(sweep, stage, planned),
            }
            for stage, variant, planned in (("pretrain", "music-u", 20), ("music-r", "music-r", 60))
        ],
        "running": [
            {
                "run": f"{sweep.runs[i].stage}/q={sweep.runs[i].entropic_index}"
                f"/seed{sweep.runs[i].seed}",
                "env_steps": sweep.last_step(i),
                "budget": sweep.runs[i].budget,
                "metric": names.EVAL_SUCCESS,
                "value": sweep.final(i, names.EVAL_SUCCESS),
            }
            for i in running
        ],
        "failures": [],
    }
    file.write_text(json.dumps(json.loads(file.read_text()) | state))
    page = render(build_report(sweep, live=True), live=True)
    address = serve(lambda: page)

    async def look() -> None:
        async with open_page() as tab:
            await tab.view(1400, 1000)
            await tab.go(address)
            text = await tab.wait_for("The sweep is running", "With the α that suits it")
            assert running
            assert all(
                f"{sweep.last_step(i):,} of {sweep.runs[i].budget:,}" in text for i in running
            )
            await tab.picture("report-live.png")
            assert not tab.errors

    asyncio.run(look())


def as_of(sweep: Sweep, time: int) -> Sweep:
    """The part of it that existed at a time, in ms since the epoch."""
    begun = [i for i, run in enumerate(sweep.runs) if (run.started or 0) < time]
    history = {}
    for metric, column in sweep.history.items():
        then = column.select((column.time < time) & np.isin(column.run, begun))
        history[metric] = then._replace(run=np.searchsorted(begun, then.run))
    runs = [sweep.runs[i] for i in begun]
    states = [run.status if (run.ended or time) < time else "RUNNING" for run in runs]
    runs = [replace(run, status=state) for run, state in zip(runs, states, strict=True)]
    return replace(sweep, runs=runs, history=history, status="RUNNING")


def _counts(sweep: Sweep, stage: str, planned: int) -> dict[str, int]:
    found = Counter(run.status for run in sweep.runs if run.stage == stage)
    finished, started = found["FINISHED"], found["RUNNING"]
    return {"finished": finished, "started": started, "waiting": planned - finished - started}
