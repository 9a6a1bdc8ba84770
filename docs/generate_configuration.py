"""Writes docs/configuration.md and the JSON Schema of sweep files from the settings' definitions.

python docs/generate_configuration.py            # writes both
python docs/generate_configuration.py --check    # exit code 1 if one is out of date
"""

from __future__ import annotations

import ast
import inspect
import json
import sys
import textwrap
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import annotated_types
from pydantic import AfterValidator, BaseModel, BeforeValidator, create_model
from pydantic.fields import FieldInfo
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import core_schema

from music_rllib.config.document import SCHEMA, shipped_presets
from music_rllib.config.layers import all_settings
from music_rllib.config.run_settings import (
    LAYER_KEYS,
    SECTIONS,
    VARIANTS,
    Evaluation,
    ReplaySettings,
    RunSettings,
)
from music_rllib.config.schema import (
    Analysis,
    Checkpoints,
    Header,
    InitFrom,
    MlflowSettings,
    Resources,
    StageHeader,
)
from music_rllib.config.search import (
    FinalRanking,
    Objective,
    Pruning,
    Rung,
    SearchSettings,
)
from music_rllib.config.space import Choice, FloatRange, IntRange
from music_rllib.config.tac_settings import (
    ColoredNoise,
    GaussianNoise,
    LearnedAlpha,
    MatchedAlpha,
    NormalisedAlpha,
    TACSettings,
)
from music_rllib.envs.features import Mirror, Translation
from music_rllib.envs.tasks import BUILT_IN_TASKS, Task
from music_rllib.intrinsic.settings import IntrinsicSettings, MusicSettings
from music_rllib.schedules import Linear, Measured, Piecewise, StrictModel

TARGET = Path(__file__).with_name("configuration.md")

INTRODUCTION = """\
# Configuration

Use this page to look up the keys of a sweep's YAML file. `docs/generate_configuration.py` writes it
from the definitions of the settings. [algorithms.md](algorithms.md) has the formulas behind the
settings; [add_an_environment.md](add_an_environment.md) explains how to declare a task.

```yaml
name: my_sweep
tasks: [FetchPush]
seeds: [0, 1, 2]
defaults:                    # settings of every stage
  env_steps: 250000
  tac: {alpha: 0.05, gamma: 0.95, tau: 0.05}
stages:
  - name: pretrain
    variant: music-u
    env_steps: 50000
  - name: finetune
    variant: music-r
    init_from: pretrain
    replay: {hindsight_k: 4}
    grid:
      tac.entropic_index: [1.0, 1.5, 2.0]
```

A setting can be written in several places. From the lowest to the highest priority they are: the
variant, the `preset`, `defaults`, the stage, its `per_task` entry for the task, and the point of
its `grid`. The groups `evaluation`, `tac`, `music`, `intrinsic` and `replay` are merged field by
field.

All problems of a file are reported at once, before anything starts, each with file, line, key, rule
and value. Files follow YAML 1.2: `1e-3` is a number and `no` is text. `1e6` is accepted as an
integer. Repeated and unknown keys are errors.

`preset: small` (for two cores), `sample-efficient` (with symmetries of the task), `paper`,
`music-2021` or `tac-2020` uses the settings of a file in
[music_rllib/presets](../music_rllib/presets), which documents the source of its numbers.
`music-rllib presets` lists the presets.

On the command line, `KEY=VALUE` after the file replaces values of the file. Values are YAML:

```sh
music-rllib run my_sweep.yaml tac.alpha=0.1 seeds=5 env_steps=1e6
music-rllib plan my_sweep.yaml stages.finetune.grid.tac.entropic_index='[1, 1.25]'
```

A setting (`tac.alpha`, `env_steps`) replaces the values in `defaults`, in all stages and under
`per_task`. `stages.NAME.KEY` changes one stage. A top-level key (`seeds`) replaces the value in the
file: `seeds=3` means 0, 1 and 2, while `--seeds 3` takes the file's seeds first. A setting that a
`grid` or `search` varies can only be replaced there. The sweep's folder contains the complete
configuration (`config.json`), which `resume` uses.
"""

SEARCH_TEXT = """\
### Search

A stage with `search` instead of `grid` searches for its trials. [search.md](search.md) explains
which kind of search answers which question.
"""

VARIANTS_TEXT = """\
## Variants

`variant` fixes some settings of `music`; other values are errors. A setting without effect in a
variant (such as `music.lr` in MUSIC-r) is an error in a stage, and ignored in `defaults` and
presets. The networks that it takes over
come from the run that `init_from` names. `intrinsic-u` and `intrinsic-r` are the counterparts of
MUSIC-u and MUSIC-r for `intrinsic.reward`, which every other variant can have too. The default of
`music.mi_reward_weight` is 1 for MUSIC-u and the task's `mi_reward_weight` for MUSIC-r.
"""

SCHEDULES_TEXT = """\
## Schedules

A setting of type *schedule* is a number (a constant) or a mapping with the key `schedule`, whose
value changes with the environment steps of the run. After its end, a schedule keeps its last value.
Examples: `{schedule: linear, start: 1.0, end: 2.0}`,
`{schedule: piecewise, points: [[0, 1.0], [50000, 0.0]], interpolation: hold}`.
"""

MEASURED_TEXT = """\
### Measured schedules

A setting of type *measured* can also be a mapping with the key `follows`, which makes the value a
function of a measured quantity: `{follows: success_rate, points: [[0.2, 2.0], [0.9, 1.0]],
monotone: true}`. The success rate is measured at evaluations (`evaluation.interval`), the entropy
in the updates after each round of episodes. [comparing_q.md](comparing_q.md) has an example.
"""

# --- the document ------------------------------------------------------------------------------


def document() -> str:
    """The whole page."""
    parts = [
        INTRODUCTION,
        "## The file",
        table(
            [
                *rows(Header, "", skip=("mlflow", "resources", "checkpoints", "analysis")),
                *rows(MlflowSettings, "mlflow."),
                *rows(Resources, "resources."),
                *rows(Checkpoints, "checkpoints."),
                *rows(Analysis, "analysis."),
            ]
        ),
        "## Stages",
        "A stage has these keys and any of the [settings](#settings).",
        table([*rows(StageHeader, "", skip=("init_from",)), *init_from()]),
        SEARCH_TEXT,
        table(rows(SearchSettings, "search.")),
        "An entry of `search.space` has exactly one of `float`, `int` and `choice`:",
        table(dimensions()),
        "An entry of `search.objective`:",
        table(rows(Objective, "objective.")),
        "The other groups:",
        table(
            [
                *rows(Pruning, "pruning.", skip=("rungs",)),
                ("pruning.rungs", "list", "required", docstrings(Pruning)["rungs"]),
                *rows(Rung, "pruning.rungs[]."),
                *rows(FinalRanking, "final."),
            ]
        ),
        VARIANTS_TEXT,
        variants(),
        "## Settings",
        "`defaults` and stages have groups (`tac: {lr: 0.001}`), a `grid` dotted keys (`tac.lr`).",
        table(
            [
                *rows(RunSettings, "", only=("env_steps", "num_envs")),
                *rows(Evaluation, "evaluation."),
            ]
        ),
        "### tac",
        table(rows(TACSettings, "tac.")),
        "A learned `tac.alpha`:",
        table(rows(LearnedAlpha, "tac.alpha.")),
        "A `tac.alpha` that is scaled for each q, to compare q at equal pressure "
        "([comparing q](comparing_q.md)); its keys can be searched (`tac.alpha.value`):",
        table(rows(MatchedAlpha, "tac.alpha.")),
        "A `tac.alpha` that is scaled by the largest entropy of each q:",
        table(rows(NormalisedAlpha, "tac.alpha.")),
        "A `tac.behaviour` with noise:",
        table(rows(GaussianNoise, "tac.behaviour.")),
        "A `tac.behaviour` with correlated noise:",
        table(rows(ColoredNoise, "tac.behaviour.")),
        "### music",
        table(rows(MusicSettings, "music.")),
        "### intrinsic",
        table(rows(IntrinsicSettings, "intrinsic.")),
        "### replay",
        table(rows(ReplaySettings, "replay.")),
        SCHEDULES_TEXT,
        table(rows(Linear, "")),
        table(rows(Piecewise, "")),
        MEASURED_TEXT,
        table(rows(Measured, "")),
        "## Environments",
        "`environments` maps a task's name to its definition:",
        table(rows(Task, "", skip=("name",))),
        "`symmetries` of an environment ([example](add_an_environment.md#symmetries)):",
        table([*rows(Mirror, "mirror."), *rows(Translation, "translate[].")]),
    ]
    return "\n\n".join(part.strip() for part in parts) + "\n"


Row = tuple[str, str, str, str]


def dimensions() -> Iterator[Row]:
    """The kinds of entries of a space; their common fields are listed once."""
    seen = set()
    for kind in (FloatRange, IntRange, Choice):
        for row in rows(kind, "", skip=("when",)):
            if row[0] not in seen:
                seen.add(row[0])
                yield row
    yield "when", "mapping", "`{}`", docstrings(FloatRange)["when"]


def table(cells: Iterator[Row] | list[Row]) -> str:
    """A table of settings."""
    lines = ["| key | type | default | meaning |", "|---|---|---|---|"]
    for key, kind, default, meaning in cells:
        escaped = (cell.replace("|", r"\|") for cell in (f"`{key}`", kind, default, meaning))
        lines.append(f"| {' | '.join(escaped)} |")
    return "\n".join(lines)


def variants() -> str:
    """The table of variants."""
    sources = {
        "scratch": "nothing",
        "estimator": "the estimator",
        "agent": "policy, critics, value, their averages, and the observation normalizer",
        "intrinsic": "the networks and the scale of the intrinsic reward",
    }
    lines = ["| variant | fixes | takes over |", "|---|---|---|"]
    for name, rules in VARIANTS.items():
        fixed = ", ".join(f"`{key}: {json.dumps(value)}`" for key, value in rules.fixed.items())
        lines.append(f"| `{name}` | {fixed} | {sources[rules.starts_from]} |")
    return "\n".join(lines)


def init_from() -> Iterator[Row]:
    """`init_from` and its keys; YAML also accepts a bare name, which the model does not have."""
    field = StageHeader.model_fields["init_from"]
    kind = "name, mapping or null"
    yield "init_from", kind, default_of(field), docstrings(StageHeader)["init_from"]
    yield from rows(InitFrom, "init_from.")


def rows(
    model: type[BaseModel], prefix: str, *, skip: tuple[str, ...] = (), only: tuple[str, ...] = ()
) -> Iterator[Row]:
    """One row for each field of `model`, or for those of `only`.

    Raises:
        ValueError: a field has no docstring.
    """
    meanings = docstrings(model)
    for name, field in model.model_fields.items():
        if name not in skip and (not only or name in only):
            if name not in meanings:
                raise ValueError(f"{model.__name__}.{name} must have a docstring below it")
            kind = _annotated(field.annotation, tuple(field.metadata))
            yield f"{prefix}{field.alias or name}", kind, default_of(field), meanings[name]


def default_of(field: FieldInfo) -> str:
    """The default as written in YAML."""
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json", exclude_none=True)
    return f"`{json.dumps(value)}`"


# --- types in words ----------------------------------------------------------------------------

_PLAIN = {
    bool: "true or false",
    int: "integer",
    float: "number",
    str: "text",
    type(None): "null",
    Any: "anything",
}
_SIGNS = (
    (annotated_types.Gt, ">", "gt"),
    (annotated_types.Ge, ">=", "ge"),
    (annotated_types.Lt, "<", "lt"),
    (annotated_types.Le, "<=", "le"),
)


def type_of(annotation: Any) -> str:
    """An annotation in words, with its bounds."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _annotated(arguments[0], arguments[1:])
    if annotation in _PLAIN:
        return _PLAIN[annotation]
    if origin is Literal:
        return " or ".join(f"`{json.dumps(value).strip(chr(34))}`" for value in arguments)
    if origin in (Union, types.UnionType):
        return _union(arguments)
    if origin is dict:
        return "mapping"
    if origin is list or (origin is tuple and arguments[-1] is ...):
        return f"list of {type_of(arguments[0])}"
    if origin is tuple:
        return f"[{', '.join(type_of(argument) for argument in arguments)}]"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "mapping"
    return "anything"  # JsonValue


def _annotated(inner: Any, metadata: tuple[Any, ...]) -> str:
    rules = []
    for item in _flat(metadata):
        if isinstance(item, BeforeValidator) and item.json_schema_input_type is not Any:
            inner = item.json_schema_input_type
        if isinstance(item, AfterValidator) and (item.func.__doc__ or "").startswith("Rule: "):
            rules.append(str(item.func.__doc__).removeprefix("Rule: "))
        for kind, sign, key in _SIGNS:
            if isinstance(item, kind):
                rules.append(f"{sign} {getattr(item, key):.10g}")
    words = type_of(inner)
    separator = ", " if " or " in words else " "
    return separator.join(filter(None, (words, " and ".join(rules))))


def _flat(metadata: tuple[Any, ...]) -> Iterator[Any]:
    """The metadata of an annotation, with pydantic's `Field(...)` replaced by its constraints."""
    for item in metadata:
        yield from item.metadata if isinstance(item, FieldInfo) else (item,)


def _union(members: tuple[Any, ...]) -> str:
    bare = {_bare(member) for member in members}
    words = [type_of(member) for member in members if _bare(member) not in _SCHEDULES]
    if Linear in bare:
        words.append("[schedule](#schedules)")
    if Measured in bare:
        words.append("[measured](#measured-schedules)")
    separator = ", or " if any(", >" in word for word in words) else " or "
    return separator.join(dict.fromkeys(words))


_SCHEDULES = (Linear, Piecewise, Measured)


def _bare(annotation: Any) -> Any:
    return get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation


# --- the JSON Schema ---------------------------------------------------------------------------


def docstrings(model: type[BaseModel]) -> dict[str, str]:
    """Field of a settings model to the text of the docstring below it, on one line."""
    texts = {}
    for kind in reversed(model.__mro__):
        # Models that `json_schema` creates have no source.
        if not kind.__module__.startswith("music_rllib."):
            continue
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
        assert isinstance(definition, ast.ClassDef)
        for field, below in zip(definition.body, definition.body[1:], strict=False):
            match field, below:
                case ast.AnnAssign(target=ast.Name(name)), ast.Expr(ast.Constant(text)):
                    texts[name] = " ".join(str(text).split())
    return texts


class _Described(GenerateJsonSchema):
    """Describes fields by the docstrings below them."""

    def model_schema(self, schema: core_schema.ModelSchema) -> dict[str, Any]:
        document = super().model_schema(schema)
        fields = schema["cls"].model_fields
        for name, text in docstrings(schema["cls"]).items():
            alias = fields[name].alias if name in fields else None
            if (field := document["properties"].get(alias or name)) is not None:
                field["description"] = text
        return document


def json_schema() -> dict[str, Any]:
    """The JSON Schema of a sweep's file: names, types, defaults, descriptions.

    It accepts more than the program: rules between settings are checked when a sweep is loaded.
    """
    settings: dict[str, Any] = {}
    for name in LAYER_KEYS:
        field = RunSettings.model_fields[name]
        kind = field.rebuild_annotation()
        # A group with nothing below it, `tac:`, has no value.
        settings[name] = (kind | None if name in SECTIONS else kind, field.get_default())
    layer = create_model("Settings", __base__=StrictModel, **settings)
    stage = create_model(
        "Stage",
        __base__=StageHeader,
        **settings | {"init_from": (InitFrom | str | None, None)},
    )
    definition = create_model("TaskDefinition", __base__=Task, name=(str, "its key"))
    sweep = create_model(
        "Sweep",
        __base__=Header,
        seeds=(int | tuple[int, ...], (0,)),
        preset=(str | None, None),
        environments=(dict[str, definition] | None, None),
        defaults=(layer | None, layer()),
        stages=(tuple[stage, ...], ...),
    )
    document: dict[str, Any] = sweep.model_json_schema(schema_generator=_Described)
    _add_suggestions(document)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **document}


def _add_suggestions(document: dict[str, Any]) -> None:
    """Add values and descriptions that an editor can offer and types do not have."""
    properties, parts = document["properties"], document["$defs"]
    for keys in (properties, parts["Stage"]["properties"]):
        for kind in keys["tasks"].get("anyOf", [keys["tasks"]]):
            if kind.get("type") == "array":
                kind["items"] = {"type": "string", "examples": list(BUILT_IN_TASKS)}
    properties["preset"]["examples"] = list(shipped_presets())
    grid = parts["Stage"]["properties"]["grid"]
    grid["properties"] = {name: {"type": "array"} for name in all_settings() if "." in name}


def main() -> int:
    """Write the page and the schema, or check them; the exit code."""
    wanted = {TARGET: document(), SCHEMA: json.dumps(json_schema(), indent=1) + "\n"}
    for path, text in wanted.items():
        if sys.argv[1:] != ["--check"]:
            path.write_text(text, encoding="utf-8")
        elif path.read_text(encoding="utf-8") != text:
            print(f"{path.name} is out of date: run python docs/{Path(__file__).name}")
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
