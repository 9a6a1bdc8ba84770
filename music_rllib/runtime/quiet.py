"""Hide third-party messages that a user cannot act on, in the driver and in workers.

An entry point calls `prepare_environment` before `import ray`, because Ray and MLflow read their
environment variables when they are imported. `quiet_third_parties` runs in the driver and, in Ray's
setup hook (`runtime.ray_cluster`), in every worker. New warnings and all errors are still shown.
"""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import warnings
from functools import partial
from pathlib import Path

from music_rllib.runtime.machine import cluster_address

# Logger -> beginnings of expected messages at WARNING level about this package's use of a library.
_EXPECTED_NOTICES: dict[str, tuple[str, ...]] = {
    # Once per algorithm class; this package uses the new API stack.
    "ray.rllib.algorithms.algorithm_config": ("You are running ",),
    # RLModule's own constructor builds the deprecated object (rllib/core/rl_module/rl_module.py).
    "ray._common.deprecation": (
        "DeprecationWarning: `RLModule(config=[RLModuleConfig object])` has been deprecated.",
    ),
    # GPUtil is unmaintained, and psutil measures our processes. On a busy machine, Tune also warns
    # about every callback that takes half a second ("The `...").
    "ray.tune.utils.util": ("Install gputil for GPU system monitoring.", "The `"),
}

# Loggers whose INFO messages repeat the program's output, or mean nothing to a user.
_CHATTY_LOGGERS = (
    "ray._private.worker",  # "Started a local Ray instance."
    "ray.tune.tune",  # "Wrote the latest version of all result files ..."
    "ray.tune.trainable.trainable",  # "Trainable.setup took ..."
    "ray.train._internal.storage",  # "Checkpoint successfully created at ..."
    "alembic.runtime.migration",  # one line per migration of a fresh MLflow or Optuna database
    "alembic.runtime.plugins",
    "mlflow.store.db.utils",  # "Creating initial MLflow database tables..."
    "optuna.storages._rdb.storage",
    "optuna.study.study",
    "optuna.study._optimize",
)

LOCAL_RAY_BEYOND_LOOPBACK = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""If "0", Ray listens on 127.0.0.1 only. It is named after the systems with this default."""


def _is_shown(beginnings: tuple[str, ...], record: logging.LogRecord) -> bool:
    return record.levelno >= logging.ERROR or not record.getMessage().startswith(beginnings)


# Created once, because a logger ignores a filter that it already has.
_FILTERS = {name: partial(_is_shown, texts) for name, texts in _EXPECTED_NOTICES.items()}


def prepare_environment() -> None:
    """Set environment variables for Ray and MLflow, unless the user has set them.

    Call it before `import ray`. The workers of a local Ray inherit the variables; those of a
    running cluster do not.
    """
    # A `types.py` in the current folder would break every Python process that Ray starts. In the
    # folder of a checkout that is not installed, these processes need the current folder.
    with contextlib.suppress(FileNotFoundError):
        if Path.cwd() != Path(__file__).parents[2]:
            os.environ.setdefault("PYTHONSAFEPATH", "1")
    # Ray's new progress output prints a table even with verbose=0; the old one is silent then.
    os.environ.setdefault("RAY_AIR_NEW_OUTPUT", "0")
    # No usage data is sent unless the user asks for it.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    # MLflow reads the commit through GitPython, which prints a long warning if git is missing.
    os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
    # A local Ray would start a worker per CPU without the setup hook, which no run can use.
    os.environ.setdefault("RAY_prestart_worker_first_driver", "0")
    if cluster_address() is not None:
        return
    # By default every process of a local Ray listens on all addresses, and `/metrics` needs no
    # token.
    os.environ.setdefault(LOCAL_RAY_BEYOND_LOOPBACK, "0")
    # By default Ray writes a token file into the home folder, which changes later `ray start`s. A
    # token in the environment keeps other users out of the local Ray and leaves no file.
    if "RAY_AUTH_MODE" not in os.environ:
        os.environ["RAY_AUTH_MODE"] = "token"
        if "RAY_AUTH_TOKEN" not in os.environ and "RAY_AUTH_TOKEN_PATH" not in os.environ:
            os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)


def quiet_third_parties() -> None:
    """Hide known third-party messages in this process. Further calls change nothing."""
    for name, is_shown in _FILTERS.items():
        logging.getLogger(name).addFilter(is_shown)
    for name in _CHATTY_LOGGERS:
        logger = logging.getLogger(name)
        if logger.level != logging.WARNING:  # setting it empties the cache of every logger
            logger.setLevel(logging.WARNING)
    # RLlib registers its wrapper environment again for every environment runner.
    warnings.filterwarnings(
        "ignore", message=r".*Overriding environment rllib-(single|multi)-agent-env-v0"
    )
