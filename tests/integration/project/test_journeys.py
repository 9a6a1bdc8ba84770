"""The five journeys of docs/architecture.md match their traces."""

from __future__ import annotations

import pytest

from tests.journeys import (
    JOURNEYS,
    MOST_DRIVER_MODULES,
    PAGE,
    driver_modules,
    files_of,
    first_call,
    names_of,
    observed,
    with_section,
)


@pytest.mark.parametrize("name", JOURNEYS)
def test_the_traced_steps_are_called_in_this_order_in_few_files(name: str) -> None:
    journey, functions = JOURNEYS[name], observed(name)
    positions: list[int] = []
    for number in journey.traced:
        position = None
        for one in names_of(journey.steps[number - 1]):
            position = first_call(one, functions)
            assert position is not None, f"step {number} does not call {one}"
        positions += [] if position is None else [position]
    assert positions == sorted(positions)
    assert files_of(functions) <= journey.most_files


def test_the_driver_loads_few_modules() -> None:
    assert driver_modules() <= MOST_DRIVER_MODULES


def test_the_page_has_the_section_of_the_journeys() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert page == with_section(page), "python -m tests.journeys --write"
