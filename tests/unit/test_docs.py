"""Documentation and code agree on settings, metrics, tasks, links and examples."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from docs.generate_configuration import TARGET, document, json_schema
from music_rllib import names
from music_rllib.config.document import SCHEMA
from music_rllib.config.load import load_config
from music_rllib.config.tac_settings import TACSettings, setting_text
from music_rllib.envs.tasks import BUILT_IN_TASKS
from music_rllib.results.analysis_plan import analysis_plan

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md")), *sorted(DOCS.glob("lab/*.md"))]
TEXTS = {path.name: path.read_text(encoding="utf-8") for path in PAGES}


def anchors(text: str) -> set[str]:
    """Anchors of a page's headings, as GitHub creates them."""
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=[path.name for path in PAGES])
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", TEXTS[page.name]):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        path = (page.parent / file).resolve() if file else page
        assert path.exists(), f"{page.name}: {target}"
        if anchor:
            assert anchor in anchors(path.read_text(encoding="utf-8")), f"{page.name}: {target}"


def test_the_reference_and_the_schema_are_those_of_the_settings() -> None:
    found = TARGET.read_text("utf-8"), json.loads(SCHEMA.read_text("utf-8"))
    assert found == (document(), json_schema()), "run python docs/generate_configuration.py"


def test_every_built_in_task_matches_its_description() -> None:
    for task in BUILT_IN_TASKS.values():
        (row,) = re.findall(
            rf"^\| `{re.escape(task.name)}` \|.*$", TEXTS["add_an_environment.md"], re.MULTILINE
        )
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        assert cells[1:3] == [f"`{task.env_id}`", str(task.horizon)]
        for cell, indices in zip(
            cells[3:5], (task.agent_indices, task.surrounding_indices), strict=True
        ):
            written = re.match(r"(\d+):(\d+)", cell)
            expected = range(int(written[1]), int(written[2])) if written else range(0)
            assert indices == tuple(expected), row


METRICS = {
    value
    for key, value in vars(names).items()
    if key.isupper()
    and isinstance(value, str)
    and not key.startswith(("TAG_", "KIND_", "ARTIFACT_", "VARIABLE_", "CURRENT", "SUPERSEDED"))
}


@pytest.mark.parametrize(
    "alpha",
    [
        {"value": 0.05, "matched_width": 0.1},
        {"learned": True, "target_shannon": -4.0},
        {"learned": True, "target_width": 0.1},
        {"learned": True, "target_entropy": -4.0},
    ],
)
def test_a_hypothesis_names_each_kind_of_alpha_as_the_page_says(alpha: dict[str, Any]) -> None:
    words = setting_text(TACSettings.model_validate({"alpha": alpha}).alpha)
    assert f"`alpha = {words}`" in " ".join(TEXTS["comparing_q.md"].split())


def test_every_metric_is_described() -> None:
    described = set(re.findall(r"^\| `([\w/]+?)(?:<i>)?` \|", TEXTS["algorithms.md"], re.MULTILINE))
    assert described >= METRICS, METRICS - described
    assert {name for name in described if "/" in name} <= METRICS, "described, but not there"


def test_tests_that_the_documentation_names_exist() -> None:
    code = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("*.py"))
    defined = set(re.findall(r"^def (test_\w+)", code, re.MULTILINE))
    for name, text in TEXTS.items():
        for file in re.findall(r"tests/[\w/]+\.py", text):
            assert (ROOT / file).is_file(), f"{name}: {file}"
        mentioned = set(re.findall(r"`(test_\w+)`", text))
        assert mentioned <= defined, f"{name}: {mentioned - defined}"


def test_every_page_is_on_the_documentation_site() -> None:
    contents = (ROOT / "docs" / "conf.py").read_text().split("CONTENTS = ")[1].split()
    of_docs = (path.relative_to(DOCS).with_suffix("") for path in PAGES[1:])
    pages = {page.as_posix() for page in of_docs} - {"search"}
    assert pages | {"searching", "changelog"} <= set(contents)


PLANS = re.findall(r"^\| \[`.*$", (ROOT / "docs/results/plan.md").read_text("utf-8"), re.MULTILINE)


@pytest.mark.parametrize("row", PLANS, ids=lambda row: row.split("`")[1])
def test_the_claims_and_their_sweeps_have_the_same_plan(row: str) -> None:
    plans = [
        analysis_plan(load_config(ROOT / "tune_configs" / file))
        for file in re.findall(r"tune_configs/(\w+\.yaml)", row)
    ]
    hashes = [plan.hash[:20] for plan in plans if plan]
    assert hashes == re.findall(r"`(\w{20})`", row)
