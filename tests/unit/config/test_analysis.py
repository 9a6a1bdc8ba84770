"""Hypotheses in a sweep's file: testable ones are accepted, the others rejected."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from music_rllib.config.problems import ConfigError
from music_rllib.config.schema import Hypothesis
from tests.sweep_files import loaded

Document = dict[str, Any]
Problems = Callable[[str, Document], list[str]]

RAMP: Document = {"schedule": "linear", "start": 2.0, "end": 1.0}
COMPARED: Document = {
    "mode": "compare",
    "compare": {"tac.entropic_index": [1.0, 2.0]},
    "space": {"tac.alpha": {"float": [0.01, 0.1]}},
    "trials": 2,
}
BEST: Document = {"final": {"trials": 1}}


@pytest.fixture
def problems(tmp_path: Path) -> Problems:
    """The problems of a sweep with one hypothesis and one stage, `s`, that starts from another."""

    def problems_of(hypothesis: str, stage: Document) -> list[str]:
        stages = [
            {"name": "u", "variant": "music-u"},
            {"name": "s", "variant": "music-r", "init_from": "u", **stage},
        ]
        document = {"name": "n", "tasks": ["FetchPush"], "stages": stages}
        try:
            loaded(tmp_path, document | {"analysis": {"hypotheses": [hypothesis]}})
        except ConfigError as error:
            return list(error.lines)
        return []

    return problems_of


def grid(name: str, *values: Any) -> Document:
    return {"grid": {name: list(values)}}


def search(*changes: Document) -> Document:
    settings = dict(COMPARED)
    for change in changes:
        settings |= change
    return {"search": settings}


NORMALISE = "tac.normalise_observations"
GROUPS = grid("tac", {}, {"entropic_index": 2.0})
SOUND: list[tuple[str, Document]] = [
    (
        f"{NORMALISE} = true better than {NORMALISE} = False",
        {"variant": "tac", "init_from": None, **grid(NORMALISE, True, False)},
    ),
    ("tac.lr = 1e-3 against tac.lr = .002", grid("tac.lr", 0.001, 0.002)),
    (
        "tac.target_bounds = [-50,0] against tac.target_bounds = null",
        grid("tac.target_bounds", None, [-50, 0]),
    ),
    (
        "tac.target_bounds = [-50.0, 0] against tac.target_bounds = None",
        grid("tac.target_bounds", None, [-50, 0]),
    ),
    ("q = 2 to 1 better than q = 1", grid("tac.entropic_index", 1, RAMP)),
    (
        "tac.entropic_index.begin = 0.2 better than q = 1",
        grid("tac.entropic_index", 1, RAMP | {"begin": 0.2}),
    ),
    ("alpha = learned against alpha = .1", grid("tac.alpha", 0.1, {"learned": True})),
    (
        "weight = 1 to 0 by success rate against weight = 1",
        grid(
            "music.mi_reward_weight",
            1,
            {"follows": "success_rate", "points": [[0.0, 1.0], [1.0, 0.0]]},
        ),
    ),
    ("q = 2 better than q = 1", GROUPS),
    (
        "q = 2 better than q = 1",
        grid("tac", {"entropic_index": 2.0, "alpha": 0.1}, {"alpha": 0.3}),
    ),
    ("q = 2 better than q = 1", search(BEST)),
    ("q = 2, alpha = 0.1 better than q = 1, alpha = 0.1", search()),
    (
        "q = 2 better than q = 1",
        search(
            BEST,
            {
                "compare": {"tac": [{}, {"entropic_index": 2.0}]},
                "space": {"env_steps": {"int": [9000, 9999]}},
            },
        ),
    ),
    (
        "q = 2 better than q = 1",  # all alphas are in the final ranking of each q
        search(
            {
                "sampler": "grid",
                "trials": None,
                "space": {"tac.alpha": {"choice": [0.1, 0.2]}},
            }
        ),
    ),
]


@pytest.mark.parametrize(("hypothesis", "stage"), SOUND)
def test_testable_hypotheses_are_accepted(
    hypothesis: str, stage: Document, problems: Problems
) -> None:
    assert problems(hypothesis, stage) == []


TUNED_Q: Document = {
    "mode": "search",
    "compare": {},
    "space": {"tac.entropic_index": {"choice": [1.0, 2.0]}},
}
UNTESTABLE: list[tuple[str, Document, str]] = [
    ("q = 2 better than q = 1", search(BEST, TUNED_Q), "must not name a tuned setting"),
    ("q = 2, alpha = .1 better than q = 1", search(BEST), "got 'tac.alpha'"),
    (
        "q = 2 better than q = 1",  # the pair of equal settings is that of the baselines
        search(
            {"final": {"trials": 1, "baselines": True}},
            {"points_to_evaluate": [{"tac.alpha": 0.05}]},
        ),
        "write final: {trials: 1, baselines: false}, and mode: compare",
    ),
    (
        "q = 2, alpha = .3 better than q = 1",
        grid("tac", {"entropic_index": 2.0, "alpha": 0.1}, {"entropic_index": 1.0, "alpha": 0.3}),
        "must name values that a run of s has together, got tac.entropic_index = 2, tac.alpha = .3",
    ),
    ("q = 2 better than q = 1", search(), "write final: {trials: 1}, and mode: compare"),
    ("q = 2, alpha = .1 better than q = 1", search(), "got final.trials: 3"),
    ("q = 2 better than q = 1", search({"final": None}), "write final: {trials: 1} in the search"),
    (
        "u:tac.lr = 0.1 better than u:tac.lr = 0.2",
        search(BEST, {"space": {"u:tac.lr": {"choice": [0.1, 0.2]}}}),
        "of which s varies tac.entropic_index, got 'u:tac.lr'",
    ),
    ("q = 3 better than q = 1", GROUPS, "(tac.entropic_index: 1, 2), got 3"),
    (
        'q = {"schedule": "linear"} better than q = 1',
        grid("tac.entropic_index", 1, RAMP),
        "must name a schedule in words, like '1 to 2' or 'learned', got {",
    ),
    (
        'alpha = {"learned": true} better than alpha = 0.1',
        search({"space": {"tac.alpha": {"choice": [0.1, {"learned": True}]}}}),
        "must name a schedule in words, like '1 to 2' or 'learned', got {",
    ),
    (
        "q = 1 to 2 better than q = 1",
        grid("tac.entropic_index", 1, RAMP),
        "(tac.entropic_index: 1, 2 to 1), got 1 to 2",
    ),
    (
        "q = true better than q = 2",
        grid("tac.entropic_index", 1, 2),
        "(tac.entropic_index: 1, 2), got true",
    ),
]


@pytest.mark.parametrize(("hypothesis", "stage", "message"), UNTESTABLE)
def test_untestable_hypotheses_are_rejected(
    hypothesis: str, stage: Document, message: str, problems: Problems
) -> None:
    lines = problems(hypothesis, stage)
    assert [message in line for line in lines][:1] == [True], lines


@pytest.mark.parametrize(
    "stage",
    [
        grid("tac.entropic_index", 1, 0),
        search(BEST, {"compare": {"tac.entropic_index": [1.0, 0.0]}}),
    ],
)
def test_an_invalid_value_is_reported_once(stage: Document, problems: Problems) -> None:
    (line,) = problems("q = 0 better than q = 1", stage)
    assert "must be > 0, got 0" in line


@pytest.mark.parametrize(
    "sides", [("q = 1", "q = 1.0"), ("a = true", "a = True"), ("a = [1, 2]", "a = [1.0,2]")]
)
def test_two_spellings_of_a_value_are_one_condition(sides: tuple[str, str]) -> None:
    with pytest.raises(ValueError, match="must be two different conditions"):
        Hypothesis.of(" against ".join(sides))


def test_stage_names_are_compared_as_text() -> None:
    assert Hypothesis.of("stage = 1 against stage = 1.0").relation == "against"


def stage(**settings: Any) -> dict[str, Any]:
    train = {"name": "train", "variant": "tac", **settings}
    return {"name": "g", "tasks": ["FetchReach"], "seeds": [0], "stages": [train]}


@pytest.mark.parametrize("value", ["0.1234567", "0.123457"])
def test_a_hypothesis_can_name_a_value_as_the_file_has_it(value: str, tmp_path: Path) -> None:
    analysis = {"hypotheses": [f"alpha = {value} better than alpha = 0.2"]}
    loaded(tmp_path, {**stage(grid={"tac.alpha": [0.1234567, 0.2]}), "analysis": analysis})


@pytest.mark.parametrize("more", [{}, {"step": 0.5}])
def test_real_numbers_are_no_range_of_a_whole_number(more: dict[str, Any], tmp_path: Path) -> None:
    search = {"space": {"tac.batch_size": {"float": [64, 512], **more}}, "trials": 2}
    with pytest.raises(ConfigError, match="batch_size must be a whole number"):
        loaded(tmp_path, stage(search=search))
    search["space"] = {"tac.batch_size": {"float": [64, 512], "step": 64}}
    loaded(tmp_path, stage(search=search))
