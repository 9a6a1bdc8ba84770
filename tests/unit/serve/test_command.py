"""`music-rllib serve` rejects bad input before it starts Ray."""

from __future__ import annotations

from pathlib import Path

import pytest

from music_rllib.program import main
from tests.ports import free_port


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Message for arguments that end with code 2."""
    code = main(["serve", *arguments])
    output, errors = capsys.readouterr()
    assert (code, output) == (2, "")
    return errors


@pytest.mark.parametrize(
    ("option", "value"),
    [("port", "abc"), ("port", "8e3"), ("port", "0"), ("replicas", "1.5"), ("replicas", "0")],
)
def test_numbers_are_refused_by_the_option_they_are_of(
    option: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    errors = refused(capsys, "x", f"--{option}", value)
    assert f"Invalid value for '--{option}'" in errors.splitlines()[-1]


def test_a_storage_without_meaning_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    errors = refused(capsys, "xx", "--storage", "ftp://x", "--port", str(free_port()))
    assert errors.startswith("error: storage must be a folder or an s3:// or gs:// URI")
    assert errors.count("\n") == 1


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("127.0.0.1:1", "must be HOST:PORT of a Ray cluster that answers, got '127.0.0.1:1'"),
        ("127.0.0.1:99999", "must be HOST:PORT of a Ray cluster that answers"),
        ("http://127.0.0.1:8265", "an http address is for 'ray job submit'"),
    ],
)
def test_a_cluster_that_does_not_answer_is_reported_at_once(
    address: str, message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", address)
    errors = refused(capsys, "xx", "--storage", str(Path.cwd()))
    assert errors.startswith("error: RAY_ADDRESS ")
    assert message in errors
    assert errors.count("\n") == 1
