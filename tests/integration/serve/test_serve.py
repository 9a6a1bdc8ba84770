"""`music-rllib serve` as a user starts it: one service on loopback for all tests."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from ipaddress import ip_address
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import requests

from benchmarks.serve import half_sent, random_policy, storm
from music_rllib.policy import Policy, load_policy
from music_rllib.program import main
from music_rllib.runtime.machine import RAY_FOLDER, ray_parent
from tests.integration.conftest import listening
from tests.ports import free_port
from tests.unit.serve.test_api import serving

TOKEN = "a-planted-token"


class Service(NamedTuple):
    """A running service."""

    url: str
    policy: Policy
    process: subprocess.Popen[str]
    file: Path


def start(*arguments: str, token: str | None = None) -> subprocess.Popen[str]:
    environment = {**os.environ, **({"MUSIC_RLLIB_SERVE_TOKEN": token} if token else {})}
    return subprocess.Popen(
        [sys.executable, "-m", "music_rllib", "serve", *arguments],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    file = tmp_path_factory.mktemp("serve") / "policy.safetensors"
    file.write_bytes(random_policy(hidden=32))
    port = free_port()
    process = start(str(file), "--port", str(port), "--max-requests", "32", token=TOKEN)
    assert process.stdout is not None
    assert process.stderr is not None
    try:
        line = process.stdout.readline()
        assert line == f"Serving {file} at http://127.0.0.1:{port}\n", process.stderr.read()
        yield Service(f"http://127.0.0.1:{port}", load_policy(file), process, file)
    finally:
        process.terminate()
        output, errors = process.communicate(timeout=120)
    assert (process.returncode, errors) == (0, "")
    assert output.endswith("Stopped.\n")


def act(service: Service, body: Any, token: str = TOKEN) -> requests.Response:
    headers = {"Authorization": f"Bearer {token}"}
    return requests.post(f"{service.url}/act", json=body, headers=headers, timeout=120)


def test_actions_are_the_policys(service: Service) -> None:
    """Requests of one and of many rows at the same time, so that they are computed together."""
    rng = np.random.default_rng(1)

    def ask(rows: int) -> None:
        shape = (rows,) if rows else ()
        body = {
            "observation": rng.normal(size=(*shape, 25)).tolist(),
            "desired_goal": rng.normal(size=(*shape, 3)).tolist(),
        }
        answer = act(service, body)
        assert answer.status_code == 200, answer.text
        np.testing.assert_allclose(answer.json()["action"], service.policy.act(body), atol=1e-6)

    with ThreadPoolExecutor(16) as pool:
        list(pool.map(ask, [0, 1, 3, 64] * 25))


def test_a_request_that_is_refused_harms_no_other(service: Service) -> None:
    good = {"observation": [0.5] * 25, "desired_goal": [0.5] * 3}
    bad = [{"observation": [1.0] * 24, "desired_goal": [0.0] * 3}, "nonsense", None]

    with ThreadPoolExecutor(16) as pool:
        statuses = pool.map(lambda body: act(service, body).status_code, [good, *bad] * 10)
    assert list(statuses) == [200, 422, 422, 422] * 10


def test_the_token_is_needed_and_kept_out_of_sight(service: Service) -> None:
    assert act(service, {}, token="wrong").status_code == 401
    assert requests.get(f"{service.url}/policy", timeout=60).status_code == 401
    health = requests.get(f"{service.url}/health", timeout=60)
    assert health.json() == {"status": "ok", "task": "FetchPush"}
    # Files of Ray for this session: arguments of deployments, environments, logs.
    folder = ray_parent()
    # An older one may have had the same process id.
    session = max(folder.glob(f"{RAY_FOLDER}*/r/session_*_{service.process.pid}"))
    notes = [path for path in session.rglob("*") if path.is_file()]
    assert len(notes) > 10
    for path in notes:
        assert TOKEN.encode() not in path.read_bytes(), path


def test_a_storm_is_answered_or_asked_to_come_again(service: Service) -> None:
    """Stalled requests occupy a place only for seconds; Serve's own health check answers."""
    with half_sent(service.url, 60) as clients:
        seen = asyncio.run(storm(service.url, service.policy, 600, TOKEN))
        for client in clients:
            client.settimeout(60)
            # 503 if too many others waited when it arrived.
            assert client.recv(65536).startswith((b"HTTP/1.1 408 ", b"HTTP/1.1 503 "))
    # 408 if this machine takes longer than 10 s; the seconds of others tell where they come from.
    assert [answer for answer in seen.answers if answer[0] not in (200, 408, 503)] == []
    assert len(seen.answers) == 600
    assert seen.count(200) >= 32
    assert (seen.count(503) > 0, seen.without_retry) == (True, 0)
    assert {status for status, _ in seen.healths} == {200}


def test_nothing_of_it_listens_beyond_loopback(service: Service) -> None:
    """Neither the service nor Ray with its `/metrics` listens beyond loopback."""
    places = listening(service.process)
    assert "raylet" in set.union(*places.values())
    assert all(ip_address(place.removeprefix("::ffff:")).is_loopback for place in places), places


def fuzz(url: str, token: str, folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """schemathesis as a user starts it, on the whole OpenAPI document.

    Without the check that every valid request is accepted: JSON Schema cannot express that the
    parts of a batch must have the same number of rows.
    """
    command = [
        *(str(Path(sys.executable).with_name("schemathesis")), "run", f"{url}/openapi.json"),
        *("--header", f"Authorization: Bearer {token}"),
        *("--checks", "all", "--exclude-checks", "positive_data_acceptance"),
        # On a busy machine it would consider its own generation of data too slow.
        *("--seed", "1", "--no-color", "--suppress-health-check", "too_slow"),
        *("--generation-database", "none", *options),
    ]
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=250, check=False
    )


def test_fuzzing_the_application_finds_no_server_error(tmp_path: Path) -> None:
    with serving(token=TOKEN) as url:
        done = fuzz(url, TOKEN, tmp_path, "--max-examples", "10")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "No issues found" in done.stdout


def test_fuzzing_the_service_finds_no_server_error(service: Service, tmp_path: Path) -> None:
    """Without the phase `coverage`, which the application has passed: this tests Serve's part."""
    options = ("--phases", "examples,fuzzing", "--max-examples", "5")
    done = fuzz(service.url, TOKEN, tmp_path, *options)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{policy}", "--host", "0.0.0.0"], "must be a loopback address unless"),
        (["{policy}", "--port", "{taken}"], "must name a free port"),
        (["{policy}", "--replicas", "5000"], "--replicas must be <= "),
        (["{folder}"], "must hold a policy"),
        (["no-such-run", "--storage", "{folder}"], "no run is finished there"),
    ],
)
def test_bad_input_is_one_line(
    service: Service,
    arguments: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    taken = service.url.rpartition(":")[2]
    places = {"policy": service.file, "folder": tmp_path, "taken": taken}
    if "--port" not in arguments:
        arguments = [*arguments, "--port", str(free_port())]
    code = main(["serve", *(argument.format(**places) for argument in arguments)])
    output, errors = capsys.readouterr()
    assert (code, output) == (2, "")
    assert message in errors
    assert errors.startswith("error: ")
    assert errors.count("\n") == 1
