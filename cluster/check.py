"""Hold the files of this folder against their schemas, before anything is started with them.

    python cluster/check.py                      # all of them
    python cluster/check.py cluster/onprem.yaml  # one, for instance after a change

The launcher's files are checked by the installed Ray itself (and node types by botocore, where that
is installed), Serve's by Ray Serve, the others by the schemas in `schemas/`. What a schema can't
say is checked too: addresses nobody has put in yet, ports open to the world, missing files.

Exit codes: 0 all is sound, 2 something isn't; one line per problem.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import json
import logging
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jsonschema
import yaml
from referencing import Registry
from referencing.jsonschema import DRAFT7

HERE = Path(__file__).resolve().parent
SCHEMAS = HERE / "schemas"
Problems = Iterator[str]


def _schema(name: str) -> Any:
    return json.loads((SCHEMAS / name).read_text(encoding="utf-8"))


def _violations(document: Any, validator: Any) -> Problems:
    for error in validator.iter_errors(document):
        deepest = jsonschema.exceptions.best_match([error])
        place = ".".join(str(part) for part in deepest.absolute_path) or "the file"
        yield f"{place}: {deepest.message[:300]}"


def strings(value: Any, place: str = "") -> Iterator[tuple[str, str]]:
    """Every text in a document, with its place."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from strings(inner, f"{place}.{key}" if place else str(key))
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from strings(inner, f"{place}.{index}")
    elif isinstance(value, str):
        yield place, value


def check_placeholders(document: Any) -> Problems:
    """Addresses that are to be replaced; nothing else in these files is a placeholder."""
    for place, text in strings(document):
        if re.search(r"\.invalid\b|CHANGE.?ME|<[a-z-]+>", text, re.IGNORECASE):
            yield f"{place}: must be replaced by a value of yours, got {text!r}"


# -- Ray's cluster launcher ---------------------------------------------------------------------


def check_launcher(document: dict[str, Any], _: Path) -> Problems:
    """As `ray up` does before it reaches for any machine."""
    from ray.autoscaler._private.util import prepare_config, validate_config

    logging.getLogger("ray.autoscaler._private.util").setLevel(logging.WARNING)
    yield from check_placeholders(document)
    try:
        # Ray remarks on file mounts for containers, of which there are none here.
        with contextlib.redirect_stdout(None), contextlib.redirect_stderr(None):
            validate_config(prepare_config(copy.deepcopy(document)))
    except Exception as error:  # Ray's own kinds, and those of jsonschema
        yield str(error).strip().splitlines()[0]
        return
    for remote, local in document.get("file_mounts", {}).items():
        path = Path(local).expanduser()
        if not (path if path.is_absolute() else HERE.parent / path).exists():
            hint = "; run 'ray get-auth-token --generate'" if "auth_token" in local else ""
            yield f"file_mounts.{remote}: {local} must exist{hint}"
    if document["provider"]["type"] == "aws":
        yield from _check_instances(document["available_node_types"])
    for command in ("head_start_ray_commands", "worker_start_ray_commands"):
        if "RAY_AUTH_MODE=token" not in " ".join(document.get(command, ())):
            yield f"{command}: must set RAY_AUTH_MODE=token"


def _check_instances(node_types: dict[str, Any]) -> Problems:
    """Against the service's own description of RunInstances."""
    try:
        from botocore.loaders import Loader
        from botocore.model import ServiceModel
        from botocore.validate import ParamValidator
    except ImportError:
        return
    service = ServiceModel(Loader().load_service_model("ec2", "service-2"), "ec2")
    shape = service.operation_model("RunInstances").input_shape
    for name, node_type in node_types.items():
        wanted = {"MinCount": 1, "MaxCount": 1} | node_type["node_config"]
        report = ParamValidator().validate(wanted, shape)
        if report.has_errors():
            yield f"available_node_types.{name}.node_config: {report.generate_report()}"


# -- compose ------------------------------------------------------------------------------------


def check_compose(document: dict[str, Any], path: Path) -> Problems:
    """The Compose Specification, and what it leaves open."""
    validator = jsonschema.Draft202012Validator(_schema("compose-spec.json"))
    problems = list(_violations(document, validator))
    yield from problems
    yield from check_placeholders(document)
    if problems:
        return
    for name, service in document["services"].items():
        for port in service.get("ports", ()):
            if not str(port).startswith("127.0.0.1:"):
                yield f"services.{name}.ports: must be published on 127.0.0.1 only, got {port}"
        for volume in service.get("volumes", ()):
            source = volume.partition(":")[0]
            if source.startswith("."):
                if not (path.parent / source).exists():
                    yield f"services.{name}.volumes: {source} must exist"
            elif source not in document.get("volumes", {}):
                yield f"services.{name}.volumes: {source} must be listed under volumes"
        for other in service.get("depends_on", ()):
            if other not in document["services"]:
                yield f"services.{name}.depends_on: {other} must be a service"
        if "build" in service:
            yield from _check_build(name, service["build"], path)


def _check_build(name: str, build: dict[str, str], compose: Path) -> Problems:
    dockerfile = compose.parent / build["context"] / build["dockerfile"]
    stages = re.findall(r"^FROM \S+ AS (\w+)", dockerfile.read_text(encoding="utf-8"), re.MULTILINE)
    if build.get("target") not in stages:
        yield f"services.{name}.build.target: must be one of {stages}, got {build.get('target')}"


# -- KubeRay ------------------------------------------------------------------------------------


def kuberay_validator() -> Any:
    """For RayCluster and RayJob, pods included."""
    core = DRAFT7.create_resource(_schema("kubernetes-1.34.json"))
    registry: Registry[Any] = Registry().with_resource("kubernetes-1.34.json", core)
    return jsonschema.Draft7Validator(_schema("kuberay-1.6.json"), registry=registry)


def check_kuberay(document: dict[str, Any], _: Path, crds: Path | None = None) -> Problems:
    """A RayCluster or a RayJob."""
    own = kuberay_validator()
    kind = document.get("kind")
    definition = {"$ref": f"#/definitions/{kind}"} if kind in ("RayCluster", "RayJob") else {}
    yield from _violations(document, own.evolve(schema=_schema("kuberay-1.6.json") | definition))
    yield from check_placeholders(document)
    if crds is not None:
        yield from _violations(document, jsonschema.Draft7Validator(_from_crd(crds, str(kind))))


def _from_crd(folder: Path, kind: str) -> Any:
    definition = yaml.safe_load((folder / f"ray.io_{kind.lower()}s.yaml").read_text())
    (version,) = [v for v in definition["spec"]["versions"] if v["name"] == "v1"]
    return _strict(version["schema"]["openAPIV3Schema"])


def _strict(schema: Any) -> Any:
    """A CRD's schema as the API server applies it with `--validate=strict`."""
    if isinstance(schema, list):
        return [_strict(inner) for inner in schema]
    if not isinstance(schema, dict):
        return schema
    strict = {key: _strict(inner) for key, inner in schema.items()}
    if strict.get("x-kubernetes-int-or-string"):
        strict = {"type": ["integer", "string"]}
    if "properties" in strict and "additionalProperties" not in strict:
        # `metadata` is declared without its fields.
        strict["additionalProperties"] = False
    return strict


def check_claim(document: dict[str, Any], _: Path) -> Problems:
    """A PersistentVolumeClaim."""
    schema = _schema("kubernetes-1.34.json") | {
        "$ref": "#/definitions/io.k8s.api.core.v1.PersistentVolumeClaim"
    }
    yield from _violations(document, jsonschema.Draft7Validator(_inlined(schema)))


def _inlined(schema: dict[str, Any]) -> dict[str, Any]:
    """Draft 7 ignores what stands beside a `$ref`."""
    return {"definitions": schema["definitions"], "allOf": [{"$ref": schema["$ref"]}]}


# -- Ray Serve ----------------------------------------------------------------------------------


def check_serve(document: dict[str, Any], _: Path) -> Problems:
    """As `serve deploy` does, and the arguments as the application does."""
    from pydantic import ValidationError
    from ray.serve.schema import ServeDeploySchema

    from music_rllib.serve.application import ServeSettings

    yield from check_placeholders(document)
    try:
        # Serve itself takes unknown keys in silence, for later versions of itself.
        known = ServeDeploySchema.model_validate(document).model_dump(exclude_unset=True)
        yield from _unknown(document, known)
        for application in document["applications"]:
            settings = ServeSettings.model_validate(application["args"])
            open_to_all = document["http_options"]["host"] != "127.0.0.1"
            if open_to_all and not settings.token_required:
                yield "applications.args.token_required: must be true where host is not loopback"
    except ValidationError as error:
        for finding in error.errors():
            yield f"{'.'.join(map(str, finding['loc']))}: {finding['msg']}"


def _unknown(given: Any, known: Any, place: str = "") -> Problems:
    if isinstance(given, dict) and isinstance(known, dict):
        for key, value in given.items():
            if key not in known:
                yield f"{place}{key}: is no key of Ray Serve's configuration"
            elif key != "args":
                yield from _unknown(value, known[key], f"{place}{key}.")
    elif isinstance(given, list) and isinstance(known, list):
        for index, pair in enumerate(zip(given, known, strict=True)):
            yield from _unknown(*pair, f"{place}{index}.")


# -- which file is what -------------------------------------------------------------------------


def check_file(path: Path, crds: Path | None = None) -> list[str]:
    """What is wrong with one file; its content says what kind it is."""
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError) as error:
        return [str(error).replace("\n", " ")]
    return check_document(document, path, crds)


def check_document(document: Any, path: Path, crds: Path | None = None) -> list[str]:
    """The same of a file's content; paths in it are relative to `path`."""
    if not isinstance(document, dict):
        return ["must be a mapping"]
    if document.get("apiVersion") == "ray.io/v1":
        return list(check_kuberay(document, path, crds))
    for key, check in KINDS.items():
        if key in document:
            return list(check(document, path))
    return [f"must be one of {', '.join(KINDS)} by its keys"]


KINDS: dict[str, Callable[[dict[str, Any], Path], Problems]] = {
    "provider": check_launcher,
    "services": check_compose,
    "applications": check_serve,
    "apiVersion": check_claim,
}
ALL = (
    "aws.yaml",
    "compose.yaml",
    "kuberay/raycluster/raycluster.yaml",
    "kuberay/rayjob/rayjob.yaml",
    "kuberay/storage/storage.yaml",
    "onprem.yaml",
    "serve.yaml",
)


def main() -> int:
    """Check, and say what is wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="*", type=Path, help="instead of all files of cluster/")
    parser.add_argument("--crds", type=Path, metavar="FOLDER", help="KubeRay's own CRDs")
    arguments = parser.parse_args()
    wrong = 0
    for path in arguments.files or [HERE / name for name in ALL]:
        problems = check_file(path, arguments.crds)
        wrong += len(problems)
        print(f"{path}: {'sound' if not problems else ''}", file=sys.stdout)
        for problem in problems:
            print(f"  {problem}")
    return 2 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
