"""The `analysis` section of a sweep: hypotheses about its conditions, stated before the runs."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal, NamedTuple, Self

from pydantic import AfterValidator, Field

from music_rllib.config.problems import same
from music_rllib.schedules import StrictModel

SETTINGS_IN_SHORT = {
    "q": "tac.entropic_index",
    "α": "tac.alpha",
    "alpha": "tac.alpha",
    "weight": "music.mi_reward_weight",
}
"""Short name of a setting in hypotheses to the setting."""
_HYPOTHESIS = re.compile(
    r"(?P<first>.+?) (?P<relation>better than|worse than|equivalent to|against) (?P<second>.+)"
)
_NEXT_SETTING = re.compile(r",(?=[^,=]+=)")
_JSON_FOR_PYTHON = {"True": "true", "False": "false", "None": "null"}


class Hypothesis(NamedTuple):
    """Two conditions and the expected relation between them: `q = 1.5 better than q = 1`."""

    text: str
    first: Mapping[str, str]
    """The first condition: dotted setting, or `stage`, to its value."""
    second: Mapping[str, str]
    relation: str
    """`better than`, `worse than`, `equivalent to`, or `against` if nothing is expected."""

    @property
    def sides(self) -> tuple[Mapping[str, str], Mapping[str, str]]:
        """Both conditions."""
        return self.first, self.second

    @classmethod
    def of(cls, text: str) -> Self:
        """Parse a hypothesis.

        Raises:
            ValueError: The text is not a hypothesis; the message has an example.
        """
        words = " ".join(text.split())
        match = _HYPOTHESIS.fullmatch(words)
        first = _condition(match["first"]) if match else {}
        second = _condition(match["second"]) if match else {}
        if match is None or not first or not second or same(_parsed(first), _parsed(second)):
            raise ValueError(
                "must be two different conditions with 'better than', 'worse than', 'equivalent "
                f"to' or 'against' between them, like 'q = 1.5 against q = 1', got {text!r}"
            )
        return cls(text=words, first=first, second=second, relation=match["relation"])


def _condition(text: str) -> dict[str, str]:
    """The settings of `q = 1.5, tac.lr = 0.001`; empty if the text is not such a list."""
    settings = {}
    for part in _NEXT_SETTING.split(text):
        name, _, value = (piece.strip() for piece in part.partition("="))
        name = SETTINGS_IN_SHORT.get(name, name)
        if not name or not value or name in settings:
            return {}
        settings[name] = value
    return settings


def _parsed(condition: Mapping[str, str]) -> dict[str, Any]:
    """A condition's values; the names of stages stay text."""
    return {name: text if name == "stage" else parsed(text) for name, text in condition.items()}


def parsed(text: str) -> Any:
    """The value of a text in a hypothesis or an MLflow param: `1.0`, `true`, `True`."""
    with contextlib.suppress(ValueError):
        return float(text)
    with contextlib.suppress(ValueError, RecursionError):
        return json.loads(_JSON_FOR_PYTHON.get(text, text))
    return text


def same_value(one: str, other: str) -> bool:
    """Whether two texts are the same value: `1` and `1.0`, `true` and `True`."""
    return one == other or same(parsed(one), parsed(other))


class Analysis(StrictModel):
    """The questions of a sweep, stated before the runs; no run's result depends on them."""

    question: str | None = Field(None, min_length=1, max_length=500, pattern=r"^[^\x00-\x1f\x7f]*$")
    """The question in a sentence, for the report's first line."""
    hypotheses: tuple[
        Annotated[
            str, Field(max_length=500), AfterValidator(lambda text: Hypothesis.of(text).text)
        ],
        ...,
    ] = Field(min_length=1, max_length=50)
    """Two conditions each with `better than`, `worse than`, `equivalent to` or `against` between
    them: `q = 1.5 better than q = 1`. A condition is all runs with these settings (`q`, `alpha`,
    `weight`, a dotted setting, `stage`). If more settings vary, differences are averaged over pairs
    with equal other settings."""
    stage: str | None = None
    """Stage of the conditions; null: the last stage. A condition can name another stage."""
    metric: Literal["auc", "final"] = "auc"
    """Number to compare: the mean of the task's primary metric over the budget (the area under the
    learning curve), or its last value."""
    margin: float | None = Field(None, gt=0)
    """Margin of equivalence tests: smaller differences do not matter. null: 0.05 for a success
    rate; required for a return. If tasks of both kinds are compared, a margin of 1 or more applies
    to returns, and success rates keep 0.05."""
