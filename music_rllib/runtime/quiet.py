"""Keep third-party notices that a user cannot act on off the screen, in driver and workers.

Two steps, because some libraries read their switches while they are imported:

1. ``prepare_environment()`` is the first thing that an entry point does, before ``import ray``.
2. ``quiet_third_parties()`` runs in the driver and, as Ray's setup hook, in every worker::

       ray.init(runtime_env={"worker_process_setup_hook": quiet_third_parties})

Each filter names one logger and the beginning of one message (or a library's chatter below
WARNING), so whatever is new, and every error, still shows.
"""

from __future__ import annotations

import logging
import os
import secrets
import warnings

from music_rllib.envs.farama_notice import drop_farama_notice

# Notices at WARNING level: logger -> how the message begins. All are about our own use of the
# library, are expected, and leave a user nothing to do.
_EXPECTED_NOTICES: dict[str, tuple[str, ...]] = {
    # Once per algorithm class; the new API stack is the one this package is written for.
    "ray.rllib.algorithms.algorithm_config": ("You are running ",),
    # RLModule's own constructor builds the deprecated object (rllib/core/rl_module/rl_module.py).
    "ray._common.deprecation": (
        "DeprecationWarning: `RLModule(config=[RLModuleConfig object])` has been deprecated.",
    ),
    # See `prepare_environment`.
    "ray.rllib.utils.framework": ("Not importing JAX", "Not importing TensorFlow"),
    # GPUtil is unmaintained; the sweeper measures its processes with psutil.
    # Tune complains of any callback that takes half a second, as all do on a busy machine.
    "ray.tune.utils.util": ("Install gputil for GPU system monitoring.", "The `"),
}

# Loggers whose INFO lines repeat what the command line says better, or say nothing to a user.
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
"""0: Ray's address is 127.0.0.1, and no other node can join. Read while Ray is imported."""


class _DropExpected(logging.Filter):
    """Drop the records whose message begins with one of ``beginnings``; errors always pass."""

    def __init__(self, beginnings: tuple[str, ...]) -> None:
        super().__init__()
        self.beginnings = beginnings

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno >= logging.ERROR:
            return True
        return not record.getMessage().startswith(self.beginnings)


def prepare_environment() -> None:
    """Set what Ray and MLflow read from the environment; what the user has set is kept.

    Must run before ``import ray``: the core library reads its configuration once. A local Ray's
    workers inherit these variables; those of a cluster that runs already do not.
    """
    # Ray's new progress output prints a table even with verbose=0; the older one is silent then.
    os.environ.setdefault("RAY_AIR_NEW_OUTPUT", "0")
    # Nothing is reported to anyone unless the user asks for it.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    # MLflow reads the commit through GitPython, which complains at length where git is missing.
    os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
    # RLlib imports both where they are installed, for seconds in each worker, and TAC uses neither.
    os.environ.setdefault("RLLIB_TEST_NO_JAX_IMPORT", "1")
    os.environ.setdefault("RLLIB_TEST_NO_TF_IMPORT", "1")
    # A local Ray would begin with a worker per CPU, which no run can use: theirs have a setup hook.
    os.environ.setdefault("RAY_prestart_worker_first_driver", "0")
    _keep_local_ray_on_loopback()
    _authenticate_local_ray()


def _keep_local_ray_on_loopback() -> None:
    """Have a local Ray listen on loopback only, unless a cluster has been chosen.

    Left alone, every process of it listens on all addresses, its ``/metrics`` without a token.
    Ray's own setting for this is named after the systems on which it is the default.
    """
    if "RAY_ADDRESS" not in os.environ:
        os.environ.setdefault(LOCAL_RAY_BEYOND_LOOPBACK, "0")


def _authenticate_local_ray() -> None:
    """Give a local Ray a token of its own, unless a cluster or a mode has been chosen.

    Left alone, Ray writes a token file into the home folder, says so, and from then on every
    ``ray start`` on the machine behaves differently. A token in the environment keeps the local
    Ray closed to other users of the machine and leaves nothing behind.
    """
    if "RAY_ADDRESS" in os.environ or "RAY_AUTH_MODE" in os.environ:
        return
    os.environ["RAY_AUTH_MODE"] = "token"
    if "RAY_AUTH_TOKEN" not in os.environ and "RAY_AUTH_TOKEN_PATH" not in os.environ:
        os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)


def quiet_third_parties() -> None:
    """Filter the known third-party notices in this process. May be called more than once."""
    for name, beginnings in _EXPECTED_NOTICES.items():
        logger = logging.getLogger(name)
        if not any(isinstance(present, _DropExpected) for present in logger.filters):
            logger.addFilter(_DropExpected(beginnings))
    for name in _CHATTY_LOGGERS:
        logger = logging.getLogger(name)
        if logger.level != logging.WARNING:  # setting it forgets what is cached of every logger
            logger.setLevel(logging.WARNING)
    # RLlib registers its wrapper environment anew for every environment runner that it builds.
    warnings.filterwarnings(
        "ignore", message=r".*Overriding environment rllib-(single|multi)-agent-env-v0"
    )
    drop_farama_notice()
