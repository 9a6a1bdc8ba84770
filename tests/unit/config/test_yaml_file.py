"""Strict reading of YAML: types of scalars, and mistakes with their line."""

import math
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from music_rllib.config.document import Document
from music_rllib.config.problems import ConfigError
from music_rllib.config.yaml_file import Dumper, YamlFile, read_value, read_yaml


def read(tmp_path: Path, text: str) -> YamlFile:
    path = tmp_path / "sweep.yaml"
    path.write_text(text, encoding="utf-8")
    return read_yaml(path)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001),
        ("1.5", 1.5),
        ("-.5", -0.5),
        ("6e3", 6000.0),
        ("1_000_000", 1_000_000),
        ("0:3", "0:3"),
        ("3:6", "3:6"),
        ("010", "010"),
        ("0x10", "0x10"),
        ("on", "on"),
        ("no", "no"),
        ("2020-01-01", "2020-01-01"),
        ("true", True),
        ("~", None),
        ("", None),
        ("'1'", "1"),
        ("-.inf", -math.inf),
    ],
)
def test_scalars_follow_yaml_1_2(tmp_path: Path, text: str, value: Any) -> None:
    found = read(tmp_path, f"key: {text}\n").data["key"]
    assert found == value
    assert type(found) is type(value)


@given(st.floats(allow_nan=False, allow_infinity=False) | st.integers())
def test_every_number_python_prints_is_read_back(
    tmp_path_factory: pytest.TempPathFactory, number: float
) -> None:
    found = read(tmp_path_factory.mktemp("yaml"), f"key: {number!r}\n").data["key"]
    assert found == number
    assert type(found) is type(number)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a:\ty\n", "y"),
        ("a: y\t# comment\n", "y"),
        ("a: y \t\n\t# comment\n \t\n", "y"),
        ("a\t:\t'y'\t\n", "y"),
        ("a:\t[1,\t2\t]\t# comment\n", [1, 2]),
        ("a:\n-\ty\n- \t[1]\n", ["y", [1]]),
        ('{\n\t"a": {\n\t\t"b":\t"c",\n\t\t"d": [\n\t\t]\n\t}\n}\n', {"b": "c", "d": []}),
        ("a: x\ty\t\n  z\t# comment\n", "x y z"),
        ("a: 'x\u00a0y'  # and\u00a0here\n", "x\u00a0y"),
        ('{"a": "say \\"x\u00a0y\\" c"}', 'say "x\u00a0y" c'),
    ],
)
def test_tabs_separate_tokens_and_quoted_text_keeps_any_space(
    tmp_path: Path, text: str, value: Any
) -> None:
    assert read(tmp_path, text).data == {"a": value}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a:\n\tb: 1\n", "sweep.yaml:2: must be valid YAML: a tab must not indent a line"),
        ("a:\n  b: 1\n \t c: 1\n", "sweep.yaml:3: must be valid YAML: a tab must not indent"),
        (
            "a:\u00a0[0]\nb: 1\n",
            "sweep.yaml:1: must be valid YAML: column 3 has U+00A0 (NO-",
        ),
        ("a: 1\nb:\n\u00a0 c: 1\n", "sweep.yaml:3: must be valid YAML: column 1 has U+00A0"),
        (
            "a: x\n  y\u200bz\n",
            "sweep.yaml:2: must be valid YAML: column 4 has U+200B (ZERO WID",
        ),
        ("a: 1\nb: 2\na: 3\n", "sweep.yaml:3: must be valid YAML: key 'a' must not repeat"),
        ("a:\n  b: 1\n  b: 2\n", "sweep.yaml:3: must be valid YAML: key 'b' must not repeat"),
        (
            "a: &x {b: 1}\nc:\n  <<: *x\n  d: 1\n  d: 2\n",
            "sweep.yaml:5: must be valid YAML: key 'd'",
        ),
        ("a: 1\n2: 3\n", "sweep.yaml:2: must be valid YAML: keys must be text"),
        ("a: [1, 2\n", "sweep.yaml:2: must be valid YAML"),
        ("a: &x [*x]\n", "sweep.yaml:1: must be valid YAML: an alias must not contain itself"),
        ("a: !!python/object/apply:os.getcwd []\n", "sweep.yaml:1: must be valid YAML"),
        ("a: !!set {b}\n", "is not allowed here"),
        ("a: 1\n---\nb: 2\n", "sweep.yaml:2: must be valid YAML"),
        ("- a\n", "sweep.yaml: must be a mapping"),
        ("", "sweep.yaml: must be a mapping"),
    ],
)
def test_invalid_files_are_rejected_with_their_line(
    tmp_path: Path, text: str, message: str
) -> None:
    with pytest.raises(ConfigError) as refusal:
        read(tmp_path, text)
    assert message in str(refusal.value)


def test_a_byte_order_mark_is_not_part_of_the_text(tmp_path: Path) -> None:
    assert read(tmp_path, "\ufeffname: a\n").data == {"name": "a"}


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"missing\.yaml: must be an existing file"):
        read_yaml(tmp_path / "missing.yaml")
    with pytest.raises(ConfigError, match="must be a readable YAML file: Is a directory"):
        read_yaml(tmp_path)
    (tmp_path / "latin.yaml").write_bytes(b"a: \xe9\n")
    with pytest.raises(ConfigError, match="not UTF-8"):
        read_yaml(tmp_path / "latin.yaml")


def test_a_place_is_the_line_of_a_value_or_of_its_parent(tmp_path: Path) -> None:
    path = tmp_path / "sweep.yaml"
    path.write_text("a: 1\nb:\n  - c: 2\n  - d:\n      e: 3\n")
    document = Document(path)
    assert str(document.place(("a",))) == "sweep.yaml:1"
    assert str(document.place(("b", 1, "d", "e"))) == "sweep.yaml:5"
    assert str(document.place(("b", 1, "d", "absent", 0))) == "sweep.yaml:4"
    assert str(document.place(("absent",))) == "sweep.yaml"


def test_merge_keys_share_settings(tmp_path: Path) -> None:
    file = read(tmp_path, "a: &base {x: 1, y: 2}\nb:\n  <<: *base\n  y: 3\n")
    assert file.data["b"] == {"x": 1, "y": 3}


def test_merge_keys_may_form_a_chain_that_is_used_above_it(tmp_path: Path) -> None:
    chain = "a:\n  in:\n    deep: &slow\n      <<: &base {x: 1, y: 2}\n      x: 3\n"
    file = read(tmp_path, f"{chain}b:\n  <<: *slow\n  z: 4\n")
    assert file.data == {"a": {"in": {"deep": {"x": 3, "y": 2}}}, "b": {"x": 3, "y": 2, "z": 4}}


def test_text_that_looks_like_a_number_stays_text() -> None:
    values = ["12e4", "1e3", "no", "010", 1e16, 1e-5, None, "", "3", True]
    assert read_value(yaml.dump(values, Dumper=Dumper)) == values
