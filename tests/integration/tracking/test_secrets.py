"""Planted secrets: an MLflow server with a password, and a look into all that is written."""

from __future__ import annotations

import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import requests

from music_rllib.program import main
from tests.integration.conftest import ENVIRONMENTS, call
from tests.integration.mlflow_server import USER, server_script

ROOT = Path(__file__).parents[3]
PASSWORD = "planted-mlflow-password"
PLANTED = {
    "MLFLOW_TRACKING_USERNAME": USER,
    "MLFLOW_TRACKING_PASSWORD": PASSWORD,
    "AWS_SECRET_ACCESS_KEY": "planted-aws-key",
    "MUSIC_RLLIB_SERVE_TOKEN": "planted-serve-token",
    "RAY_AUTH_TOKEN": "planted-ray-token-" + "0" * 32,
    "RAY_AUTH_MODE": "token",
}
SECRETS = [value for name, value in PLANTED.items() if "planted" in value]


@pytest.fixture
def mlflow_server(tmp_path: Path) -> Iterator[str]:
    """`cluster/mlflow-server.sh` on loopback, with sqlite; its URI."""
    with server_script(tmp_path / "server", PASSWORD) as uri:
        yield uri


def holders(folder: Path, secrets: list[str]) -> list[tuple[str, str]]:
    """Files below `folder` with one of the secrets in them."""
    return [
        (path.relative_to(folder).as_posix(), secret)
        for path in folder.rglob("*")
        if path.is_file()
        for secret in secrets
        if secret.encode() in path.read_bytes()
    ]


def test_secrets_are_used_and_written_nowhere(
    sweep_program: Any,
    sweep_document: dict[str, Any],
    mlflow_server: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    document = sweep_document
    document["stages"] = document["stages"][:1]
    document["defaults"]["env_steps"] = 600
    document["mlflow"] = {"tracking_uri": mlflow_server}
    sweep_program.write(document)

    monkeypatch.syspath_prepend(ENVIRONMENTS)
    code, _, errors = call(main, tmp_path, "run", "sweep.yaml")
    assert code == 2, "without a password nothing must start"
    assert "401" in errors
    assert "Set MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD" in errors

    sweep_program.environment |= PLANTED
    code, output, errors = sweep_program.run()
    assert (code, errors) == (0, ""), output
    auth = (USER, PASSWORD)
    found = requests.post(
        f"{mlflow_server}/api/2.0/mlflow/runs/search",
        json={"experiment_ids": ["1"], "max_results": 50},
        auth=auth,
        timeout=60,
    ).json()
    assert len(found["runs"]) == 2, "the sweep's run and the node's"
    assert not [secret for secret in SECRETS if secret in output]
    # The storage, the server's database, artifacts and log, and what a second reader is shown.
    (settings,) = tmp_path.rglob("basic_auth.ini")  # the one place where MLflow takes it from
    assert stat.S_IMODE(settings.stat().st_mode) == 0o600
    found_in = holders(tmp_path, [*SECRETS, "planted-flask-key"])
    assert found_in == [(settings.relative_to(tmp_path).as_posix(), PASSWORD)]
    assert not [secret for secret in SECRETS if secret in str(found)]


def test_a_password_in_the_tracking_uri_is_not_kept(
    sweep_program: Any, sweep_document: dict[str, Any], tmp_path: Path
) -> None:
    """It should be in the environment; where it is not, the copy of the file leaves it out."""
    from music_rllib.config.load import load_config
    from music_rllib.experiment.open_sweep import open_sweep
    from music_rllib.experiment.plan import make_plan
    from music_rllib.experiment.record import keep_record

    document = sweep_document
    document["mlflow"] = {"tracking_uri": "http://music:planted-in-a-uri@localhost:1"}
    del document["environments"], document["resources"]
    document["tasks"] = ["FetchPush"]
    sweep_program.write(document)
    config = load_config(tmp_path / "sweep.yaml")
    storage = tmp_path / "kept"
    opened = open_sweep(config, make_plan(config), str(storage))
    keep_record(opened)
    assert holders(storage, ["planted-in-a-uri"]) == []
    assert "http://localhost:1" in (storage / config.name / "config.json").read_text()
