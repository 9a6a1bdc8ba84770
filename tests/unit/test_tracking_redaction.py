"""What may be written down: flat params, no secrets."""

from __future__ import annotations

import pytest

from music_rllib.tracking.redaction import MAX_PARAM_LENGTH, flat_params, redact, without_secrets


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("http://host:5000/x", "http://host:5000/x"),
        ("https://user:pa%40ss@host:5000", "https://host:5000"),
        ("postgresql+psycopg2://u:p@ss@db/x", "postgresql+psycopg2://db/x"),
        (
            "postgresql://db/x?user=u&password=hunter2&a=1",
            "postgresql://db/x?user=u&password=***&a=1",
        ),
        ("cannot reach 'http://u:p@h:1/a' now", "cannot reach 'http://h:1/a' now"),
        ("someone@example.org wrote http://h/a@b", "someone@example.org wrote http://h/a@b"),
        ("sqlite:////home/me/mlflow.db", "sqlite:////home/me/mlflow.db"),
    ],
)
def test_uris_lose_their_passwords_and_nothing_else(text: str, expected: str) -> None:
    assert redact(text) == expected


def test_secrets_are_left_out_at_every_depth() -> None:
    settings = {
        "mlflow": {"tracking_uri": "http://u:hunter2@h", "password": "hunter2"},
        "environments": [{"env_kwargs": {"api_key": "hunter2", "url": "s3://k:hunter2@b"}}],
        "tac": {"alpha": 0.2},
    }
    clean = without_secrets(settings)
    assert "hunter2" not in str(clean)
    assert clean["tac"] == {"alpha": 0.2}
    assert clean["environments"] == [{"env_kwargs": {"url": "s3://b"}}]
    assert "password" in settings["mlflow"]


def test_params_are_flat_text() -> None:
    params = flat_params(
        {
            "seed": 3,
            "tac": {"entropic_index": 1.5, "hidden_sizes": (256, 256), "learned": False},
            "hindsight_k": None,
            "environments": {"My=Env": {"horizon": 50}},
            "stages": [{"name": "pretrain"}],
        }
    )
    assert params == {
        "seed": "3",
        "tac.entropic_index": "1.5",
        "tac.hidden_sizes": "[256, 256]",
        "tac.learned": "False",
        "hindsight_k": "None",
        "environments.My_Env.horizon": "50",
    }


def test_params_that_mlflow_would_refuse_for_their_length_are_left_out() -> None:
    params = flat_params({"fits": "x" * MAX_PARAM_LENGTH, "long": "x" * (MAX_PARAM_LENGTH + 1)})
    assert list(params) == ["fits"]
