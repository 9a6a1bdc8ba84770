"""A JSON Schema of a sweep's file, for editors: names, types, defaults, descriptions.

It is looser than the program: rules between settings are checked where a sweep is loaded.
"""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, create_model
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import core_schema

from music_rllib.authoring.docstrings import docstrings
from music_rllib.config.reading.layers import LAYER_KEYS, all_settings
from music_rllib.config.reading.presets import shipped_presets
from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Header, InitFrom, StageHeader
from music_rllib.envs.tasks import BUILT_IN_TASKS, Task


class _Described(GenerateJsonSchema):
    """Fields are described by the docstrings below them."""

    def model_schema(self, schema: core_schema.ModelSchema) -> dict[str, Any]:
        document = super().model_schema(schema)
        model = schema["cls"]
        for kind in reversed(model.__mro__):
            if issubclass(kind, BaseModel) and kind.__module__.startswith("music_rllib."):
                if kind.__module__ == __name__:
                    continue
                for name, text in docstrings(kind).items():
                    alias = model.model_fields[name].alias if name in model.model_fields else None
                    if (field := document["properties"].get(alias or name)) is not None:
                        field["description"] = text
        return document


def json_schema() -> dict[str, Any]:
    """The schema, as plain data."""
    settings = {name: _field(RunSettings, name) for name in LAYER_KEYS}
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
    _complete(document)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **document}


def _field(model: type[BaseModel], name: str) -> Any:
    field = model.model_fields[name]
    return (field.rebuild_annotation(), field.get_default())


def _complete(document: dict[str, Any]) -> None:
    """Put in what an editor can offer and a type does not say."""
    properties, parts = document["properties"], document["$defs"]
    for keys in (properties, parts["Stage"]["properties"]):
        for one in keys["tasks"].get("anyOf", [keys["tasks"]]):
            if one.get("type") == "array":
                one["items"] = {"type": "string", "examples": list(BUILT_IN_TASKS)}
    properties["preset"]["examples"] = list(shipped_presets())
    properties["preset"]["description"] = "Settings below `defaults`, by name or by path."
    properties["environments"]["description"] = "Tasks of your own."
    properties["defaults"]["description"] = "Settings of every stage."
    properties["stages"]["description"] = "What is trained, in order."
    grid = parts["Stage"]["properties"]["grid"]
    grid["properties"] = {name: {"type": "array"} for name in all_settings() if "." in name}
