"""Searches: what was tried and found."""

from __future__ import annotations

from collections.abc import Iterator

from docs.result_pages.runs import provenance
from docs.result_pages.words import row, rule
from music_rllib.report.search_tables import search_in_words, search_tables
from music_rllib.results.data import Sweep


def search_text(sweep: Sweep) -> Iterator[str]:
    """How it searched, its ranking on fresh seeds, importances and trials."""
    for search in sweep.searches:
        yield search_in_words(search)
        for found in search_tables(search):
            yield f"\n**{found.title}.** {found.note}\n"
            yield row(*found.header)
            yield rule(len(found.header))
            yield from (row(*cells) for cells in found.rows)
        yield ""
    yield provenance(sweep)
