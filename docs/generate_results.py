"""Write the results pages and their figures from the runs in docs/results/data.

python -m docs.generate_results    # write them and the picture of the README

The texts of the pages are in docs/results (`PAGES`), the code of their tables in result_pages. The
generator replaces `{{ KIND NAME }}` by a table of the sweep NAME. If tune_configs has a sweep of
this name, the table has all its runs that any export in docs/results/data has, whichever sweep
trained them; otherwise it has the runs of the export docs/results/data/NAME. KIND is

- without NAME, over the studies of `summary.STUDIES`: `headline`, `differences`, `summary`,
  `sampled`, `one-family`, `collapses`, `exploration`, `robustness` or `least-stable`;
- for a planned study: `answer`, `outcomes` (with stages), `seeds`, `cells`, `figure` (with its
  name), `learning`, `arms`, `peers`, `equal-total`, `hours` or `progress`;
- for any sweep: `totals` (with a pretrained stage and one from scratch), `runs`, `provenance`,
  `success`, `stages` or `curves` (with stages, if not all), `metric` (with metrics), or `search`.

    music-rllib report results/NAME --export docs/results/data/NAME --add
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from pathlib import Path

from docs.result_pages.exploration import exploration_table
from docs.result_pages.exports import hours_text, progress_text, sweep_called
from docs.result_pages.learning import learning_figure, overview, peers_figure
from docs.result_pages.robustness import least_stable, robustness_list
from docs.result_pages.runs import metric_table, provenance, runs_table
from docs.result_pages.searches import search_text
from docs.result_pages.studies import (
    answer_text,
    cells,
    named_figure,
    outcomes_table,
    seeds_table,
)
from docs.result_pages.success import stage_curves, stages_table, success
from docs.result_pages.summary import (
    collapses,
    differences_figure,
    equal_total_text,
    headline,
    one_family,
    sampled_sentence,
    summary_table,
)
from docs.result_pages.totals import arms_table, totals_table
from music_rllib.report.figures.choice import Drawing
from music_rllib.report.figures.draw import files

FOLDER = Path(__file__).parent
PAGES = {"results.md": "page.md", "lab/claims.md": "claims.md", "lab/appendix.md": "appendix.md"}
"""Pages, and their texts in docs/results."""
PICTURE = FOLDER / "img" / "overview.png"
FIGURES = FOLDER / "results" / "figures"
NOTICE = "<!-- Written by docs/generate_results.py from docs/results/{} and docs/results/data. -->"
NOT_RUN = "*Not run yet.*"


def main() -> None:
    """Write the pages."""
    figures: dict[str, Drawing] = {}
    for name in PAGES:
        (FOLDER / name).write_text(page(name, figures), encoding="utf-8")
    FIGURES.mkdir(parents=True, exist_ok=True)
    for old in FIGURES.glob("*.svg"):
        old.unlink()
    for name, drawing in figures.items():
        (FIGURES / name).write_bytes(files(drawing.subplots, drawing.legend)[".svg"])
    PICTURE.write_bytes(overview())


def page(name: str, figures: dict[str, Drawing]) -> str:
    """A page with its tables; adds its figures to `figures`."""
    words: dict[str, Callable[..., str]] = {
        "headline": headline,
        "differences": lambda: differences_figure(figures),
        "summary": lambda: "\n".join(summary_table()),
        "sampled": sampled_sentence,
        "one-family": one_family,
        "collapses": collapses,
        "exploration": lambda: "\n".join(exploration_table()),
        "robustness": lambda: "\n".join(robustness_list()),
        "least-stable": least_stable,
        "equal-total": equal_total_text,
        "progress": progress_text,
        "hours": hours_text,
    }
    tables: dict[str, Callable[..., Iterable[str]]] = {
        "answer": answer_text,
        "outcomes": outcomes_table,
        "seeds": seeds_table,
        "cells": cells,
        "figure": lambda sweep, name: named_figure(sweep, name, figures),
        "learning": lambda sweep: learning_figure(sweep, figures),
        "totals": totals_table,
        "arms": arms_table,
        "peers": lambda sweep: peers_figure(sweep, figures),
        "runs": runs_table,
        "provenance": lambda sweep: [provenance(sweep)],
        "success": lambda sweep, *stages: success(sweep, figures, stages),
        "stages": stages_table,
        "curves": lambda sweep, *stages: stage_curves(sweep, figures, stages),
        "metric": metric_table,
        "search": search_text,
    }

    def fill(match: re.Match[str]) -> str:
        kind, *rest = match[1].split()
        if kind in words:
            return words[kind](*rest)
        of_sweep, *rest = rest
        sweep = sweep_called(of_sweep)
        return NOT_RUN if sweep is None else "\n".join(tables[kind](sweep, *rest))

    template = PAGES[name]
    text = re.sub(r"{{ (.*?) }}", fill, (FOLDER / "results" / template).read_text("utf-8"))
    to_figures = "../" * name.count("/") + "results/figures/"
    text = text.replace("](results/figures/", f"]({to_figures}")
    return f"{NOTICE.format(template)}\n\n{text}"


if __name__ == "__main__":
    main()
