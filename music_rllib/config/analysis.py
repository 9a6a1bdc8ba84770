"""The `analysis` of a sweep: what is asked, and whether the sweep has such conditions."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from music_rllib.config.problems import Findings, lookup, same, shown
from music_rllib.names import EVAL_RETURN

if TYPE_CHECKING:
    from music_rllib.config.schema import Stage

SETTINGS_IN_SHORT = {
    "q": "tac.entropic_index",
    "α": "tac.alpha",
    "alpha": "tac.alpha",
    "weight": "music.mi_reward_weight",
}
"""What hypotheses may call settings."""
_HYPOTHESIS = re.compile(
    r"(?P<first>.+?) (?P<relation>better than|worse than|equivalent to|against) (?P<second>.+)"
)
_NEXT_SETTING = re.compile(r",(?=[^,=]+=)")


class Hypothesis(NamedTuple):
    """`q = 1.5 better than q = 1`: what is compared, and what is expected of it."""

    text: str
    first: Mapping[str, str]
    """Dotted setting, or `stage`, to its value."""
    second: Mapping[str, str]
    relation: str
    """`better than`, `worse than`, `equivalent to`, or `against` where nothing is expected."""

    @classmethod
    def of(cls, text: str) -> Self:
        """Read one.

        Raises:
            ValueError: It is none; says what one looks like.
        """
        words = " ".join(text.split())
        found = _HYPOTHESIS.fullmatch(words)
        sides = [] if found is None else [_side(found[name]) for name in ("first", "second")]
        if found is None or None in sides or sides[0] == sides[1]:
            raise ValueError(
                "must be two different conditions with 'better than', 'worse than', 'equivalent "
                f"to' or 'against' between them, like 'q = 1.5 against q = 1', got {text!r}"
            )
        first, second = (side or {} for side in sides)
        return cls(text=words, first=first, second=second, relation=found["relation"])


def _side(text: str) -> dict[str, str] | None:
    """`q = 1.5, tac.lr = 0.001`; None where it is no such list."""
    pairs = [part.partition("=") for part in _NEXT_SETTING.split(text)]
    if not all(name.strip() and sign and value.strip() for name, sign, value in pairs):
        return None
    names_ = [SETTINGS_IN_SHORT.get(name.strip(), name.strip()) for name, _, _ in pairs]
    values = [value.strip() for _, _, value in pairs]
    return dict(zip(names_, values, strict=True)) if len(set(names_)) == len(names_) else None


def _is_hypothesis(text: str) -> str:
    return Hypothesis.of(text).text


class Analysis(BaseModel):
    """What is to be found out, stated before the runs; no run's result depends on it."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    question: str | None = Field(None, min_length=1, max_length=500, pattern=r"^[^\x00-\x1f\x7f]*$")
    """In a sentence, for the report's first line."""
    hypotheses: tuple[
        Annotated[str, Field(max_length=500), AfterValidator(_is_hypothesis)], ...
    ] = Field(min_length=1, max_length=50)
    """Two conditions each, with `better than`, `worse than`, `equivalent to` or `against` between
    them: `q = 1.5 better than q = 1`. A condition is what has these settings (`q`, `alpha`,
    `weight`, a dotted setting, `stage`); where more varies, differences are averaged over pairs
    that are alike in the rest."""
    stage: str | None = None
    """Whose conditions; null: the last stage. A condition may name its own."""
    metric: Literal["auc", "final"] = "auc"
    """What counts of a run: the area under its curve of the task's primary metric, which is its
    mean over the budget, or the last value."""
    margin: float | None = Field(None, gt=0)
    """A difference below it does not matter: equivalence is tested within it. null: 0.05 of a
    success rate; of a return it must be given."""


def check_analysis(
    analysis: Analysis, stages: Mapping[str, Stage | None], findings: Findings
) -> None:
    """Whether its hypotheses are about conditions that the sweep has."""
    if analysis.stage is not None and analysis.stage not in stages:
        rule = f"must be one of {', '.join(stages)}, got {analysis.stage!r}"
        findings.add(("analysis", "stage"), rule)
        return
    default = analysis.stage or next(reversed(list(stages)), None)
    about: dict[str, Stage] = {}
    for position, text in enumerate(analysis.hypotheses):
        hypothesis = Hypothesis.of(text)
        for side in (hypothesis.first, hypothesis.second):
            name = side.get("stage", default)
            stage = stages.get(str(name))
            if stage is not None:
                about[stage.name] = stage
            path = ("analysis", "hypotheses", position)
            if name not in stages:
                findings.add(path, f"must name one of the stages {', '.join(stages)}, got {name!r}")
            elif stage is not None and (wrong := _no_such_condition(stage, side)):
                findings.add(path, wrong)
    metrics = {task.primary_metric for stage in about.values() for task in stage.tasks}
    if analysis.margin is None and EVAL_RETURN in metrics:
        findings.add(("analysis", "margin"), "must be given for tasks without success, got null")


def _no_such_condition(stage: Stage, side: Mapping[str, str]) -> str | None:
    """What is wrong with one side of a hypothesis; None where the stage has such conditions."""
    points: list[Mapping[str, Any]] = [point.values for point in stage.points]
    space = stage.search.space if stage.search else {}
    if stage.search:
        points = list(stage.search.arms())
    varied = dict.fromkeys([*(name for point in points for name in point), *space])
    for name, text in side.items():
        if name == "stage" or name in space:
            continue
        known = [point[name] for point in points if name in point]
        run = next(iter(stage.points[0].runs.values())).model_dump(mode="json")
        known = known or [found for found in [_setting(run, name)] if found is not None]
        if not known:
            settings = ", ".join(varied) or "nothing"
            return f"must name settings, of which {stage.name} varies {settings}, got {name!r}"
        if not any(_agrees(text, value) for value in known):
            return f"must name values that {stage.name} has, {name} is {shown(known)}, got {text}"
    return None


def _agrees(text: str, value: Any) -> bool:
    try:
        return same(float(text), value)
    except ValueError:
        return text in (value, shown(value))


def _setting(run: Mapping[str, Any], name: str) -> Any:
    try:
        return lookup(run, name.split("."))
    except LookupError:
        return None
