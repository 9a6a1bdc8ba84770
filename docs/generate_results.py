"""Writes docs/results.md, its appendix and their figures from the runs in docs/results/data alone.

python -m docs.generate_results            # writes them
python -m docs.generate_results --check    # exit code 1 where a page is out of date

The pages' words are in docs/results/page.md and appendix.md, the code of tables in result_pages.
Where a page says `{{ KIND NAME }}`, a table is put of the sweep NAME: of all of its runs that any
export in docs/results/data has, whichever sweep computed them, if tune_configs has a sweep of that
name, and else of the export docs/results/data/NAME. KIND is

- of a planned study: `verdict`, with the hypothesis, `answer`, `outcomes`, with stages, `seeds`,
  `cells`, `figure`, with the name of one, `hours` or `progress` of its runs;
- of any sweep: `runs`, `provenance`, `success`, `stages`, or `curves`, with
  stages behind NAME if not all are meant, `metric`, with metrics, or `search`.

    python -m music_rllib.report results/NAME --export docs/results/data/NAME --add
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

from docs.result_pages.exports import hours_text, progress_text, sweep_called
from docs.result_pages.runs import metric_table, provenance, runs_table
from docs.result_pages.searches import search_text
from docs.result_pages.studies import (
    answer_text,
    cells,
    named_figure,
    outcomes_table,
    seeds_table,
    verdict_text,
)
from docs.result_pages.success import stage_curves, stages_table, success

FOLDER = Path(__file__).parent
PAGES = {"results.md": "page.md", "results_appendix.md": "appendix.md"}
FIGURES = FOLDER / "results" / "figures"
NOTICE = "<!-- Written by docs/generate_results.py from docs/results/{} and docs/results/data. -->"
NOT_RUN = "*Not run yet.*"


def main() -> int:
    """Writes the pages, or checks them."""
    figures: dict[str, bytes] = {}
    texts = {FOLDER / name: page(template, figures) for name, template in PAGES.items()}
    if "--check" in sys.argv[1:]:
        stale = [
            str(path)
            for path, text in texts.items()
            if not path.exists() or path.read_text("utf-8") != text
        ]
        if stale:
            names_of = ", ".join(stale)
            print(f"Out of date: {names_of}. python -m docs.generate_results", file=sys.stderr)
        return int(bool(stale))
    for path, text in texts.items():
        path.write_text(text, encoding="utf-8")
    FIGURES.mkdir(parents=True, exist_ok=True)
    for old in FIGURES.glob("*.svg"):
        old.unlink()
    for name, content in figures.items():
        (FIGURES / name).write_bytes(content)
    return 0


def page(template: str, figures: dict[str, bytes]) -> str:
    """A template with its tables filled in; the figures that it shows go into `figures`."""
    words: dict[str, Callable[..., str]] = {
        "verdict": verdict_text,
        "progress": progress_text,
        "hours": hours_text,
    }
    tables: dict[str, Callable[..., Iterable[str]]] = {
        "answer": answer_text,
        "outcomes": outcomes_table,
        "seeds": seeds_table,
        "cells": cells,
        "figure": lambda sweep, name: named_figure(sweep, name, figures),
        "runs": runs_table,
        "provenance": lambda sweep: [provenance(sweep)],
        "success": lambda sweep, *stages: success(sweep, figures, stages),
        "stages": stages_table,
        "curves": lambda sweep, *stages: stage_curves(sweep, figures, stages),
        "metric": metric_table,
        "search": search_text,
    }

    def fill(match: re.Match[str]) -> str:
        kind, name, *rest = match[1].split()
        if kind in words:
            return words[kind](name, *rest)
        sweep = sweep_called(name)
        return NOT_RUN if sweep is None else "\n".join(tables[kind](sweep, *rest))

    text = (FOLDER / "results" / template).read_text("utf-8")
    return f"{NOTICE.format(template)}\n\n{re.sub(r'{{ (.*?) }}', fill, text)}"


if __name__ == "__main__":
    sys.exit(main())
