"""Searches: trials, ranking and importances."""

from __future__ import annotations

from collections.abc import Iterator

from docs.result_pages.runs import provenance
from docs.result_pages.words import row, rule
from music_rllib.results.data import Sweep
from music_rllib.results.search_tables import search_in_words, search_tables


def search_text(sweep: Sweep) -> Iterator[str]:
    """The method of each search, its ranking on fresh seeds, importances and trials."""
    for search in sweep.searches:
        yield search_in_words(search)
        for found in search_tables(search):
            if found.rows:
                titles = [title for title, _ in found.heads]
                yield f"\n**{found.title}.** {found.note}\n"
                yield row(*titles)
                yield rule(len(titles))
                yield from (row(*(cell.text for cell in cells)) for cells in found.cells)
        yield ""
    yield provenance(sweep)
