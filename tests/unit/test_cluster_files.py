"""The files of `cluster/` are valid by their real schemas, which find planted mistakes."""

from __future__ import annotations

import copy
import json
import os
import re
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft7Validator
from ray.scripts.scripts import start

import music_rllib
from cluster.check import (
    ALL,
    KINDS,
    check_document,
    check_file,
    main,
    read_crds,
    strings,
)
from music_rllib.config.load import load_config

ROOT = Path(__file__).parents[2]
CLUSTER = ROOT / "cluster"
JOB, RAY = "kuberay/rayjob/rayjob.yaml", "kuberay/raycluster/raycluster.yaml"
LATER = "kuberay/raycluster-1.7/kustomization.yaml"


@pytest.fixture(autouse=True)
def token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Token file of `ray get-auth-token --generate`."""
    (tmp_path / "home" / ".ray").mkdir(parents=True)
    (tmp_path / "home" / ".ray" / "auth_token").write_text("t")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))


def load(name: str) -> Any:
    """A file in which the user has entered a profile."""
    text = (CLUSTER / name).read_text().replace("CHANGE-ME", "mine")
    return yaml.load(text, yaml.CSafeLoader)  # ten times as fast as `safe_load`


@pytest.mark.parametrize("name", [name for name in ALL if name not in {"onprem.yaml", "aws.yaml"}])
def test_file_is_sound(name: str) -> None:
    assert check_file(CLUSTER / name) == []


def test_instances_must_have_a_profile_of_your_own() -> None:
    """Workers need one too: Ray only gives one to the head, and they would not reach the bucket."""
    problems = check_file(CLUSTER / "aws.yaml")
    assert [problem.partition(":")[0] for problem in problems] == [
        f"available_node_types.{kind}.node_config.IamInstanceProfile.Name"
        for kind in ("head", "cpu")
    ]
    assert check_document(load("aws.yaml"), CLUSTER / "aws.yaml") == []


def test_addresses_of_your_own_machines_must_be_put_in() -> None:
    problems = check_file(CLUSTER / "onprem.yaml")
    assert [problem.partition(":")[0] for problem in problems] == [
        "provider.head_ip",
        "provider.worker_ips.0",
        "provider.worker_ips.1",
    ]
    document = load("onprem.yaml")
    document["provider"] |= {"head_ip": "10.0.0.1", "worker_ips": ["10.0.0.2", "10.0.0.3"]}
    assert check_document(document, CLUSTER / "onprem.yaml") == []


def test_a_missing_token_is_noticed(tmp_path: Path) -> None:
    (tmp_path / "home" / ".ray" / "auth_token").unlink()
    (problem,) = check_document(load("aws.yaml"), CLUSTER / "aws.yaml")
    assert "run 'ray get-auth-token --generate'" in problem


Change = Callable[[Any], None]


def put(place: str, value: Any) -> Change:
    def change(document: Any) -> None:
        *above, last = place.split("/")
        for part in above:
            document = document[int(part) if part.isdigit() else part]
        if isinstance(document, list):
            document[int(last)] = value
        else:
            document[last] = value

    return change


def patch(old: str, new: str) -> Change:
    def change(document: Any) -> None:
        (entry,) = document["patches"]
        assert old in entry["patch"]
        entry["patch"] = entry["patch"].replace(old, new)

    return change


A = {"name": "A", "value": "b"}
PORT, UDP, TCP = {"containerPort": 8000}, {"protocol": "UDP"}, {"protocol": "TCP"}
MOUNT = {"name": "results", "mountPath": "/x"}
HEAD = "spec/headGroupSpec/template/spec/containers/0"
JOB_HEAD = f"spec/rayClusterSpec/{HEAD.removeprefix('spec/')}"
NODE = "available_node_types/cpu/node_config"


@pytest.mark.parametrize(
    ("name", "change", "expected"),
    [
        ("aws.yaml", put("max_worker", 3), "max_worker"),
        ("aws.yaml", put("head_node_type", "other"), "head_node_type"),
        ("aws.yaml", put("upscaling_speed", "fast"), "fast"),
        ("aws.yaml", put("available_node_types/cpu/min_worker", 1), "min_worker"),
        ("aws.yaml", put("file_mounts/~x", "no/such/file"), "no/such/file must exist"),
        ("aws.yaml", put("head_start_ray_commands", ["ray start --head"]), "RAY_AUTH_MODE=token"),
        ("aws.yaml", put(f"{NODE}/InstanceTyp", "c7i.large"), "InstanceTyp"),
        ("aws.yaml", put(f"{NODE}/MetadataOptions", {"HttpTokens": 3}), "HttpTokens"),
        ("onprem.yaml", put("auth/ssh_users", "me"), "ssh_users"),
        ("compose.yaml", put("services/head/imagee", "x"), "imagee"),
        ("compose.yaml", put("services/head/ports", ["8265:8265"]), "127.0.0.1 only"),
        ("compose.yaml", put("services/head/healthcheck/retry", 3), "retry"),
        ("compose.yaml", put("services/worker/depends_on", ["haed"]), "must be a service"),
        ("compose.yaml", put("services/mlflow/volumes", ["artefacts:/a"]), "under volumes"),
        (RAY, put("spec/headGroupSpecs", {}), "headGroupSpecs"),
        (RAY, put("spec/authOptions/mode", "tokens"), "tokens"),
        (RAY, put("spec/workerGroupSpecs/0/replicas", "many"), "many"),
        (RAY, put(f"{HEAD}/resource", {}), "resource"),
        (RAY, put(f"{HEAD}/env", [{"name": "A", "valeu": "b"}]), "valeu"),
        (RAY, put(f"{HEAD}/ports", [{"containerPort": "8265"}]), "8265"),
        (JOB, put("spec/backOffLimit", 3), "backOffLimit"),
        (JOB, put("spec/submissionMode", "Http"), "Http"),
        (JOB, put(f"{JOB_HEAD}/volumeMounts/0/mountpath", "/x"), "mountpath"),
        (JOB, put("metadata/name", "Sweep_1"), "Sweep_1"),
        (JOB, put("metadata/name", "1-sweep"), "1-sweep"),
        (JOB, put("spec/deletionStrategy", {"onSuccess": {"policy": "DeleteAll"}}), "deletionStr"),
        (JOB, put("spec/preRunningDeadlineSeconds", 0), "preRunningDeadlineSeconds"),
        (JOB, put("spec/shutdownAfterJobFinishes", False), "ttlSecondsAfterFinished"),
        (JOB, put("spec/submissionMode", "SidecarMode"), "spec.submitterConfig: must not"),
        (JOB, put("spec/submissionMode", "InteractiveMode"), "backoffLimit"),
        (JOB, put("spec/clusterSelector", {"ray.io/cluster": "x"}), "backoffLimit"),
        (JOB, put("spec/entrypoint", ""), "entrypoint"),
        (JOB, put("spec/rayClusterSpec/authOptions/enableK8sTokenAuth", True), "enableK8sToken"),
        (RAY, put("spec/rayVersion", "latest"), "latest"),
        (RAY, put("spec/rayVersion", "2.51.0"), "rayVersion: must be >= 2.52.0 for mode: token"),
        (RAY, put("metadata/name", "r" * 54), "metadata.name"),
        (JOB, put("metadata/name", "j" * 48), "metadata.name"),
        (RAY, put(f"{HEAD}/resources/limits/cpu", 0.5), "resources.limits.cpu"),
        (RAY, put(f"{HEAD}/resources/limits/memory", "8 GB"), "resources.limits.memory"),
        (RAY, put(f"{HEAD}/env", [A, A]), "env.1: must be the only one with name A"),
        (
            RAY,
            put(f"{HEAD}/ports", [PORT, PORT | UDP, PORT | TCP]),
            "ports.2: must be the only one",
        ),
        (JOB, put(f"{JOB_HEAD}/volumeMounts", [MOUNT, MOUNT]), "with mountPath /x"),
        (RAY, put("spec/authOptions", {"enableK8sTokenAuth": True}), "'mode' is a required"),
        (
            RAY,
            put(
                "spec/authOptions", {"mode": "token", "enableK8sTokenAuth": True, "secretName": "x"}
            ),
            "spec.authOptions.secretName: must not",
        ),
        (RAY, put("spec/workerGroupSpecs/0/minReplicas", 9), "must be <= maxReplicas, 8, got 9"),
        (RAY, put("spec/workerGroupSpecs/0/maxReplicas", 2**31), "maxReplicas"),
        (RAY, put("spec/workerGroupSpecs/0/suspend", True), "suspend: must be false"),
        (RAY, put("spec/workerGroupSpecs/0/scaleStrategy", {"workers": []}), "workers"),
        (RAY, put("spec/gcsFaultToleranceOptions", {}), "redisAddress"),
        (RAY, put("spec/gcsFaultToleranceOptions", {"backend": "rocksbd"}), "rocksbd"),
        (RAY, put("spec/networkPolicy", {"mode": "Deny"}), "Deny"),
        (LATER, patch("mode: DenyAllIngress", "modes: DenyAll"), "patches.0: spec.networkPolicy"),
        (LATER, patch("size: 1Gi", "size: 1 GB"), "patches.0: spec.gcsFaultToleranceOptions.stor"),
        (LATER, patch("name: music-rllib", "name: other"), "must be of an object of the resources"),
        (RAY, put("spec/upgradeStrategy", {"type": "Rolling"}), "Rolling"),
        (RAY, put("spec/autoscalerOptions/idleTimeoutSeconds", -1), "idleTimeoutSeconds"),
        ("kuberay/storage/storage.yaml", put("spec/accessMode", []), "accessMode"),
        ("serve.yaml", put("http_options/hots", "0.0.0.0"), "hots"),
        ("serve.yaml", put("applications/0/args/replica", 2), "replica"),
        ("serve.yaml", put("applications/0/args/token_required", False), "token_required"),
    ],
)
def test_planted_mistake_is_found(name: str, change: Change, expected: str) -> None:
    document = load(name)
    change(document)
    problems = check_document(document, CLUSTER / name)
    assert any(expected in problem for problem in problems), problems


RULE = {"policy": "DeleteCluster", "condition": {"jobStatus": "FAILED", "ttlSeconds": 0}}
POLICY = {"policy": "DeleteNone"}


@pytest.mark.parametrize(
    ("gone", "given"),
    [
        # In this mode another program submits the job.
        (("entrypoint", "backoffLimit"), {"submissionMode": "InteractiveMode"}),
        (("rayClusterSpec", "backoffLimit"), {"clusterSelector": {"ray.io/cluster": "x"}}),
        (("submitterConfig",), {"submissionMode": "SidecarMode"}),
        ((), {"deletionStrategy": {"onSuccess": POLICY, "onFailure": POLICY}}),
        (
            ("shutdownAfterJobFinishes", "ttlSecondsAfterFinished"),
            {"deletionStrategy": {"deletionRules": [RULE]}},
        ),
        ((), {"preRunningDeadlineSeconds": 60, "activeDeadlineSeconds": 60}),
    ],
)
def test_what_kuberay_allows_is_sound(gone: tuple[str, ...], given: dict[str, Any]) -> None:
    document = load(JOB)
    spec = {key: value for key, value in document["spec"].items() if key not in gone}
    assert check_document(document | {"spec": spec | given}, CLUSTER / JOB) == []


@pytest.mark.parametrize(
    "strategy",
    [
        {},
        {"deletionRules": []},
        {"onSuccess": POLICY},
        {"onSuccess": POLICY, "onFailure": POLICY, "deletionRules": [RULE]},
        {"deletionRules": [RULE | {"condition": {"ttlSeconds": 3}}]},
        {"deletionRules": [RULE | {"condition": {"jobStatus": "STOPPED"}}]},
        {"onSuccess": {}, "onFailure": POLICY},
    ],
)
def test_half_a_deletion_strategy_is_found(strategy: dict[str, Any]) -> None:
    document = load(JOB)
    for key in ("shutdownAfterJobFinishes", "ttlSecondsAfterFinished"):
        del document["spec"][key]
    document["spec"]["deletionStrategy"] = strategy
    problems = check_document(document, CLUSTER / JOB)
    assert problems
    assert all(problem.startswith("spec.deletionStrategy") for problem in problems), problems


VOLUME = {"type": "volume", "source": "results", "target": "/r"}
LOOPBACK = {"target": 80, "published": "80", "host_ip": "127.0.0.1"}


@pytest.mark.parametrize(
    "change",
    [
        put("services/mlflow/volumes", [VOLUME]),
        put("services/mlflow/volumes", ["/anonymous", "/srv/data:/data", "${DATA:-./x}:/data"]),
        put("services/mlflow/volumes", [{"type": "tmpfs", "target": "/tmp"}]),
        put("services/mlflow/ports", [LOOPBACK, "[::1]:80:80"]),
        put("services/mlflow/depends_on", {"postgres": {"condition": "service_started"}}),
        put("services/head/build", {"context": "https://example.org/x.git"}),
    ],
)
def test_every_form_that_compose_knows_is_taken(change: Change) -> None:
    document = load("compose.yaml")
    change(document)
    assert check_document(document, CLUSTER / "compose.yaml") == []


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (put("services/mlflow/volumes", [VOLUME | {"source": "artefacts"}]), "under volumes"),
        (put("services/mlflow/volumes", ["./none:/x"]), "./none must exist"),
        (
            put("services/mlflow/volumes", [{"type": "bind", "source": "./none", "target": "/x"}]),
            "./none must exist",
        ),
        (put("services/mlflow/ports", [LOOPBACK | {"host_ip": "0.0.0.0"}]), "127.0.0.1 only"),
        (put("services/mlflow/ports", [80]), "127.0.0.1 only"),
        (put("services/head/build", "kuberay"), "Dockerfile must exist"),
        (put("services/head/build/target", "rya"), "target: must be one of"),
    ],
)
def test_mistakes_are_found_in_every_form_of_compose(change: Change, expected: str) -> None:
    document = load("compose.yaml")
    change(document)
    # Services share parts of the file.
    problems = set(check_document(document, CLUSTER / "compose.yaml"))
    assert problems
    assert all(expected in problem for problem in problems), problems


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("provider: {type: aws}", "head_start_ray_commands: must set RAY_AUTH_MODE=token"),
        ("provider: 3", "must be a configuration that Ray's launcher takes"),
        ("provider: {}", "the file: must be"),
        ("applications: [{name: p, import_path: 'a:b'}]", "applications.0.args.policy: Field req"),
        ("applications: 3", "applications: Input should be"),
        ("services: 3", "services: 3 is not of type 'object'"),
        ("{apiVersion: ray.io/v1, kind: RayService}", "kind: must be RayCluster or RayJob, got"),
        ("{apiVersion: ray.io/v1, kind: [1]}", "kind: must be RayCluster or RayJob, got [1]"),
        ("{apiVersion: ray.io/v1, kind: RayCluster}", "'metadata' is a required property"),
        ("{apiVersion: v1, kind: Secret}", "kind: must be PersistentVolumeClaim"),
        ("scrape_configs: [3]", "scrape_configs.0: must be a mapping"),
        ("scrape_configs: [{static_configs: []}]", "job_name: must be a name of its own, got None"),
        ("scrape_configs: [{job_name: a}]", "must have static_configs or a kind of *_sd_configs"),
        ("{apiVersion: 2, datasources: []}", "apiVersion: must be 1, got 2"),
        ("{apiVersion: 1, datasources: [{name: a}]}", "datasources.0.type: must be a text"),
        ("resources: [none.yaml]", "resources.0: none.yaml must be a file or a folder with"),
        ("resources: none.yaml", "resources: must be a list"),
        ("{stages: [], seed: 1}", "seed"),
        ("{a: 1, b: 2}", "must be of a kind that has one of the keys provider, services, "),
        ("[]", "must be a mapping"),
        ("a: 1\n---\nb: 1", "expected a single document"),
        ("\x00", "unacceptable character"),
    ],
)
def test_what_is_far_from_any_schema_is_a_problem_and_no_crash(
    text: str, expected: str, tmp_path: Path
) -> None:
    (tmp_path / "file.yaml").write_text(text)
    problems = check_file(tmp_path / "file.yaml")
    assert any(expected in problem for problem in problems), problems


@pytest.mark.parametrize(
    ("name", "change"),
    [
        (RAY, put("metadata/name", "r" * 53)),
        (JOB, put("metadata/name", "j" * 47)),
        (RAY, put(f"{HEAD}/resources/limits", {"cpu": "500m", "memory": "1.5Gi", "x.y/z": 1})),
        (RAY, put(f"{HEAD}/resources/limits", {"cpu": ".5", "memory": "2e9"})),
        (RAY, put(f"{HEAD}/ports", [PORT, PORT | UDP])),
        (RAY, put("spec/rayVersion", "2.100.0")),
        (
            RAY,
            put("spec/headGroupSpec/headService", {"spec": {"ports": [{"port": 1}, {"port": 2}]}}),
        ),
    ],
)
def test_every_form_that_kuberay_knows_is_taken(name: str, change: Change) -> None:
    document = load(name)
    change(document)
    assert check_document(document, CLUSTER / name) == []


def test_a_secret_of_the_clusters_name_is_a_problem() -> None:
    document = load(RAY)
    put(f"{HEAD}/envFrom/0/secretRef/name", "music-rllib")(document)
    (problem,) = check_document(document, CLUSTER / RAY)
    assert "must be no Secret of the cluster's name" in problem
    document["spec"]["authOptions"]["secretName"] = "mine"
    assert check_document(document, CLUSTER / RAY) == []


def crds(folder: Path, **properties: Any) -> Path:
    """CRDs with only their top level."""
    for kind in ("rayclusters", "rayjobs"):
        schema = {"type": "object", "properties": properties}
        version = {"name": "v1", "schema": {"openAPIV3Schema": schema}}
        text = yaml.safe_dump({"spec": {"versions": [version]}})
        (folder / f"ray.io_{kind}.yaml").write_text(text)
    return folder


def test_files_are_held_against_kuberays_own_crds(tmp_path: Path) -> None:
    any_object = {"type": "object"}
    text = {"type": "string"}
    top = {"apiVersion": text, "kind": text, "metadata": any_object}
    folder = crds(tmp_path, **top, spec=any_object)
    assert check_file(CLUSTER / RAY, read_crds(folder)) == []
    assert check_file(CLUSTER / "serve.yaml", read_crds(folder)) == []
    (problem,) = check_file(CLUSTER / JOB, read_crds(crds(tmp_path, **top)))
    assert "'spec' was unexpected" in problem


def test_crds_apply_their_defaults_and_the_form_of_quantities(tmp_path: Path) -> None:
    cpu = {"x-kubernetes-int-or-string": True, "pattern": "^[0-9]+m?$"}
    spec = {
        "type": "object",
        "required": ["cpu", "minReplicas"],
        "properties": {"cpu": cpu, "minReplicas": {"type": "integer", "default": 0}},
    }
    schema = read_crds(crds(tmp_path, spec=spec))["RayCluster"]
    told = {
        value: Draft7Validator(schema).is_valid({"spec": {"cpu": value}})
        for value in (1, "500m", "8 GB", 0.5)
    }
    assert told == {1: True, "500m": True, "8 GB": False, 0.5: False}
    assert not Draft7Validator(schema).is_valid({"spec": {}})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "--crds must be a folder with ray.io_rayclusters.yaml and ray.io_rayjobs.yaml, got"),
        ("x: [", "is no CRD with a version v1"),
        ("{spec: {versions: [{name: v2}]}}", "is no CRD with a version v1"),
        ("3", "is no CRD with a version v1"),
    ],
)
def test_a_folder_without_crds_is_refused(
    text: str | None,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if text is not None:
        (tmp_path / "ray.io_rayclusters.yaml").write_text(text)
    monkeypatch.setattr(sys, "argv", ["check.py", "--crds", str(tmp_path), str(CLUSTER / RAY)])
    assert main() == 2
    output, errors = capsys.readouterr()
    assert output == ""
    assert errors.startswith("error: --crds ")
    assert message in errors


def test_the_command_prints_the_problems(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("services: {head: {image: 3}}")
    (tmp_path / "b.yaml").write_text("x: [")
    done = subprocess.run(
        [sys.executable, CLUSTER / "check.py", tmp_path / "a.yaml", tmp_path / "b.yaml"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (done.returncode, done.stderr) == (2, "")
    assert "services.head.image" in done.stdout
    assert "while parsing" in done.stdout


def test_every_file_with_a_schema_is_checked() -> None:
    """A new file must not remain unchecked."""
    found = {path.relative_to(CLUSTER).as_posix() for path in CLUSTER.rglob("*.y*ml")}
    assert found == set(ALL)
    # Each kind has a file, so that none is untested.
    kinds = {next(key for key in KINDS if key in load(name)) for name in ALL}
    assert kinds == set(KINDS)


# -- agreement with the rest of the project ---------------------------------------------------


def exact(package: str) -> str:
    found = re.search(rf"^{package}==(\S+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    assert found
    return found[1]


def test_versions_agree() -> None:
    assert load(RAY)["spec"]["rayVersion"] == exact("ray")
    assert load(JOB)["spec"]["rayClusterSpec"]["rayVersion"] == exact("ray")
    tags = set()
    for path in [CLUSTER / "compose.yaml", CLUSTER / RAY, CLUSTER / JOB, CLUSTER / "Dockerfile"]:
        tags |= set(re.findall(r"music-rllib(?:-mlflow)?:(\S+)", path.read_text()))
    assert tags == {music_rllib.__version__}


def test_sweeps_that_the_files_name_are_there() -> None:
    entrypoint = load(JOB)["spec"]["entrypoint"]
    (inside,) = re.findall(r"/opt/music_rllib/(\S+\.yaml)", entrypoint)
    assert load_config(ROOT / inside).stages
    sweep = load_config(CLUSTER / "sweep.yaml")
    assert sweep.storage == "/results"
    assert sweep.mlflow.tracking_uri == "http://mlflow:5000"


def test_image_has_the_files_that_it_copies_and_runs_without_root() -> None:
    text = (CLUSTER / "Dockerfile").read_text()
    allowed = [
        line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line[:1] == "!"
    ]
    for line in re.findall(r"^COPY (.*) \S+$", text, re.MULTILINE):
        for source in line.split():
            assert (ROOT / source).exists(), source
            assert source in allowed, f".dockerignore keeps {source} out"
    for stage in text.split("\nFROM ")[2:]:
        assert re.search(r"^USER 1000$", stage, re.MULTILINE), stage[:40]
    assert not re.search(r"(?im)^(ENV|ARG|RUN).*(password|secret|token|_key)", text)
    (base,) = re.findall(r"^FROM (\S+:\S+)", text, re.MULTILINE)
    assert re.search(r"\d", base.partition(":")[2]), "a moving tag"


def test_kustomize_puts_the_objects_together() -> None:
    kubectl = shutil.which("kubectl")
    for name in ("raycluster", "rayjob"):
        folder = CLUSTER / "kuberay" / name
        document = yaml.safe_load((folder / "kustomization.yaml").read_text())
        assert all((folder / resource).exists() for resource in document["resources"])
        if kubectl is None:
            continue
        done = subprocess.run(
            [kubectl, "kustomize", folder], capture_output=True, text=True, timeout=60, check=True
        )
        kinds = {entry["kind"] for entry in yaml.safe_load_all(done.stdout)}
        assert kinds == {"PersistentVolumeClaim", {"raycluster": "RayCluster"}.get(name, "RayJob")}


@pytest.mark.parametrize("options", [{"port": 8000}, None])
def test_a_service_without_a_host_listens_beyond_loopback(options: Any) -> None:
    document = load("serve.yaml")
    document["http_options"] = options or {}
    if options is None:
        del document["http_options"]
    document["applications"][0]["args"]["token_required"] = False
    (problem,) = check_document(document, CLUSTER / "serve.yaml")
    assert "token_required: must be true" in problem


PATCH = """
  - patch: |
      apiVersion: {version}
      kind: {kind}
      metadata: {{name: {name}}}
      spec: {spec}
"""
OF_CLUSTER = PATCH.replace("{version}", "ray.io/v1").replace("{kind}", "RayCluster")
OF_CLAIM = PATCH.replace("{version}", "v1").replace("{kind}", "PersistentVolumeClaim")
RESULTS = "music-rllib-results"
OPERATIONS = """
  - target: {kind: RayCluster}
    patch: |
      - {op: remove, path: /spec/x}
"""


@pytest.mark.parametrize(
    ("folder", "patch", "expected"),
    [
        (
            "raycluster",
            OF_CLUSTER.format(name="music-rllib", spec="{autoscalerOptions: {version: v2}}"),
            None,
        ),
        (
            "raycluster",
            OF_CLUSTER.format(name="music-rllib", spec="{autoscalerOption: {}}"),
            "autoscalerOption",
        ),
        ("raycluster-1.7", OF_CLAIM.format(name=RESULTS, spec="{accessModes: [X]}"), None),
        ("raycluster-1.7", OF_CLAIM.format(name=RESULTS, spec="{accessMode: x}"), "accessMode"),
        ("raycluster", OF_CLAIM.format(name="other", spec="{}"), "must be of an object"),
        ("raycluster", "\n  - {path: mine.yaml}\n", None),
        ("raycluster", OPERATIONS, None),
    ],
)
def test_patches_of_a_kustomization(
    folder: str, patch: str, expected: str | None, tmp_path: Path
) -> None:
    shutil.copytree(CLUSTER / "kuberay", tmp_path / "kuberay")
    file = tmp_path / "kuberay" / folder / "kustomization.yaml"
    text = file.read_text().rstrip("\n")
    file.write_text(text + ("" if "\npatches:" in text else "\npatches:") + patch)
    problems = check_file(file)
    assert len(problems) == (expected is not None)
    assert (expected or "") in "".join(problems)


def test_a_kustomization_inside_may_have_no_resources(tmp_path: Path) -> None:
    (tmp_path / "base").mkdir()
    head = "apiVersion: kustomize.config.k8s.io/v1beta1\nkind: Kustomization\n"
    (tmp_path / "base/kustomization.yaml").write_text(head + "configMapGenerator: [{name: c}]\n")
    (tmp_path / "kustomization.yaml").write_text(head + "resources: [base]\n")
    assert check_file(tmp_path / "kustomization.yaml") == []


def test_grafana_finds_its_dashboards_and_prometheus() -> None:
    """At the addresses in the files of `dashboards/`, with the names that compose gives."""
    services = load("compose.yaml")["services"]
    mounted = dict(volume.split(":")[:2][::-1] for volume in services["grafana"]["volumes"])
    inside = "/etc/grafana/provisioning"
    (provider,) = load_from(mounted[f"{inside}/dashboards"], "music_rllib.yml")["providers"]
    variable = provider["options"]["path"].strip("${}")
    folder = CLUSTER / mounted[services["grafana"]["environment"][variable]]
    boards = [json.loads(path.read_text()) for path in folder.glob("*.json")]
    assert boards
    (source,) = load("grafana-datasource.yml")["datasources"]
    assert source["url"] == "http://prometheus:9090"
    (local,) = load_from("../dashboards/grafana/provisioning/datasources", "prometheus.yml")[
        "datasources"
    ]
    assert source == local | {"url": source["url"]}
    (scraped,) = load("prometheus.yml")["scrape_configs"]
    (discovery,) = scraped["dns_sd_configs"]
    assert set(discovery["names"]) <= set(services)
    for name in discovery["names"]:
        assert f"--metrics-export-port={discovery['port']}" in services[name]["command"]


def test_the_unit_of_a_node_starts_ray_with_known_options(tmp_path: Path) -> None:
    text = (CLUSTER / "ray-node.service").read_text()
    (program, action, *_) = re.findall("^ExecStart=(.*)$", text, re.MULTILINE)[0].split()
    assert (Path(program).name, action) == ("ray", start.name)
    (path,) = re.findall("^Environment=PATH=(.*)$", text, re.MULTILINE)
    assert path.split(":")[0] == str(Path(program).parent), "jobs start python"
    known = {name for option in start.params for name in option.opts}
    assert {*re.findall(r"(--[a-z-]+)[= ']", text)} - {"--now"} <= known
    if (verifier := shutil.which("systemd-analyze")) is not None:
        unit = tmp_path / "ray-node.service"
        unit.write_text(text.replace(program, "/bin/true"))
        done = subprocess.run(
            [verifier, "verify", unit], capture_output=True, text=True, check=False
        )
        assert (done.returncode, done.stderr) == (0, "")


def test_prometheus_takes_its_configuration(require_service: Callable[[str], Path]) -> None:
    program = require_service("prometheus").with_name("promtool")
    done = subprocess.run(
        [program, "check", "config", CLUSTER / "prometheus.yml"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def load_from(folder: str, name: str) -> Any:
    return yaml.safe_load((CLUSTER / folder / name).read_text())


# -- secrets ----------------------------------------------------------------------------------


def test_compose_takes_every_secret_from_the_environment(tmp_path: Path) -> None:
    env = tmp_path / "env"
    subprocess.run(["sh", CLUSTER / "make_env.sh", env], check=True, capture_output=True)
    assert stat.S_IMODE(env.stat().st_mode) == 0o600
    written = dict(line.split("=", 1) for line in env.read_text().splitlines())
    text = (CLUSTER / "compose.yaml").read_text()
    # With ":?" compose stops if it is missing; ":-" gives a default, which a secret must not have.
    required = set(re.findall(r"\$\{(\w+):\?", text))
    assert required == set(written)
    for name in re.findall(r"\$\{(\w+):-", text):
        assert not re.search("PASSWORD|TOKEN|KEY", name)
    assert not re.findall(r"\$\{\w+\}|\$[A-Z]\w+", text), "a variable that may silently be empty"
    for line in re.findall(r"^.*(?:PASSWORD|TOKEN|SECRET_KEY)\w*: .*$", text, re.MULTILINE):
        assert ":?" in line, line
    secrets = [value for name, value in written.items() if "USERNAME" not in name]
    assert len(set(secrets)) == len(secrets)
    assert all(len(value) == 48 for value in secrets)
    again = subprocess.run(["sh", CLUSTER / "make_env.sh", env], capture_output=True, check=False)
    assert again.returncode == 1
    assert dict(line.split("=", 1) for line in env.read_text().splitlines()) == written


def test_secrets_file_is_ignored_by_git_and_by_images() -> None:
    assert "cluster/.env" in (ROOT / ".gitignore").read_text().splitlines()
    assert (ROOT / ".dockerignore").read_text().splitlines()[1] == "*"


def test_token_authentication_is_on_everywhere() -> None:
    services = load("compose.yaml")["services"]
    for name in ("head", "worker"):
        assert services[name]["environment"]["RAY_AUTH_MODE"] == "token"
    assert load(RAY)["spec"]["authOptions"] == {"mode": "token"}
    assert load(JOB)["spec"]["rayClusterSpec"]["authOptions"] == {"mode": "token"}


def test_your_secret_is_not_the_one_that_kuberay_keeps_its_token_in() -> None:
    """KubeRay uses an existing Secret with the cluster's name, which must have `auth_token`."""
    guide = (ROOT / "docs" / "operations.md").read_text()
    (made,) = re.findall(r"kubectl create secret generic (\S+)", guide)
    (read,) = re.findall(r"kubectl get secret (\S+)", guide)
    mounted = set()
    for name in (RAY, JOB):
        for place, text in strings(load(name)):
            if re.search(r"envFrom\.\d+\.secretRef\.name$", place):
                mounted.add(text)
    assert mounted == {made}
    assert read == load(RAY)["metadata"]["name"]
    # A RayJob's cluster has the job's name and five random letters.
    assert made != read
    assert not re.fullmatch(rf"{load(JOB)['metadata']['name']}-\w{{5}}", made)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"MLFLOW_ADMIN_PASSWORD": ""}, "MLFLOW_ADMIN_PASSWORD must be set"),
        ({"MLFLOW_ADMIN_PASSWORD": "short"}, "at least 12 characters"),
        ({"MLFLOW_ADMIN_PASSWORD": "with%percent-in-it"}, "must have no %"),
        ({"MLFLOW_FLASK_SERVER_SECRET_KEY": ""}, "must be set"),
    ],
)
def test_mlflow_does_not_start_without_its_secrets(change: dict[str, str], message: str) -> None:
    environment = {
        "PATH": os.environ["PATH"],
        "MLFLOW_BACKEND_STORE_URI": "sqlite:///x.db",
        "MLFLOW_AUTH_DATABASE_URI": "sqlite:///y.db",
        "MLFLOW_ADMIN_USERNAME": "music",
        "MLFLOW_ADMIN_PASSWORD": "correct-horse-battery",
        "MLFLOW_FLASK_SERVER_SECRET_KEY": "key",
    }
    done = subprocess.run(
        ["sh", CLUSTER / "mlflow-server.sh"],
        env=environment | change,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert message in done.stderr


def test_copies_are_independent() -> None:
    """The check must not change its argument, which `ray up` receives afterwards."""
    document = load("aws.yaml")
    before = copy.deepcopy(document)
    list(KINDS["provider"](document, CLUSTER / "aws.yaml"))
    assert document == before
