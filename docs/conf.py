"""The documentation site: `make docs`. It works from disk, including its search, without a network.

Its pages are copies of docs/ and of the files in `PAGES`, made by build_site.py.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]

project = "music_rllib"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["results/page.md", "results/claims.md", "results/appendix.md", "search.md"]
root_doc = "index"
html_theme = "furo"
html_title = "music_rllib"
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False
# Search loads page summaries by requests, which browsers refuse for pages on a disk.
html_show_search_summary = False
myst_heading_anchors = 4
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_default_options = {"members": True, "exclude-members": "model_config"}
# Examples show parts of files, and shell sessions.
suppress_warnings = ["misc.highlighting_failure", "myst.header"]

PAGES = {"index": "README.md", "changelog": "CHANGELOG.md", "searching": "docs/search.md"}
"""Pages of the site and their files; `search` is Sphinx's own page."""
CONTENTS = """
```{toctree}
:hidden:
:caption: Use
configuration
add_an_environment
intrinsic_rewards
comparing_q
searching
reports
operations
slurm
```
```{toctree}
:hidden:
:caption: Reference
algorithms
architecture
api
reliability
performance
```
```{toctree}
:hidden:
:glob:
:caption: Decisions
adr/*
```
```{toctree}
:hidden:
:caption: Results
results
results/plan
lab/claims
lab/appendix
lab/measurements
lab/learner_screen
changelog
```
"""
_LINK = re.compile(r"(!?\[[^\]]*\])\(([^)\s:#]+)(#[^)]*)?\)")


def _with_links_of_the_site(app: Any, page: str, source: list[str]) -> None:
    """Turn links to files into links to their pages, or into plain names if they have none."""
    above = (ROOT / PAGES.get(page, f"docs/{page}.md")).parent

    def link(found: re.Match[str]) -> str:
        path = (above / found[2]).resolve()
        name = path.relative_to(ROOT).as_posix()
        for own, file in PAGES.items():
            if name == file:
                return f"{found[1]}(/{own}.md{found[3] or ''})"
        if path.is_relative_to(ROOT / "docs"):
            return f"{found[1]}(/{path.relative_to(ROOT / 'docs')}{found[3] or ''})"
        return f"`{name}`"

    source[0] = _LINK.sub(link, source[0]) + (CONTENTS if page == root_doc else "")


def setup(app: Any) -> None:
    """Connect the extension; Sphinx calls this."""
    app.connect("source-read", _with_links_of_the_site)
