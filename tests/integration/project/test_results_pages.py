"""The pages about results follow from the exported runs."""

from __future__ import annotations

import pytest

from docs.generate_results import FOLDER, PAGES, page


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_what_its_generator_writes(name: str) -> None:
    assert (FOLDER / name).read_text("utf-8") == page(name, {}), "run `make results`"
