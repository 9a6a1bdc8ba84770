"""Basis of all tests: a fixed environment, markers of the tiers, services, a local Ray."""

from __future__ import annotations

import functools
import gc
import inspect
import os
import shutil
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

# Before the imports of Ray, torch and MLflow, which read these variables. Programs that tests start
# inherit them.
os.environ.update(
    {
        # Explicit, because Ray's default depends on earlier programs on the machine.
        "RAY_AUTH_MODE": "disabled",
        # By default 15: tests would wait for workers that other tests starve.
        "RAY_worker_niceness": "0",
        # More threads change the order of sums, and are slower on busy machines.
        "OMP_NUM_THREADS": "1",
        "NO_COLOR": "1",
        # It takes seconds per sweep; its own test enables it.
        "MUSIC_RLLIB_REPORT": "off",
        # Tests wait for the line of an evaluation.
        "MUSIC_RLLIB_PROGRESS": "all",
    }
)
for _name in ("FORCE_COLOR", "RAY_ADDRESS", "MLFLOW_TRACKING_URI", "MLFLOW_RUN_ID"):
    # A test must never reach the developer's own cluster or tracking server.
    os.environ.pop(_name, None)

import hypothesis
import pytest
import typer.main

from music_rllib.runtime.quiet import (
    LOCAL_RAY_BEYOND_LOOPBACK,
    prepare_environment,
    quiet_third_parties,
)

prepare_environment()
quiet_third_parties()
# Tests start clusters as well; each program decides for itself.
os.environ.pop(LOCAL_RAY_BEYOND_LOOPBACK)
# Tests start modules of the repository, which is the current folder.
os.environ.pop("PYTHONSAFEPATH", None)


def _stack(context: int = 0) -> list[inspect.FrameInfo]:
    frames = [frame for frame, _ in traceback.walk_stack(sys._getframe(1))]
    codes = [(f, f.f_code.co_filename, f.f_lineno, f.f_code.co_name) for f in frames]
    return [inspect.FrameInfo(*code, code_context=None, index=None) for code in codes]


# RLlib's connectors find their caller with `inspect.stack()`, which looks for the source of each
# of pytest's frames: 0.25 s for every Learner.
inspect.stack = _stack

# Each call of `main` would make all commands again: 15 ms, of which a test has up to forty.
typer.main.get_command = functools.cache(typer.main.get_command)

# Imports and collection create millions of permanent objects, and a fifth of a worker's start was
# spent on garbage collection among them. `pytest_collection_finish` enables it again.
gc.disable()

# No deadline, because the machine is shared. Reproducible where a failure cannot be replayed from
# the local example database.
hypothesis.settings.register_profile("here", deadline=None, max_examples=50)
hypothesis.settings.register_profile(
    "ci", deadline=None, max_examples=50, derandomize=True, print_blob=True
)
IN_CI = os.environ.get("CI", "").lower() in ("1", "true")
hypothesis.settings.load_profile("ci" if IN_CI else "here")

_TESTS = Path(__file__).parent
_TIERS = {
    "unit": "unit",
    "contract": "unit",
    "integration": "integration",
    "e2e": "e2e",
    "faults": "faults",
}


LONG = (
    "integration/sweep/test_sweep_local.py",
    "integration/project/test_first_hour.py",
    "integration/project/test_examples.py",
    "integration/sweep/test_sweep_cluster.py",
    "integration/algorithm/test_tac_algorithm.py",
    "integration/algorithm/test_compiled_updates.py",
    "integration/search/test_search_played.py",
    "integration/sweep/test_sweep_trainable.py",
    "integration/report/test_report_in_browser.py",
    "integration/tracking/test_mlflow_tracking.py",
    "integration/report/test_report.py",
    "integration/project/test_docs_site.py",
    "integration/serve/test_serve.py",
    "faults/test_damage.py",
    "integration/search/test_search.py",
    "integration/algorithm/test_learning.py",
    "integration/sweep/test_longer_training.py",
    "faults/test_fuzz.py",
    "faults/test_hostile_files.py",
)
"""The slowest files first: started last, they would keep a single worker busy."""

_THOROUGH_SECONDS = 1800
"""Timeout of programs that start several times, on a machine that others keep busy."""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark each test with its folder's tier, so that ``-m`` works without markers in every file.

    Slow files come first. Thorough tests, those that take many minutes, and those that need a GPU
    are deselected unless ``-m`` asks for them.
    """
    for item in items:
        if item.path.is_relative_to(_TESTS):
            tier = _TIERS.get(item.path.relative_to(_TESTS).parts[0])
            if tier is not None:
                item.add_marker(tier)
    places = {_TESTS / name: place for place, name in enumerate(LONG)}
    items.sort(key=lambda item: places.get(item.path, len(LONG)))
    asked = config.option.markexpr or ""
    for marker in ("thorough", "gpu"):
        marked = [item for item in items if item.get_closest_marker(marker)]
        if marker not in asked:
            config.hook.pytest_deselected(items=marked)
            items[:] = [item for item in items if not item.get_closest_marker(marker)]
        elif marker == "thorough":
            for item in marked:
                if item.get_closest_marker("timeout") is None:
                    item.add_marker(pytest.mark.timeout(_THOROUGH_SECONDS))


def pytest_collection_finish() -> None:
    """Enable garbage collection, except for everything imported and collected so far."""
    gc.freeze()
    gc.enable()


@pytest.fixture(autouse=True)
def _leaves_the_working_folder() -> Iterator[None]:
    """A test that stays in another folder would break others, in some order of the files."""
    before = Path.cwd()
    yield
    os.environ.pop("PYTHONSAFEPATH", None)  # set by a test that called `main`
    if Path.cwd() != before:
        os.chdir(before)
        pytest.fail("the test left another working folder behind: use monkeypatch.chdir")


# Service -> path of its program: a name on PATH, or a pattern below the root folder.
_SERVICES = {
    "postgresql": ("postgres", "usr/lib/postgresql/*/bin/postgres"),
    "prometheus": ("prometheus",),
    "chromium": ("chromium", "chromium-browser"),
}


def _find_program(service: str) -> Path | None:
    for place in _SERVICES[service]:
        found = shutil.which(place)
        if found is not None:
            return Path(found)
        versions = sorted(Path("/").glob(place)) if "/" in place else []
        if versions:
            return versions[-1]
    return None


@pytest.fixture(scope="session")
def require_service() -> Callable[[str], Path]:
    """``require_service("postgresql")`` returns the program's path.

    If it is not installed, the test is skipped with the reason; with ``CI=true`` it fails, so that
    a suite never passes by skipping tests.
    """

    def require(service: str) -> Path:
        program = _find_program(service)
        if program is not None:
            return program
        reason = f"{service} is not installed (Debian: apt-get install {service})"
        if IN_CI:
            pytest.fail(f"{reason}; with CI=true every service must be there", pytrace=False)
        pytest.skip(reason)

    return require


@pytest.fixture(scope="session")
def local_ray() -> Iterator[None]:
    """A local Ray with two CPUs, shared by all tests of the session that ask for it."""
    import ray

    ray.init(
        address="local",  # never another Ray of this machine
        num_cpus=2,
        include_dashboard=False,
        log_to_driver=True,
        runtime_env={"worker_process_setup_hook": quiet_third_parties},
    )
    yield
    ray.shutdown()
