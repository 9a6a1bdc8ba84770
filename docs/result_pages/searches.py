"""Searches: what was tried and found."""

from __future__ import annotations

from collections.abc import Iterator

from docs.result_pages.runs import provenance
from docs.result_pages.words import row, rule
from music_rllib.report.search_tables import search_in_words, search_tables
from music_rllib.results.analysis import analyse
from music_rllib.results.comparison import verdict
from music_rllib.results.data import Sweep


def search_text(sweep: Sweep) -> Iterator[str]:
    """How it searched, its ranking on fresh seeds, importances, trials, and what may be said."""
    analyses = {found.stage.name: found for found in analyse(sweep)}
    for search in sweep.searches:
        yield search_in_words(search)
        for scope in analyses[search["stage"]].scopes:
            yield f"\n{' '.join(verdict(scope))}"
        for found in search_tables(search):
            yield f"\n**{found.title}.** {found.note}\n"
            yield row(*found.header)
            yield rule(len(found.header))
            yield from (row(*cells) for cells in found.rows)
        yield ""
    yield provenance(sweep)
