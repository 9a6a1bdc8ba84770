"""The JSON Schema of a sweep's file, for editors: names, types, defaults, descriptions.

It accepts more than the program: rules between settings are checked when a sweep is loaded.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from typing import Any

from pydantic import BaseModel, create_model
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import core_schema

from music_rllib.config.layers import LAYER_KEYS, all_settings
from music_rllib.config.presets import shipped_presets
from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Header, InitFrom, StageHeader
from music_rllib.envs.tasks import BUILT_IN_TASKS, Task


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
    """The schema as plain data."""
    settings: dict[str, Any] = {}
    for name in LAYER_KEYS:
        field = RunSettings.model_fields[name]
        settings[name] = (field.rebuild_annotation(), field.get_default())
    layer = create_model("Settings", **settings)
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
        environments=(dict[str, definition], {}),
        defaults=(layer, layer()),
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
    properties["preset"]["description"] = "Settings below `defaults`, by name or by path."
    properties["environments"]["description"] = "Tasks of your own."
    properties["defaults"]["description"] = "Settings of every stage."
    properties["stages"]["description"] = "What is trained, in order."
    grid = parts["Stage"]["properties"]["grid"]
    grid["properties"] = {name: {"type": "array"} for name in all_settings() if "." in name}
