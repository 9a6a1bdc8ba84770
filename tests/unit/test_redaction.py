"""Redaction of secrets, params of MLflow, and control characters on the terminal."""

from __future__ import annotations

import re
import sys
import time
import unicodedata
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.table import Table
from rich.text import Text

from music_rllib.command_line import console_for, how_to_continue
from music_rllib.program import main as sweep_main
from music_rllib.redaction import (
    MAX_PARAM_LENGTH,
    flat_params,
    printable,
    redact,
    without_secrets,
)
from tests.kept_sweep import kept_sweep


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
        ("connect(host='h', password='p w', a=1)", "connect(host='h', password=***, a=1)"),
        ("no login with password=hunter2, user=me", "no login with password=***, user=me"),
        ("DB_PASSWORD: hunter2", 'DB_PASSWORD: "***"'),
        ("{'api_key': 'k', \"token\": \"t\"}", "{'api_key': '***', \"token\": \"***\"}"),
        ("PGPASSWORD=hunter2 psql", "PGPASSWORD=*** psql"),
        ("Authorization: Bearer abc.def-g", 'Authorization: "***"'),
        ("sent Bearer abc.def-g", "sent Bearer ***"),
        ("the password must be given", "the password must be given"),
        ("5 tokens = 3 words", "5 tokens = *** words"),
        ("postgresql://me:pa/ss?#'@host/db", "postgresql://host/db"),
        ("s3://AKIA:ab/cd@bucket/x", "s3://bucket/x"),
        ("http://h:5000/a@b and http://h:80?c=d@e", "http://h:5000/a@b and http://h:80?c=d@e"),
        (r'{"password": "ab\"cd", "a": 1}', '{"password": "***", "a": 1}'),
        ("authorization: Basic dTpw", 'authorization: "***"'),
        ("X-Api-Key: abc", 'X-Api-Key: "***"'),
        ("curl -u me:p:w https://h", "curl -u me:*** https://h"),
        (
            "run -u 1000:1000 -u x: y --user http://h:1",
            "run -u 1000:1000 -u x: y --user http://h:1",
        ),
        ("['curl', '--user', 'me:pw', 'h']", "['curl', '--user', 'me:***', 'h']"),
        ("curl -sume:pw h -U you:p2", "curl -sume:*** h -U you:***"),
        ("curl h \\\n  -u me:pw\nsort -u a:b", "curl h \\\n  -u me:***\nsort -u a:b"),
        ("python -u train.py:12 | sort -u a:b", "python -u train.py:12 | sort -u a:b"),
        ("python -u x.py --user me:pw", "python -u x.py --user me:***"),
        ("python x --user-data d -u a:12", "python x --user-data d -u a:12"),
        ("mysqldump -P 3306 -uroot -ppw -p db", "mysqldump -P 3306 -uroot -p*** -p db"),
        ("mysql -P3306 -p db --port=1", "mysql -P3306 -p db --port=1"),
        ("['mysql', '-p', 'db']", "['mysql', '-p', 'db']"),
        ("sshpass -v -ppw ssh -p 22 h", "sshpass -v -p*** ssh -p 22 h"),
        ("sshpass -e ssh -p 22 h", "sshpass -e ssh -p 22 h"),
        (
            "https://hooks.slack.com/services/T0/B0/xyz failed",
            "https://hooks.slack.com/services/*** failed",
        ),
        (
            "'https://discord.com/api/v10/webhooks/1/x-y_z'",
            "'https://discord.com/api/v10/webhooks/***'",
        ),
        ("secret:\n  a: |\n    b\n", "secret:\n  a: |\n    b\n"),
        ("pw: |\n    a b\n    c: d\n  e: 1", "pw: ***\n  e: 1"),
    ],
)
def test_only_passwords_are_removed_from_text(text: str, expected: str) -> None:
    assert redact(text) == expected


def test_secrets_are_omitted_at_every_depth() -> None:
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


def test_names_and_counts_of_tokens_are_kept() -> None:
    """Without them, a sweep that resumes from its storage would be a different one."""
    settings = {
        "tasks": ["TokenRing"],
        "environments": {"TokenRing": {"env_kwargs": {"n_tokens": 4, "token": "hunter2"}}},
        "stages": [{"per_task": {"TokenRing": {"env_steps": 300, "passwords": {"a": "hunter2"}}}}],
        "pin": {"password": 12345},
    }
    assert without_secrets(settings) == {
        "tasks": ["TokenRing"],
        "environments": {"TokenRing": {"env_kwargs": {"n_tokens": 4}}},
        "stages": [{"per_task": {"TokenRing": {"env_steps": 300}}}],
        "pin": {},
    }


def test_names_of_environments_and_rewards_are_kept() -> None:
    """`resume` reads them; the value of another setting may be a password."""
    kept = {
        "environments": {"T": {"env_id": "token_world:TokenWorld-v0"}},
        "stages": [{"grid": {"intrinsic.reward": ["cookie_rewards:Count", "rnd"]}}],
        "task": {"env_id": "secretary:Office-v0"},
        "intrinsic": {"reward": "token_rewards:Mine"},
    }
    assert without_secrets(kept) == kept
    task = {
        "env_id": "token_world:T-v0 password: hunter2",
        "env_kwargs": {"reward": "password:hunter2", "environments": [{"password": "hunter2"}]},
    }
    token = "ghp_" + 36 * "a"
    hidden = {"environments": {"T": task}, "note": "token:hunter2", "reward": "token:hunter2"}
    hidden |= {"intrinsic": {"reward": f"{token}:x"}}
    assert "hunter2" not in str(without_secrets(hidden))
    assert token not in str(without_secrets(hidden))


def test_params_are_flat_text() -> None:
    params = flat_params(
        {
            "seed": 3,
            "tac": {"entropic_index": 1.5, "hidden_sizes": (256, 256), "learned": False},
            "hindsight_k": None,
            "environments": {"My=Env": {"horizon": 50}},
            "stages": [{"name": "pretrain"}],
            "alpha": {"points": [[0, 0.1], [500, 0.2]]},
        }
    )
    assert params == {
        "alpha.points": "[[0, 0.1], [500, 0.2]]",
        "seed": "3",
        "tac.entropic_index": "1.5",
        "tac.hidden_sizes": "[256, 256]",
        "tac.learned": "False",
        "hindsight_k": "None",
        "environments.My_Env.horizon": "50",
    }


def test_params_longer_than_mlflows_limit_are_omitted() -> None:
    params = flat_params({"fits": "x" * MAX_PARAM_LENGTH, "long": "x" * (MAX_PARAM_LENGTH + 1)})
    assert list(params) == ["fits"]


SECRETS = st.text("abcXYZ019+/.-_~%$!", min_size=6).map(lambda text: f"Q9{text}z")
PLACES = (
    *("credentials=('u', '§')", "credentials=(('u', '§'), ('v', '§'))", "token: {'user': '§'}"),
    *("password='''§'''", 'password = """a\n§\n"""', "password=b'§'", '{"pass": "§"}'),
    *("password:\n  §", "password = \\\n  '§'", "'api_key':\n '§'", "secret: [§, '§']"),
    *("DB_PASS=§", "DB_PASS: §", "pw=§", "pwd = §", "api-key: §", "token=§,", "my_token: '§'"),
    *("run --password § --n 3", "run --db-pass §", "run -token '§'", "run --password=§"),
    *("https://u:p@§/w@host/x", "https://u:§@host/x", "s3://K:§@bucket"),
    *("https://h/x?sig=§&a=1", "https://h/x?a=1&X-Amz-Signature=§", "h?X-Amz-Credential=§"),
    *("Authorization: Basic §", "Bearer §", "AWS4 Credential=K, Signature=§", "Cookie: a=§"),
    *(
        "get(u, auth=('u', '§'))",
        r"{\"password\": \"§\"}",
        "secret: |-\n  a\n  §\n",
        "a;AccountKey=§;b",
    ),
    *("['--password', '§']", "-----BEGIN RSA PRIVATE KEY-----\nA-b: c\n\n§\n-----END"),
    *(
        "curl -u u:§",
        "curl --proxy-user 'u:§'",
        "curl -uu:§",
        "mysql -u root -p'§'",
        "['mariadb', '-p§', 'db']",
        "sshpass -p '§' ssh h",
        "['sshpass', '-p', '§']",
        "key: |\n  -----BEGIN PRIVATE KEY-----\\n§-----END",
    ),
    *("password := '§'", '"password" => "§"', "if password == '§'", "--auth u:§"),
)


@given(secret=SECRETS)
def test_no_secret_survives(secret: str) -> None:
    for place in PLACES:
        hidden = redact(f"cannot start: {place.replace('§', secret)} at 3")
        assert secret not in hidden
        assert hidden.startswith("cannot start: ")
        assert hidden.endswith(" at 3")


TOKENS = st.sampled_from(
    [
        *(r"(ghp|gho|ghs|hf|npm)_[A-Za-z0-9]{34,40}", r"github_pat_[A-Z0-9]{22}_[a-z0-9]{59}"),
        *(r"glpat-[\w-]{20}", r"xox[bp]-\d{10}-\d{10}-[a-z]{9}", r"A[KS]IA[A-Z0-9]{16}"),
        *(r"AIza[\w-]{35}", r"sk-[a-zA-Z0-9]{48}", r"sk-(proj|ant-api03)-[\w-]{40,90}"),
        r"eyJ[\w-]{17,30}\.eyJ[\w-]{20,90}\.[\w-]{43}",
    ]
).flatmap(lambda pattern: st.from_regex(re.compile(pattern, re.ASCII), fullmatch=True))


@given(TOKENS)
def test_tokens_are_known_by_their_form(token: str) -> None:
    for place in ("login with §.", "'§'", "x=§&y", "[§, 3]", "/§/", "Bearer §"):
        hidden = redact(place.replace("§", token))
        assert token.strip("-")[4:] not in hidden
        assert "***" in hidden


NAMES = st.lists(
    st.sampled_from(
        ["sk", "hf", "npm", "push", "task", "FetchPush-v4", "q=1.5", "seed0", "AKIA", "2"]
    ),
    min_size=1,
).flatmap(lambda words: st.sampled_from("-_/. ").map(lambda joint: joint.join(words)))


@given(NAMES, st.from_regex(r"\A([0-9a-f]{40}|[0-9a-f]{64}|-?\d{1,30}(\.\d{1,20})?)\Z"))
def test_names_of_runs_hashes_numbers_and_paths_are_unchanged(name: str, number: str) -> None:
    for text in (name, number, f"{name}-{number[:12]}", f"/x/{number}/{name}", f"{name}:{number}"):
        assert redact(f"run {text}, line 3") == f"run {text}, line 3"


WORDS = st.from_regex(r"[a-oq-z]{1,9}([.,:=]| = |://h:80/|\('\w'\)|@h|\n)?", fullmatch=True)


@given(st.lists(WORDS))
def test_ordinary_text_is_unchanged(words: list[str]) -> None:
    text = " ".join(word for word in words if not re.search("secret|token|auth|cred|key", word))
    ordinary = "bypass=3, compass: 3, second pass: 3, sig=0.1 token:\nother: 5"
    assert redact(f"{text} {ordinary}") == f"{text} {ordinary}"


@given(st.text(), st.sampled_from(["password=", "https://me:", "token: ", "'secret': '"]))
def test_redaction_is_idempotent(text: str, name: str) -> None:
    once = redact(f"{text}{name}hunter2@host'{text}")
    assert redact(once) == once


CONTROLS = "\x1b[31m\x07\x9b2J\r\u202e\ud800\x00"


@given(st.text(alphabet=st.characters()))
def test_printable_text_has_no_control_characters(text: str) -> None:
    shown = printable(text + CONTROLS)
    shown.encode()
    assert not any(unicodedata.category(one) in {"Cc", "Cs"} for one in shown if one not in "\n\t")
    assert printable(text) == text or any(not one.isprintable() for one in text)


def test_a_console_shows_markup_and_escapes_as_text(capsys: pytest.CaptureFixture[str]) -> None:
    console = console_for()
    table = Table(title=f"[red]{CONTROLS[:-2]}")
    table.add_column("[blink]")
    table.add_row("[bold]x :smile:")
    console.print(f"[red]{CONTROLS}")
    console.print(Text(f"[link=x]{CONTROLS}"))
    console.print(table)
    shown = capsys.readouterr().out
    for word in ("[red]\\u001b[31m", "[link=x]", "[blink]", "[bold]x :smile:"):
        assert word in shown
    assert not any(unicodedata.category(one) == "Cc" for one in shown if one != "\n")


def test_an_error_shows_control_characters_as_text(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file's name and values come from other people."""
    file = tmp_path / "a\x1b[2Jb.yaml"
    file.write_text('name: "\\e[31m[red]\\u202e"\n"k\\e": 1\n')
    assert sweep_main(["plan", str(file)]) == 2
    shown = capsys.readouterr().err
    assert "\x1b" not in shown
    assert "\u202e" not in shown
    assert r"\u001b[2Jb.yaml" in shown


@pytest.mark.parametrize(
    "text",
    [
        *("1" * 100_000, "token" * 20_000, "a://" * 20_000, "secret='" * 9, "secret=([" * 9_999),
        *("-----BEGIN PRIVATE KEY" * 9_999, "eyJ-eyJ." * 20_000),
        *("pw: |\n a\n" * 9_999, "curl -u a:" * 20_000, "mysql -" * 20_000, "sshpass -P" * 20_000),
    ],
)
def test_redaction_takes_linear_time(text: str) -> None:
    """In quadratic time, the first one would take minutes."""
    began = time.process_time()
    redact(text)
    assert time.process_time() - began < 1


def test_a_password_in_the_tracking_uri_is_not_kept(tmp_path: Path) -> None:
    """It should be in the environment; if it is in the URI, the copy of the file omits it."""
    kept_sweep(tmp_path, mlflow={"tracking_uri": "http://music:planted-in-a-uri@localhost:1"})
    kept = [path for path in (tmp_path / "s").rglob("*") if path.is_file()]
    assert not [path for path in kept if b"planted" in path.read_bytes()]
    assert "http://localhost:1" in (tmp_path / "s" / "config.json").read_text()


def test_the_command_that_continues_a_sweep_has_no_passwords(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    arguments = ["run", "my.yaml", "--storage", "s3://KEY:planted-1@bucket/x"]
    server = "mlflow.tracking_uri=http://me:planted-2@host:5000"
    monkeypatch.setattr(sys, "argv", ["music-rllib", *arguments, server])
    said = how_to_continue()
    assert "planted" not in said
    assert said.endswith("run my.yaml --storage s3://bucket/x mlflow.tracking_uri=http://host:5000")


def test_the_command_that_continues_a_sweep_deletes_no_results(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    options = ["--retrain", "FetchPush", "--keep-runs", "--retrain=her", "--retrain-damaged"]
    monkeypatch.setattr(sys, "argv", ["music-rllib", "run", "my.yaml", *options, "seeds=5"])
    assert how_to_continue().endswith("run my.yaml --keep-runs --retrain-damaged seeds=5")
    assert "--retrain FetchPush" in how_to_continue(has_begun=False)
