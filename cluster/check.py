"""Check the files of this folder against their schemas, before using them.

    python cluster/check.py                      # all of them
    python cluster/check.py cluster/onprem.yaml  # one, for instance after a change

The installed Ray checks the launcher's files (and botocore, if installed, their node types), Ray
Serve its own, this package sweeps, and the schemas in `schemas/` those of compose and Kubernetes.
For Prometheus, Grafana and kustomize only required keys are checked. Other checks: placeholders of
addresses, ports open to the world, missing files.

Prints one line per problem. Exit codes: 0 no problem, 2 problems.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import json
import logging
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jsonschema
import yaml
from referencing import Registry
from referencing.jsonschema import DRAFT7

HERE = Path(__file__).resolve().parent
SCHEMAS = HERE / "schemas"
Problems = Iterator[str]
Crds = Mapping[str, Any]
"""Kind to KubeRay's own schema of it."""


def _schema(name: str) -> Any:
    return json.loads((SCHEMAS / name).read_text(encoding="utf-8"))


def _violations(document: Any, validator: Any) -> Problems:
    for error in validator.iter_errors(document):
        deepest = jsonschema.exceptions.best_match([error])
        place = ".".join(str(part) for part in deepest.absolute_path) or "the file"
        forbidden = deepest.validator == "not" and not deepest.validator_value
        message = "must not be given beside the others" if forbidden else deepest.message[:300]
        yield f"{place}: {message}"


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
    """Addresses that the user must replace; these files have no other placeholders."""
    for place, text in strings(document):
        if re.search(r"\.invalid\b|CHANGE.?ME|<[a-z-]+>", text, re.IGNORECASE):
            yield f"{place}: must be replaced by a value of yours, got {text!r}"


# -- Ray's cluster launcher ---------------------------------------------------------------------


def check_launcher(document: dict[str, Any], _: Path) -> Problems:
    """Check as `ray up` does before it connects to any machine."""
    from ray.autoscaler._private.util import prepare_config, validate_config

    logging.getLogger("ray.autoscaler._private.util").setLevel(logging.WARNING)
    yield from check_placeholders(document)
    try:
        # Ray warns about file mounts for containers, which are not used here.
        with contextlib.redirect_stdout(None), contextlib.redirect_stderr(None):
            prepared = prepare_config(copy.deepcopy(document))
            validate_config(prepared)
    except Exception as error:  # Exceptions of Ray, of jsonschema, and of Ray's own bugs
        lines = str(error).strip().splitlines()
        yield lines[0] if lines and not isinstance(error, _ACCIDENTS) else _not_taken(error)
        return
    for remote, local in (document.get("file_mounts") or {}).items():
        path = Path(local).expanduser()
        if not (path if path.is_absolute() else HERE.parent / path).exists():
            hint = "; run 'ray get-auth-token --generate'" if "auth_token" in local else ""
            yield f"file_mounts.{remote}: {local} must exist{hint}"
    if prepared["provider"]["type"] == "aws":
        yield from _check_instances(prepared["available_node_types"])
    for command in ("head_start_ray_commands", "worker_start_ray_commands"):
        if "RAY_AUTH_MODE=token" not in " ".join(document.get(command) or ()):
            yield f"{command}: must set RAY_AUTH_MODE=token"


_ACCIDENTS = (AttributeError, IndexError, KeyError, TypeError)
"""Exceptions of Ray where it relies on a key or a type that is missing."""


def _not_taken(error: Exception) -> str:
    return f"the file: must be a configuration that Ray's launcher takes, which fails: {error!r}"


def _check_instances(node_types: dict[str, Any]) -> Problems:
    """Check against EC2's own description of RunInstances."""
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
    """Check against the Compose Specification, and rules that it does not contain."""
    validator = jsonschema.Draft202012Validator(_schema("compose-spec.json"))
    problems = list(_violations(document, validator))
    yield from problems
    yield from check_placeholders(document)
    if problems:
        return
    volumes = document.get("volumes") or {}
    for name, service in document["services"].items():
        for port in service.get("ports", ()):
            if not _on_loopback(port):
                yield f"services.{name}.ports: must be published on 127.0.0.1 only, got {port}"
        for volume in service.get("volumes", ()):
            kind, source = _source(volume)
            # Other places of the machine may belong to other programs.
            if kind == "bind" and source[:1] == "." and not (path.parent / source).exists():
                yield f"services.{name}.volumes: {source} must exist"
            elif kind == "volume" and source not in volumes:
                yield f"services.{name}.volumes: {source} must be listed under volumes"
        for other in service.get("depends_on", ()):
            if other not in document["services"]:
                yield f"services.{name}.depends_on: {other} must be a service"
        if "build" in service:
            yield from _check_build(name, service["build"], path)


def _on_loopback(port: Any) -> bool:
    """Accepts the short form `127.0.0.1:8265:8265` and the long one with `host_ip`."""
    if isinstance(port, dict):
        return port.get("host_ip") in ("127.0.0.1", "::1")
    return str(port).startswith(("127.0.0.1:", "[::1]:"))


def _source(volume: Any) -> tuple[str, str]:
    """Kind and source of a mount, in the short form or the long one.

    The kind is `bind` for a file or folder of this machine, `volume` for a named volume, and
    another one if a source is not needed.
    """
    if isinstance(volume, dict):
        source = str(volume.get("source", ""))
        return (str(volume["type"]) if source else "anonymous"), source
    source, colon, _ = volume.partition(":")
    if not colon or source.startswith("$"):
        return "anonymous", ""
    return ("bind" if source.startswith((".", "/", "~")) else "volume"), source


def _check_build(name: str, build: Any, compose: Path) -> Problems:
    """Check that the Dockerfile and its stage exist, also for the short form `build: FOLDER`."""
    given = build if isinstance(build, dict) else {"context": build}
    place = f"services.{name}.build"
    if "dockerfile_inline" in given or "://" in str(given.get("context", "")):
        return
    dockerfile = compose.parent / given.get("context", ".") / given.get("dockerfile", "Dockerfile")
    if not dockerfile.is_file():
        yield f"{place}: {dockerfile} must exist"
        return
    stages = re.findall(r"^FROM \S+ AS (\w+)", dockerfile.read_text(encoding="utf-8"), re.MULTILINE)
    target = given.get("target")
    if target is not None and target not in stages:
        yield f"{place}.target: must be one of {', '.join(stages) or 'none'}, got {target}"


# -- KubeRay ------------------------------------------------------------------------------------


QUANTITY = "io.k8s.apimachinery.pkg.api.resource.Quantity"


def _cluster_schema() -> Any:
    """The project's schema, with the fields of KubeRay 1.7 as its CRD has them."""
    own, later = _schema("kuberay-1.6.json"), _strict(_schema("kuberay-1.7-crd.json"))
    own["definitions"]["RayClusterSpec"]["properties"] |= later["properties"]
    return own


def kuberay_validator() -> Any:
    """Check a RayCluster or RayJob, including its pods."""
    own, core = _cluster_schema(), _schema("kubernetes-1.34.json")
    # Kubernetes itself accepts any number and text at first.
    core["definitions"][QUANTITY] = own["definitions"]["Quantity"]
    resource = DRAFT7.create_resource(core)
    registry: Registry[Any] = Registry().with_resource("kubernetes-1.34.json", resource)
    return jsonschema.Draft7Validator(own, registry=registry)


def check_kuberay(document: dict[str, Any], _: Path, crds: Crds | None = None) -> Problems:
    """A RayCluster or a RayJob."""
    kind = document.get("kind")
    if kind not in tuple(CRD_FILES):
        yield f"kind: must be {' or '.join(CRD_FILES)}, got {kind!r}"
        return
    own = kuberay_validator().evolve(schema=_cluster_schema() | {"$ref": f"#/definitions/{kind}"})
    problems = list(_violations(document, own))
    yield from problems
    yield from check_placeholders(document)
    if crds is not None:
        yield from _violations(document, jsonschema.Draft7Validator(crds[kind]))
    if not problems:
        yield from _check_secret(document)
        yield from _check_groups(document)
        yield from _check_twins(document)


CRD_FILES = {"RayCluster": "ray.io_rayclusters.yaml", "RayJob": "ray.io_rayjobs.yaml"}


def _check_secret(document: dict[str, Any]) -> Problems:
    """KubeRay uses the Secret with the cluster's name for its token."""
    if document["kind"] != "RayCluster" or "secretName" in document["spec"].get("authOptions", {}):
        return
    name = document["metadata"]["name"]
    for place, text in strings(document):
        if text == name and re.search(r"\.(secretRef|secretKeyRef)\.name$", place):
            yield f"{place}: must be no Secret of the cluster's name, that is KubeRay's own: {name}"


def _check_groups(document: dict[str, Any]) -> Problems:
    """Check rules of KubeRay's operator that a schema cannot express."""
    place, spec = "spec", document["spec"]
    if document["kind"] == "RayJob":
        place, spec = "spec.rayClusterSpec", spec.get("rayClusterSpec", {})
    if spec.get("authOptions", {}).get("mode") == "token":
        version = tuple(map(int, re.findall(r"\d+", spec["rayVersion"])[:2]))
        if version < (2, 52):
            yield f"{place}.rayVersion: must be >= 2.52.0 for mode: token, got {spec['rayVersion']}"
    state = spec.get("gcsFaultToleranceOptions", {"backend": "rocksdb"})
    if state.get("backend") != "rocksdb" and "redisAddress" not in state:
        yield f"{place}.gcsFaultToleranceOptions.redisAddress: must be given without rocksdb"
    scaled = spec.get("enableInTreeAutoscaling", False)
    for index, group in enumerate(spec.get("workerGroupSpecs", ())):
        where = f"{place}.workerGroupSpecs.{index}"
        least, most = group.get("minReplicas", 0), group.get("maxReplicas", 2**31 - 1)
        if least > most:
            yield f"{where}.minReplicas: must be <= maxReplicas, {most}, got {least}"
        if scaled and group.get("suspend", False):
            yield f"{where}.suspend: must be false where enableInTreeAutoscaling is true"


_TOLD_APART_BY = {
    **dict.fromkeys(("containers", "initContainers", "volumes", "env"), ("name",)),
    "volumeMounts": ("mountPath",),
    "ports": ("containerPort", "port", "protocol"),  # ports of containers, ports of services
}
"""Lists of a pod whose entries must differ in these keys."""


def _check_twins(value: Any, place: str = "") -> Problems:
    """Check rules of the API server for lists that it treats as maps."""
    if isinstance(value, list):
        for index, inner in enumerate(value):
            yield from _check_twins(inner, f"{place}.{index}")
    if not isinstance(value, dict):
        return
    for name, inner in value.items():
        where = f"{place}.{name}".removeprefix(".")
        yield from _check_twins(inner, where)
        if name in _TOLD_APART_BY and isinstance(inner, list):
            yield from _check_list(inner, where, _TOLD_APART_BY[name])


def _check_list(entries: list[Any], place: str, keys: tuple[str, ...]) -> Problems:
    seen = set()
    for index, entry in enumerate(entries):
        values = tuple(entry.get(key, "TCP" if key == "protocol" else None) for key in keys)
        if values in seen:
            pairs = zip(keys, values, strict=True)
            told = " and ".join(f"{key} {value}" for key, value in pairs if value is not None)
            yield f"{place}.{index}: must be the only one with {told}"
        seen.add(values)


def read_crds(folder: Path) -> Crds:
    """KubeRay's own schemas.

    Raises:
        CrdError: They are not there.
    """
    schemas = {}
    for kind, file in CRD_FILES.items():
        try:
            definition = yaml.safe_load((folder / file).read_text(encoding="utf-8"))
            versions = definition["spec"]["versions"]
            (version,) = [version for version in versions if version["name"] == "v1"]
            schemas[kind] = _strict(version["schema"]["openAPIV3Schema"])
        except OSError as error:
            raise CrdError(
                f"--crds must be a folder with {' and '.join(CRD_FILES.values())}, got {folder}: "
                f"{file}: {error.strerror}"
            ) from error
        except (KeyError, TypeError, ValueError, yaml.YAMLError) as error:
            raise CrdError(
                f"--crds must be a folder with KubeRay's CRDs, but {folder / file} is no CRD with "
                "a version v1"
            ) from error
    return schemas


class CrdError(ValueError):
    """The folder of `--crds` lacks a file or a field."""


def _strict(schema: Any) -> Any:
    """A CRD's schema as the API server applies it with `--validate=strict`."""
    if isinstance(schema, list):
        return [_strict(inner) for inner in schema]
    if not isinstance(schema, dict):
        return schema
    strict = {key: _strict(inner) for key, inner in schema.items()}
    if strict.get("x-kubernetes-int-or-string"):
        pattern = {key: strict[key] for key in ("pattern",) if key in strict}
        strict = {"type": ["integer", "string"], **pattern}
    fields = strict.get("properties")
    if isinstance(fields, dict) and isinstance(strict.get("required"), list):
        # The API server fills in defaults first.
        given = [name for name in strict["required"] if "default" not in fields.get(name, {})]
        strict["required"] = given
    if "properties" in strict and "additionalProperties" not in strict:
        # `metadata` is declared without its fields.
        strict["additionalProperties"] = False
    return strict


def check_claim(document: dict[str, Any], _: Path) -> Problems:
    """Check a PersistentVolumeClaim, the only built-in kind of Kubernetes in these files."""
    kind = document.get("kind")
    if kind != "PersistentVolumeClaim":
        yield f"kind: must be PersistentVolumeClaim, RayCluster or RayJob, got {kind!r}"
        return
    schema = _schema("kubernetes-1.34.json") | {
        "$ref": "#/definitions/io.k8s.api.core.v1.PersistentVolumeClaim"
    }
    yield from _violations(document, jsonschema.Draft7Validator(_inlined(schema)))


def _inlined(schema: dict[str, Any]) -> dict[str, Any]:
    """Draft 7 ignores the keys next to a `$ref`."""
    return {"definitions": schema["definitions"], "allOf": [{"$ref": schema["$ref"]}]}


# -- Ray Serve ----------------------------------------------------------------------------------


def check_serve(document: dict[str, Any], _: Path) -> Problems:
    """Check as `serve deploy` does, and the arguments as the application does."""
    from pydantic import ValidationError
    from ray.serve.schema import ServeDeploySchema

    from music_rllib.serve.application import ServeSettings

    yield from check_placeholders(document)
    try:
        # Serve itself ignores unknown keys, for compatibility with its later versions.
        given = ServeDeploySchema.model_validate(document)
        yield from _unknown(document, given.model_dump(exclude_unset=True))
    except ValidationError as error:
        yield from _findings(error)
        return
    host = given.http_options.host  # all addresses if the file names none
    for index, application in enumerate(document["applications"]):
        place = f"applications.{index}.args"
        try:
            settings = ServeSettings.model_validate(application.get("args") or {})
        except ValidationError as error:
            yield from _findings(error, f"{place}.")
            continue
        if host not in ("127.0.0.1", "::1", "localhost") and not settings.token_required:
            yield f"{place}.token_required: must be true where host is not loopback, got {host}"


def _findings(error: Any, above: str = "") -> Problems:
    for finding in error.errors():
        yield f"{above}{'.'.join(map(str, finding['loc']))}: {finding['msg']}"


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


# -- the small ones -----------------------------------------------------------------------------


def check_sweep(_: dict[str, Any], path: Path) -> Problems:
    """Check as `music-rllib run` does."""
    from music_rllib.config.load import load_config
    from music_rllib.config.problems import ConfigError

    try:
        load_config(path)
    except ConfigError as error:
        yield from str(error).splitlines()


def check_prometheus(document: dict[str, Any], _: Path) -> Problems:
    """Check that jobs have names and targets; `promtool check config` checks the rest."""
    names = set()
    for index, job in enumerate(_mappings(document["scrape_configs"])):
        place = f"scrape_configs.{index}"
        if job is None:
            yield f"{place}: must be a mapping"
            continue
        name = job.get("job_name")
        if not isinstance(name, str) or name in names:
            yield f"{place}.job_name: must be a name of its own, got {name!r}"
        names.add(name)
        if not any(key == "static_configs" or key.endswith("_sd_configs") for key in job):
            yield f"{place}: must have static_configs or a kind of *_sd_configs"


def check_datasource(document: dict[str, Any], _: Path) -> Problems:
    """Check the required keys of Grafana's datasources; Grafana logs other errors."""
    if document.get("apiVersion") != 1:
        yield f"apiVersion: must be 1, got {document.get('apiVersion')!r}"
    for index, source in enumerate(_mappings(document["datasources"])):
        if source is None:
            yield f"datasources.{index}: must be a mapping"
            continue
        for key in ("name", "type", "url"):
            if not isinstance(source.get(key), str):
                yield f"datasources.{index}.{key}: must be a text, got {source.get(key)!r}"


def check_kustomization(document: dict[str, Any], path: Path, crds: Crds | None = None) -> Problems:
    """Check the files that it combines; `kubectl kustomize FOLDER` checks the rest."""
    if not isinstance(document["resources"], list):
        yield "resources: must be a list"
        return
    for index, resource in enumerate(document["resources"]):
        target = path.parent / str(resource)
        there = target.is_file() or (target / "kustomization.yaml").is_file()
        if not there and "://" not in str(resource):
            place = f"resources.{index}"
            yield f"{place}: {resource} must be a file or a folder with kustomization.yaml"
    objects = _objects(document["resources"], path.parent)
    for index, entry in enumerate(document.get("patches", ())):
        patch = yaml.safe_load(entry.get("patch", ""))
        # A patch in a file of its own, with a target or of operations is checked by kubectl alone.
        if not isinstance(patch, dict) or "target" in entry:
            continue
        patched = [one for one in objects if _named(one) == _named(patch)]
        if not patched:
            yield f"patches.{index}: must be of an object of the resources"
        for one in patched:
            for problem in check_document(_merged(one, patch), path, crds):
                yield f"patches.{index}: {problem}"


def _objects(resources: Any, folder: Path) -> list[dict[str, Any]]:
    """The objects of a kustomization's resources, also of other kustomizations."""
    objects: list[Any] = []
    for target in (folder / str(one) for one in resources):
        if target.is_file():
            objects += yaml.safe_load_all(target.read_text(encoding="utf-8"))
        elif (inner := target / "kustomization.yaml").is_file():
            inner_document = yaml.safe_load(inner.read_text(encoding="utf-8"))
            objects += _objects((inner_document or {}).get("resources") or (), target)
    return [one for one in objects if isinstance(one, dict)]


def _named(one: dict[str, Any]) -> tuple[Any, Any]:
    return one.get("kind"), (one.get("metadata") or {}).get("name")


def _merged(document: Any, patch: Any) -> Any:
    """Merge as kustomize merges a patch into a custom resource."""
    if not isinstance(document, dict) or not isinstance(patch, dict):
        return patch
    return document | {key: _merged(document.get(key), value) for key, value in patch.items()}


def _mappings(entries: Any) -> list[dict[str, Any] | None]:
    """The entries of a list; None if an entry is not a mapping."""
    given = entries if isinstance(entries, list) else [entries]
    return [entry if isinstance(entry, dict) else None for entry in given]


# -- which file is what -------------------------------------------------------------------------


def check_file(path: Path, crds: Crds | None = None) -> list[str]:
    """Problems of one file; its content determines its kind."""
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        return [str(error).replace("\n", " ")]
    return check_document(document, path, crds)


def check_document(document: Any, path: Path, crds: Crds | None = None) -> list[str]:
    """Problems of a file's content; paths in it are relative to `path`."""
    if not isinstance(document, dict):
        return ["must be a mapping"]
    if str(document.get("apiVersion")).startswith("ray.io/"):
        return list(check_kuberay(document, path, crds))
    for key, check in KINDS.items():
        if key in document:
            more = (crds,) if check is check_kustomization else ()
            return list(check(document, path, *more))
    found = ", ".join(map(str, document)) or "none"
    return [f"must be of a kind that has one of the keys {', '.join(KINDS)}, got {found}"]


KINDS: dict[str, Callable[..., Problems]] = {
    "provider": check_launcher,
    "services": check_compose,
    "applications": check_serve,
    "stages": check_sweep,
    "scrape_configs": check_prometheus,
    "datasources": check_datasource,
    "resources": check_kustomization,
    "apiVersion": check_claim,
}
"""Keys that identify a kind, first match first: a sweep may have `resources` too."""
ALL = (
    "aws.yaml",
    "compose.yaml",
    "grafana-datasource.yml",
    "kuberay/raycluster/kustomization.yaml",
    "kuberay/raycluster/raycluster.yaml",
    "kuberay/raycluster-1.7/kustomization.yaml",
    "kuberay/rayjob/kustomization.yaml",
    "kuberay/rayjob/rayjob.yaml",
    "kuberay/storage/kustomization.yaml",
    "kuberay/storage/storage.yaml",
    "onprem.yaml",
    "prometheus.yml",
    "serve.yaml",
    "sweep.yaml",
)


def main() -> int:
    """Check the files and print their problems."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="*", type=Path, help="instead of all files of cluster/")
    parser.add_argument("--crds", type=Path, metavar="FOLDER", help="KubeRay's own CRDs")
    arguments = parser.parse_args()
    try:
        crds = None if arguments.crds is None else read_crds(arguments.crds)
    except CrdError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    wrong = 0
    for path in arguments.files or [HERE / name for name in ALL]:
        problems = check_file(path, crds)
        wrong += len(problems)
        print(f"{path}: {'sound' if not problems else ''}", file=sys.stdout)
        for problem in problems:
            print(f"  {problem}")
    return 2 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
