"""Known messages are hidden, and all others are shown."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Iterator

import pytest

from music_rllib.runtime import quiet
from tests.processes import fresh

NOTICE = "You are running PPO on the new API stack! This is the new default behavior"
LOGGER = "ray.rllib.algorithms.algorithm_config"


@pytest.fixture
def seen(caplog: pytest.LogCaptureFixture) -> Iterator[pytest.LogCaptureFixture]:
    """Records that pass the logger, from which Ray does not propagate to the root logger."""
    logger = logging.getLogger(LOGGER)
    logger.addHandler(caplog.handler)
    quiet.quiet_third_parties()
    yield caplog
    logger.removeHandler(caplog.handler)


def test_an_expected_message_is_hidden_and_others_are_shown(
    seen: pytest.LogCaptureFixture,
) -> None:
    logger = logging.getLogger(LOGGER)
    logger.warning(NOTICE)
    logger.warning("Your batch size %d is no multiple of the minibatch's", 7)
    logger.error(NOTICE)
    said = {(record.levelname, record.getMessage()) for record in seen.records}
    assert said == {
        ("WARNING", "Your batch size 7 is no multiple of the minibatch's"),
        ("ERROR", NOTICE),
    }


def test_only_the_warning_about_rllibs_own_environment_is_hidden() -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        quiet.quiet_third_parties()
        for name in ("rllib-single-agent-env-v0", "FetchPush-v4"):
            # The color codes are gymnasium's.
            warnings.warn(
                f"\x1b[33mWARN: Overriding environment {name} already in registry.\x1b[0m",
                stacklevel=1,
            )
    assert [("FetchPush" in str(warning.message)) for warning in caught] == [True]


def test_importing_the_robotics_environments_prints_nothing() -> None:
    code = (
        "from music_rllib.envs.tasks import register_robotics\n"
        "register_robotics()\n"
        "import gymnasium\n"
        "gymnasium.make('FetchPush-v4').close()\n"
    )
    done = fresh("-c", code)
    assert (done.stdout, done.stderr) == ("", "")


# --- the environment -----------------------------------------------------------------------


LOOPBACK_ONLY = quiet.LOCAL_RAY_BEYOND_LOOPBACK


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Remove all variables of Ray and MLflow from the environment."""
    for name in list(os.environ):
        if name.startswith(("RAY_", "MLFLOW_")):
            monkeypatch.delenv(name)
    monkeypatch.setenv(LOOPBACK_ONLY, "")  # so that it is removed after the test
    monkeypatch.delenv(LOOPBACK_ONLY)
    return monkeypatch


def test_each_local_ray_gets_a_new_token(bare: pytest.MonkeyPatch) -> None:
    tokens = set()
    for _ in range(2):
        bare.delenv("RAY_AUTH_MODE", raising=False)
        bare.delenv("RAY_AUTH_TOKEN", raising=False)
        quiet.prepare_environment()
        assert os.environ["RAY_AUTH_MODE"] == "token"
        tokens.add(os.environ["RAY_AUTH_TOKEN"])
    assert len(tokens) == 2
    assert all(len(token) == 64 for token in tokens)


@pytest.mark.parametrize(
    "chosen",
    [{"RAY_ADDRESS": "head:6379"}, {"RAY_AUTH_MODE": "disabled"}],
)
def test_the_users_cluster_or_authentication_is_unchanged(
    bare: pytest.MonkeyPatch, chosen: dict[str, str]
) -> None:
    for name, value in chosen.items():
        bare.setenv(name, value)
    quiet.prepare_environment()
    assert "RAY_AUTH_TOKEN" not in os.environ
    assert os.environ.get("RAY_AUTH_MODE") == chosen.get("RAY_AUTH_MODE")


def test_variables_of_the_user_are_kept(bare: pytest.MonkeyPatch) -> None:
    bare.setenv("RAY_USAGE_STATS_ENABLED", "1")
    bare.setenv("RAY_AUTH_TOKEN", "mine")
    quiet.prepare_environment()
    assert os.environ["RAY_USAGE_STATS_ENABLED"] == "1"
    assert os.environ["RAY_AUTH_TOKEN"] == "mine"


@pytest.mark.parametrize(
    ("chosen", "expected"),
    [
        ({}, "0"),
        ({LOOPBACK_ONLY: "1"}, "1"),
        ({"RAY_ADDRESS": "head:6379"}, None),
        ({"RAY_ADDRESS": ""}, "0"),
        ({"RAY_ADDRESS": "local"}, "0"),
    ],
)
def test_a_local_ray_stays_on_loopback_unless_asked(
    bare: pytest.MonkeyPatch, chosen: dict[str, str], expected: str | None
) -> None:
    for name, value in chosen.items():
        bare.setenv(name, value)
    quiet.prepare_environment()
    assert os.environ.get(LOOPBACK_ONLY) == expected
