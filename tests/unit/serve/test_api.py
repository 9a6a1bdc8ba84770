"""The served policy's web application, over loopback: answers and refusals."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
import requests
import uvicorn
from pydantic import TypeAdapter, ValidationError

from music_rllib.serve.api import (
    Array,
    PolicyFacts,
    Rows,
    compute,
    make_api,
    request_type,
    token_hash,
)

OBSERVATION, GOAL = 4, 2


class Sums:
    """Actions that can be computed by hand: sums of the observation and of the goal."""

    observation_size, goal_size, action_size = OBSERVATION, GOAL, 2

    def act(self, observation: Any) -> Array:
        return np.stack([observation[name].sum(1) for name in ("observation", "desired_goal")], 1)


@contextmanager
def serving(token: str | None = None) -> Iterator[str]:
    """The application on a free port; gives its URL."""
    policy: Any = Sums()

    async def act(rows: Rows) -> Array:
        return compute(policy, [rows])[0]

    api = make_api(PolicyFacts.of("Point", policy), act, token_hash(token) if token else None)
    server = uvicorn.Server(uvicorn.Config(api, log_level="critical", ws="none"))
    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        while not server.started:
            time.sleep(0.01)
        try:
            yield f"http://127.0.0.1:{listening.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join()


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    with serving() as url:
        yield url


@pytest.fixture
def post(url: str) -> Callable[..., tuple[int, Any]]:
    def send(body: Any) -> tuple[int, Any]:
        text = body if isinstance(body, bytes) else json.dumps(body)
        answer = requests.post(
            f"{url}/act", data=text, headers={"Content-Type": "application/json"}, timeout=60
        )
        return answer.status_code, answer.json()

    return send


Post = Callable[..., tuple[int, Any]]


def test_one_observation(post: Post) -> None:
    body = {"observation": [1, 2, 3, 4.5], "desired_goal": [0.25, 0.5]}
    assert post(body) == (200, {"action": [10.5, 0.75]})
    assert post(body | {"achieved_goal": [9, 9]}) == (200, {"action": [10.5, 0.75]})


@pytest.mark.parametrize(
    "headers", [{}, {"Content-Type": "text/plain"}, {"Content-Type": "application/octet-stream"}]
)
def test_json_is_accepted_with_any_content_type(url: str, headers: dict[str, str]) -> None:
    for body, status in ((json.dumps(GOOD), 200), ("observation=1", 400), ("", 422)):
        answer = requests.post(f"{url}/act", body, headers=headers, timeout=60)
        assert answer.status_code == status, answer.text


def test_head_is_answered_as_get_without_a_body(url: str) -> None:
    for page in ("health", "policy", "openapi.json"):
        head, get = (
            requests.head(f"{url}/{page}", timeout=60),
            requests.get(f"{url}/{page}", timeout=60),
        )
        assert (head.status_code, head.content) == (200, b"")
        assert head.headers["Content-Length"] == get.headers["Content-Length"]
    assert requests.head(f"{url}/act", timeout=60).status_code == 405


def test_a_batch_has_one_action_a_row(post: Post) -> None:
    body = {"observation": [[1, 1, 1, 1], [2, 2, 2, 2]], "desired_goal": [[0, 1], [2, 3]]}
    assert post(body) == (200, {"action": [[4.0, 1.0], [8.0, 5.0]]})


def test_a_batch_of_one_stays_a_batch(post: Post) -> None:
    body = {"observation": [[1, 1, 1, 1]], "desired_goal": [[0, 1]]}
    assert post(body) == (200, {"action": [[4.0, 1.0]]})


GOOD = {"observation": [0, 0, 0, 0], "desired_goal": [0, 0]}


@pytest.mark.parametrize(
    ("change", "place", "rule"),
    [
        ({"observation": [0, 0, 0]}, "observation", "at least 4 items"),
        ({"observation": [0] * 5}, "observation", "at most 4 items"),
        ({"observation": []}, "observation", "at least 4 items"),
        ({"observation": None}, "observation", "valid list"),
        ({"observation": {"0": 1}}, "observation", "valid list"),
        ({"observation": [0, 0, 0, "1"]}, "observation.3", "valid number"),
        ({"observation": [0, 0, 0, True]}, "observation.3", "valid number"),
        ({"observation": [0, 0, 0, None]}, "observation.3", "valid number"),
        ({"observation": [0, 0, 0, float("nan")]}, "observation.3", "finite number"),
        ({"observation": [0, 0, 0, float("-inf")]}, "observation.3", "finite number"),
        ({"observation": [0, 0, 0, 1e300]}, "observation.3", "less than or equal to"),
        ({"observation": [0, 0, 0, 10**4000]}, "observation.3", "valid number"),
        ({"desired_goal": [[0, 0]]}, "desired_goal.0", "valid number"),
        ({"goal": [0, 0]}, "goal", "not permitted"),
        ({"observation": [[0] * 4] * 2, "desired_goal": [[0] * 2]}, "", "as many rows as"),
        ({"observation": [[0] * 4] * 1025}, "observation", "at most 1024 items"),
        ({"observation": [[0] * 4, 0], "desired_goal": [[0] * 2] * 2}, "observation.1", "list"),
    ],
)
def test_what_is_no_observation_is_refused_with_its_place(
    post: Post, change: dict[str, Any], place: str, rule: str
) -> None:
    status, body = post(GOOD | change)
    assert status == 422
    assert body["problems"][0]["place"] == place
    assert rule in body["problems"][0]["rule"]


def test_a_missing_goal_is_named(post: Post) -> None:
    status, body = post({"observation": [0, 0, 0, 0]})
    assert (status, body["problems"]) == (
        422,
        [{"place": "desired_goal", "rule": "Field required"}],
    )


@pytest.mark.parametrize("body", [[], [1], None, 3, "text", True])
def test_json_that_is_no_object(post: Post, body: Any) -> None:
    assert post(body)[0] == 422


@pytest.mark.parametrize(
    "body", [b"", b"{", b"\xff\xfe", b"[" * 50_000, b'{"observation": [' + b"9" * 5000 + b"]}"]
)
def test_what_is_no_json(post: Post, body: bytes) -> None:
    status, answer = post(body)
    assert status in (400, 413, 422)
    assert answer["error"]


def test_many_problems_are_cut_short(post: Post) -> None:
    rows = [["x"] * OBSERVATION] * 500
    status, body = post({"observation": rows, "desired_goal": [[0, 0]] * 500})
    assert (status, len(body["problems"])) == (422, 10)
    assert "the first 10 of 2000 problems" in body["error"]


def test_a_body_longer_than_any_valid_one(url: str) -> None:
    def endless() -> Iterator[bytes]:  # chunked, so that no header contains the length
        for _ in range(100):
            yield b"[" * 10_000

    for data in (b"[" * 1_000_000, endless()):
        answer = requests.post(f"{url}/act", data=data, timeout=60)
        assert answer.status_code == 413
        assert "must be <=" in answer.json()["error"]


def test_no_action_is_better_than_nan(post: Post) -> None:
    """Each number is a float32, but their sum is not."""
    status, body = post(GOOD | {"observation": [3.4e38] * 4})
    assert status == 422
    assert "no finite action" in body["error"]


def test_facts_health_and_openapi(url: str) -> None:
    assert requests.get(f"{url}/health", timeout=60).json() == {"status": "ok", "task": "Point"}
    facts = requests.get(f"{url}/policy", timeout=60).json()
    assert (facts["observation_size"], facts["goal_size"], facts["action_size"]) == (4, 2, 2)
    schema = requests.get(f"{url}/openapi.json", timeout=60).json()
    observation = schema["components"]["schemas"]["Observation"]["properties"]["observation"]
    assert observation["minItems"] == observation["maxItems"] == OBSERVATION
    example = schema["paths"]["/act"]["post"]["requestBody"]["content"]["application/json"]
    body = example["examples"]["zeros"]["value"]
    assert requests.post(f"{url}/act", json=body, timeout=60).status_code == 200
    assert requests.get(f"{url}/act", timeout=60).status_code == 405
    assert requests.get(f"{url}/nowhere", timeout=60).json()["error"] == "Not Found"


def test_without_a_token_only_requests_to_this_machine_are_answered(url: str) -> None:
    """A page that resolves its own name to this machine must not read the policy."""
    for host in ("localhost", "127.0.0.1:80", "[::1]:8000"):
        assert requests.get(f"{url}/policy", headers={"Host": host}, timeout=60).ok
    for host in ("evil.example", "127.0.0.1.evil.example:8000", "10.0.0.1", ""):
        answer = requests.post(f"{url}/act", json=GOOD, headers={"Host": host}, timeout=60)
        assert answer.status_code == 403
        assert "Host header" in answer.json()["error"]


def test_a_token_is_required_if_there_is_one() -> None:
    with serving(token="hunter2") as url:
        elsewhere = {"Host": "policy.example", "Authorization": "Bearer hunter2"}
        assert requests.get(f"{url}/policy", headers=elsewhere, timeout=60).ok

        def status(headers: dict[str, str], path: str = "/act") -> int:
            return requests.post(f"{url}{path}", json=GOOD, headers=headers, timeout=60).status_code

        assert status({}) == 401
        assert status({"Authorization": "Bearer hunter3"}) == 401
        assert status({"Authorization": "Basic hunter2"}) == 401
        assert status({"Authorization": "Bearer hunter2"}) == 200
        assert requests.get(f"{url}/policy", timeout=60).status_code == 401
        assert requests.get(f"{url}/health", timeout=60).status_code == 200
        assert "hunter2" not in requests.get(f"{url}/openapi.json", timeout=60).text


@pytest.mark.parametrize("body", [b"{nope", b"", b"\xff\xfe", b"[" * 100_000])
def test_a_body_is_not_judged_without_the_token(body: bytes) -> None:
    with serving(token="secret") as url:
        for headers in ({}, {"Authorization": "Bearer other"}, {"Authorization": "Basic secret"}):
            answer = requests.post(f"{url}/act", body, headers=headers, timeout=60)
            assert (answer.status_code, answer.headers["WWW-Authenticate"]) == (401, "Bearer")
        known = {"Authorization": "bearer secret"}
        answer = requests.post(f"{url}/act", body, headers=known, timeout=60)
        assert answer.status_code in (400, 413, 422)


def test_a_client_without_the_token_is_answered_at_the_end_of_its_body() -> None:
    """Before, Serve's limits of time and of waiting requests apply to it."""
    with serving(token="secret") as url:
        host, port = url.removeprefix("http://").split(":")
        with socket.create_connection((host, int(port))) as client:
            client.sendall(b"POST /act HTTP/1.1\r\nHost: x\r\nContent-Length: 2\r\n\r\n{")
            client.settimeout(0.3)
            with pytest.raises(TimeoutError):
                client.recv(1)
            client.settimeout(60)
            client.sendall(b"{")
            assert client.recv(65536).startswith(b"HTTP/1.1 401 ")


def test_a_task_without_goals() -> None:
    facts = PolicyFacts(task="Pendulum", observation_size=3, goal_size=0, action_size=1)
    body = TypeAdapter(request_type(facts))
    assert body.validate_python({"observation": [1.0, 2.0, 3.0]}).rows()["observation"].shape == (
        1,
        3,
    )
    with pytest.raises(ValidationError, match="Extra inputs"):
        body.validate_python({"observation": [1.0, 2.0, 3.0], "desired_goal": []})
