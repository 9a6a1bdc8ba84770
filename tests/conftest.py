"""What every test stands on: a fixed environment, the tiers' markers, services, a local Ray."""

from __future__ import annotations

import gc
import inspect
import os
import shutil
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

# Before anything imports Ray, torch or MLflow: they read these while they are imported, and the
# programs that tests start inherit them.
os.environ.update(
    {
        # Explicit, because Ray's default depends on what else was run on the machine before.
        "RAY_AUTH_MODE": "disabled",
        # More threads change the sums' order and are slower on busy machines.
        "OMP_NUM_THREADS": "1",
        "NO_COLOR": "1",
        # Seconds for each sweep; the test of it asks for it.
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

from music_rllib.runtime.quiet import (
    LOCAL_RAY_BEYOND_LOOPBACK,
    prepare_environment,
    quiet_third_parties,
)

prepare_environment()
quiet_third_parties()
# Tests start clusters as well; each program of ours that they start decides for itself.
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

# Imports and collection make millions of objects that stay: a fifth of the time of a worker's start
# went into looking for garbage among them. `pytest_collection_finish` continues.
gc.disable()

# No deadline: the machine is shared. Reproducible where a failure cannot be replayed from the
# local example database.
hypothesis.settings.register_profile("here", deadline=None, max_examples=50)
hypothesis.settings.register_profile(
    "ci", deadline=None, max_examples=50, derandomize=True, print_blob=True
)
_IN_CI = os.environ.get("CI", "").lower() in ("1", "true")
hypothesis.settings.load_profile("ci" if _IN_CI else "here")

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
"""Files that take longest, the longest first: begun last, one would keep a single worker busy."""

_THOROUGH_SECONDS = 1800
"""For programs that start several times, on a machine that others keep busy."""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark each test with its folder's tier, so that ``-m`` works without markers in every file.

    The long files come first. What is thorough, and takes many minutes, or needs a GPU is left out
    unless ``-m`` asks for it.
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
    """Look for garbage again, but not among what was imported and collected."""
    gc.freeze()
    gc.enable()


@pytest.fixture(autouse=True)
def _leaves_the_working_folder() -> Iterator[None]:
    """A test that goes elsewhere and stays there breaks another one, in some order of the files."""
    before = Path.cwd()
    yield
    os.environ.pop("PYTHONSAFEPATH", None)  # set by a test that called the program's own start
    if Path.cwd() != before:
        os.chdir(before)
        pytest.fail("the test left another working folder behind: use monkeypatch.chdir")


# Service -> where its program may be: a name on PATH, or a pattern below the root folder.
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
    """``require_service("postgresql")`` gives the program's path.

    Where it is not installed the test is skipped with the reason; with ``CI=true`` it fails, so
    that a suite never turns green by leaving things out.
    """

    def require(service: str) -> Path:
        program = _find_program(service)
        if program is not None:
            return program
        reason = f"{service} is not installed (Debian: apt-get install {service})"
        if _IN_CI:
            pytest.fail(f"{reason}; with CI=true every service must be there", pytrace=False)
        pytest.skip(reason)

    return require


@pytest.fixture(scope="session")
def local_ray() -> Iterator[None]:
    """A local Ray with two CPUs, shared by all tests of the session that ask for it."""
    import ray

    ray.init(
        address="local",  # never one that happens to run on this machine
        num_cpus=2,
        include_dashboard=False,
        log_to_driver=True,
        runtime_env={"worker_process_setup_hook": quiet_third_parties},
    )
    yield
    ray.shutdown()
