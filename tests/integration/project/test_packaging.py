"""The package as a user gets it: the wheel, a bare import, the exact versions."""

from __future__ import annotations

import importlib.metadata
import os
import re
import shutil
import subprocess
import tarfile
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import music_rllib
from tests.processes import fresh

ROOT = Path(__file__).parents[3]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def _run_python(
    *arguments: str, cwd: Path, path: Path | None = None
) -> subprocess.CompletedProcess[str]:
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    if path is not None:
        environment["PYTHONPATH"] = str(path)
    return fresh(*arguments, cwd=cwd, env=environment)


# --- the source distribution and the wheel ----------------------------------------------------


def _tracked() -> list[str]:
    """The repository's files; in an unpacked source distribution, all files except caches."""
    found = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    listed = found.stdout.splitlines() or [
        path.relative_to(ROOT).as_posix()
        for path in ROOT.rglob("*")
        if path.is_file()
        and not re.search(r"/(\.venv|[^/]*cache[^/]*|[^/]*\.egg-info)/", f"{path}")
    ]
    return [name for name in listed if (ROOT / name).is_file()]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with both, built without a network from a copy (setuptools leaves files behind)."""
    source = tmp_path_factory.mktemp("source")
    for name in _tracked():
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, source / name)
    # As an installer does, build the wheel from the source distribution.
    _run_python("-W", "ignore", "-m", "build", "--no-isolation", cwd=source)
    return source / "dist"


def test_source_distribution_holds_the_repository(built: Path) -> None:
    (path,) = built.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    tracked = {name for name in _tracked() if not name.startswith(".ci/")}
    assert tracked <= packed, sorted(tracked - packed)


@pytest.fixture(scope="module")
def wheel(built: Path) -> Path:
    (path,) = built.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def unpacked(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("unpacked")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def test_wheel_holds_the_whole_package_and_nothing_else(unpacked: Path) -> None:
    wanted = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "music_rllib").rglob("*")
        if path.suffix in {".css", ".html", ".js", ".json", ".md", ".py", ".sh", ".yaml"}
        or path.name == "py.typed"
    }
    packed = {path.relative_to(unpacked) for path in unpacked.rglob("*") if path.is_file()}
    assert {path.as_posix() for path in packed if path.parts[0] == "music_rllib"} == wanted
    others = {path.parts[0] for path in packed} - {"music_rllib"}
    assert all(name.endswith(".dist-info") for name in others), others


def test_wheel_states_version_licence_and_python(unpacked: Path) -> None:
    (metadata,) = unpacked.glob("*.dist-info/METADATA")
    text = metadata.read_text()
    assert re.search(r"^Version: \d+\.\d+\.\d+$", text, re.MULTILINE)
    assert "License-Expression: Apache-2.0" in text
    assert "Requires-Python: >=3.11" in text
    assert (metadata.parent / "licenses" / "LICENSE").is_file()


def test_wheel_installs_the_command(unpacked: Path) -> None:
    (scripts,) = unpacked.glob("*.dist-info/entry_points.txt")
    assert "music-rllib = music_rllib.program:main" in scripts.read_text()


def test_wheel_alone_plans_its_default_sweep(unpacked: Path, tmp_path: Path) -> None:
    """Without a file the program uses a default, which the wheel must contain."""
    shown = _run_python("-m", "music_rllib", "plan", "preset=small", cwd=tmp_path, path=unpacked)
    assert "FetchReach" in shown.stdout
    written = {path.name for path in tmp_path.rglob("*") if path.is_file()}
    assert written == {"analysis_plan.json", "analysis_plan.md"}


# --- importing it --------------------------------------------------------------------------


def test_import_is_silent_light_and_leaves_nothing(tmp_path: Path) -> None:
    heavy = ("ray", "torch", "mlflow", "numpy", "gymnasium", "pydantic")
    code = (
        "import music_rllib, sys, threading\n"
        f"loaded = [name for name in {heavy!r} if name in sys.modules]\n"
        "assert not loaded, loaded\n"
        "assert threading.active_count() == 1\n"
    )
    done = _run_python("-W", "error", "-c", code, cwd=tmp_path)
    assert (done.stdout, done.stderr) == ("", "")
    assert list(tmp_path.iterdir()) == []


def test_every_public_name_loads_and_others_do_not() -> None:
    for name in music_rllib.__all__:
        assert getattr(music_rllib, name) is not None
        assert name in dir(music_rllib)
    with pytest.raises(AttributeError, match="module 'music_rllib' has no attribute 'TACConfi'"):
        getattr(music_rllib, "TACConfi")  # noqa: B009


# --- exact versions ------------------------------------------------------------------------


def _constraints() -> dict[str, Requirement]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    wanted = [Requirement(line) for line in lines if line and not line.startswith("#")]
    named: dict[str, Requirement] = {}
    for requirement in wanted:
        assert named.setdefault(canonicalize_name(requirement.name), requirement) is requirement, (
            f"{requirement.name} is listed twice"
        )
    return named


def _direct_requirements() -> list[Requirement]:
    groups = [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    return [Requirement(text) for group in groups for text in group]


def test_every_constraint_is_one_exact_version() -> None:
    for requirement in _constraints().values():
        (specifier,) = requirement.specifier
        assert specifier.operator == "==", requirement
        # A wildcard is not an exact version; a local label (+cpu) or a URL depends on one index.
        assert "*" not in specifier.version, requirement
        assert Version(specifier.version).local is None, requirement
        assert requirement.url is None, requirement


def test_constraints_satisfy_the_declared_ranges() -> None:
    constraints = _constraints()
    for requirement in _direct_requirements():
        exact = constraints[canonicalize_name(requirement.name)]
        (specifier,) = exact.specifier
        assert requirement.specifier.contains(specifier.version), (requirement, exact)


def _requirements_of(name: str, extras: set[str]) -> Iterator[Requirement]:
    for text in importlib.metadata.requires(name) or ():
        requirement = Requirement(text)
        environments = [{"extra": extra} for extra in (extras or {""})]
        if requirement.marker is None or any(
            requirement.marker.evaluate(environment) for environment in environments
        ):
            yield requirement


# Part of the `bench` extra, installed by `make bench`: its dependencies cannot be looked up.
NOT_IN_THE_TESTS = {"sb3-contrib", "sbx-rl", "stable-baselines3"}
"""Packages that `make bench` installs."""


def test_constraints_pin_everything_that_is_pulled_in() -> None:
    """All direct and indirect dependencies have an exact version."""
    constraints = _constraints()
    queue = _direct_requirements()
    seen: set[tuple[str, frozenset[str]]] = set()
    missing: set[str] = set()
    while queue:
        requirement = queue.pop()
        name = canonicalize_name(requirement.name)
        key = (name, frozenset(requirement.extras))
        # A CUDA build of torch pins its own libraries exactly; they differ from build to build.
        if key in seen or name.startswith(("nvidia-", "cuda-", "triton")):
            continue
        seen.add(key)
        if name not in constraints:
            missing.add(name)
            continue
        if name in NOT_IN_THE_TESTS:
            continue
        queue.extend(_requirements_of(name, requirement.extras))
    assert not missing, f"add to constraints.txt: {sorted(missing)}"
