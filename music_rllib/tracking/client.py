"""Every request that tracking sends to MLflow, and which failures a retry can solve."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shutil
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple
from urllib.parse import quote

from filelock import FileLock
from mlflow import MlflowClient
from mlflow.entities import (
    LoggedModel,
    LoggedModelOutput,
    LoggedModelStatus,
    Metric,
    Param,
    RunTag,
)
from mlflow.exceptions import MlflowException
from mlflow.tracking._tracking_service import utils
from mlflow.version import VERSION

from music_rllib import names
from music_rllib.errors import TrackingError
from music_rllib.redaction import redact
from music_rllib.runtime.process import without_collections
from music_rllib.tracking.policy_model import MODEL_NAME, write_model
from music_rllib.tracking.store import (
    TrackingStore,
    empty_database,
    follow_moved_storage,
    keep_empty_database,
)

MAX_METRICS, MAX_PARAMS = 1000, 100
"""MLflow's limits for one request: metrics, or metrics, params and tags together; and params."""
REQUEST_SECONDS = 30
SCHEMA_SECONDS = 120.0
"""Longest wait for another process that creates the tables of the same SQLite file."""
_LASTING_ERRORS = frozenset(
    {
        "INVALID_PARAMETER_VALUE",
        "INVALID_STATE",
        "RESOURCE_DOES_NOT_EXIST",
        "NOT_FOUND",
    }
)
_UNCLEAR_ERRORS = frozenset({"BAD_REQUEST", "ENDPOINT_NOT_FOUND"})
"""Codes of refused values, but also of a proxy without its server or a database that fails over."""
Status = Literal["FINISHED", "FAILED", "KILLED"]

_HINTS = {
    r"error code 40[13]\b": "Set MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD in the "
    "environment.",
    r"\b5\d\d error responses|error code 5\d\d\b": "The server's own log says why.",
}
"""Pattern of a server's error message -> advice that is appended to it."""


def is_lasting(error: Exception) -> bool:
    """Whether a retry cannot succeed: MLflow refuses the value, or the run was deleted."""
    return isinstance(error, MlflowException) and error.error_code in _LASTING_ERRORS


def is_unclear(error: Exception) -> bool:
    """Whether only further attempts show if a retry can succeed."""
    return isinstance(error, MlflowException) and error.error_code in _UNCLEAR_ERRORS


def mlflow_reason(error: Exception) -> str:
    """The first meaningful line of an error's message, redacted, with advice if there is any."""
    lines = [
        line
        for line in str(error).strip().splitlines()
        if line.strip() and not line.startswith("(raised as a result of Query-invoked autoflush")
    ] or [type(error).__name__]
    line = redact(lines[0])
    hint = next((hint for sign, hint in _HINTS.items() if re.search(sign, line)), "")
    return f"{line} {hint}".rstrip()


@contextlib.contextmanager
def answers_named(store: TrackingStore, action: str) -> Iterator[None]:
    """Turn MLflow's errors into one that names the store and the failed action.

    Raises:
        TrackingError: MLflow does not answer, or refuses.
    """
    try:
        yield
    except TrackingError:
        raise
    except Exception as error:
        raise TrackingError(
            f"MLflow at {store.public_uri} must {action}, it answered: {mlflow_reason(error)}"
        ) from error


class KnownRun(NamedTuple):
    """A run that exists in MLflow."""

    run_id: str
    status: str
    tags: dict[str, str]

    @property
    def is_complete(self) -> bool:
        return self.status == "FINISHED" and names.TAG_INCOMPLETE not in self.tags


class Experiment:
    """The MLflow experiment of a sweep: finds, creates and updates the sweep's runs.

    The constructor creates the experiment if it does not exist, and raises TrackingError if the
    store refuses that. Every method except `known_id` sends requests and raises MLflow's errors.
    """

    def __init__(self, store: TrackingStore, name: str, sweep_id: str, plan: str) -> None:
        self._store = store
        self._name = name
        self._sweep_id = sweep_id
        self._plan = plan
        self._earlier: list[KnownRun] = []
        self.known: dict[str, KnownRun] | None = None
        """Runs by node key ("" for the parent run); None: the next search lists them."""
        with answers_named(store, f"accept the experiment {name!r}"):
            self.client = open_client(store)
            self.id = self._find_or_create()

    # -- finding and creating runs -----------------------------------------------------------

    def find(
        self, node_key: str, identity: Mapping[str, str] = {}, *, again: bool = False
    ) -> KnownRun | None:
        """The run of a node, or the parent run ("").

        Lists all runs of the sweep on the first call, and looks for an unknown one `again`. A run
        that has one of the tags of `identity` with another value is deleted (it can be restored),
        because a new run replaces it.
        """
        known = self.known
        if known is None:
            self.known = known = self._list()
        elif again and node_key and node_key not in known:
            known |= self._list(f" AND tags.`{names.TAG_NODE_KEY}` = '{node_key}'")
        run = known.get(node_key)
        if run and any(run.tags.get(tag, value) != value for tag, value in identity.items()):
            self.delete(node_key)
            return None
        return run

    def delete(self, node_key: str) -> None:
        """Delete a node's run, if there is one, so that it can still be restored."""
        if (run := self.find(node_key)) is not None:
            self.client.delete_run(run.run_id)
            if self.known is not None:
                self.known.pop(node_key, None)

    def known_id(self, node_key: str) -> str | None:
        """Run id of a node whose run was found or created before; sends no request."""
        run = (self.known or {}).get(node_key)
        return None if run is None else run.run_id

    def create(self, node_key: str, name: str, time: int, tags: Mapping[str, str]) -> KnownRun:
        """A new run that began at `time` (ms since the epoch), for a node or the sweep itself."""
        own = (names.TAG_NODE_KEY, node_key) if node_key else (names.TAG_PLAN, self._plan)
        all_tags = {
            **tags,
            names.TAG_KIND: names.KIND_RUN if node_key else names.KIND_SWEEP,
            names.TAG_SWEEP_ID: self._sweep_id,
            names.TAG_CURRENT: names.CURRENT,
            own[0]: own[1],
        }
        try:
            run = self.client.create_run(self.id, start_time=time, tags=all_tags, run_name=name)
        except Exception:
            self.known = None  # listed again, as the response may be lost
            raise
        new = KnownRun(str(run.info.run_id), run.info.status, all_tags)
        if self.known is not None:
            self.known[node_key] = new
        return new

    def _list(self, also: str = "") -> dict[str, KnownRun]:
        """The sweep's runs with a condition, by node key; the older of two with the same key."""
        wanted, token = f"tags.`{names.TAG_SWEEP_ID}` = '{self._sweep_id}'{also}", None
        known: dict[str, KnownRun] = {}
        self._earlier = self._earlier if also else []
        while True:
            page = self.client.search_runs(
                [self.id],
                wanted,
                max_results=1000,
                order_by=["attributes.start_time ASC"],
                page_token=token,
            )
            for run in page:
                tags = dict(run.data.tags)
                found = KnownRun(run.info.run_id, run.info.status, tags)
                node_key = tags.get(names.TAG_NODE_KEY, "")
                if node_key or tags.get(names.TAG_PLAN) == self._plan:
                    known.setdefault(node_key, found)
                else:
                    self._earlier.append(found)
            token = page.token
            if not token:
                return known

    def keep_current(self, node_keys: Collection[str]) -> None:
        """Mark the runs of these nodes, and the parent run, as current, and no other runs.

        A run of an earlier plan that is current again becomes a child of the current parent run.
        """
        parent = self.find("")
        current = {names.TAG_CURRENT: names.CURRENT}
        superseded = {names.TAG_CURRENT: names.SUPERSEDED}
        child = current if parent is None else {**current, names.TAG_PARENT_RUN: parent.run_id}
        wanted = [(run, superseded) for run in self._earlier]
        for node_key, run in (self.known or {}).items():
            tags = child if node_key in node_keys else superseded
            wanted.append((run, tags if node_key else current))
        for run, tags in wanted:
            self.correct(run, tags)
            if tags is superseded and run.status == "RUNNING":
                self._end_abandoned(run.run_id)

    def _end_abandoned(self, run_id: str) -> None:
        """End a run whose driver was killed, unless it has ended since it was listed."""
        try:
            if self.client.get_run(run_id).info.status == "RUNNING":
                self.client.set_terminated(run_id, "KILLED")
        except MlflowException as error:
            if not is_lasting(error):  # otherwise the run was deleted
                raise

    def correct(self, run: KnownRun, tags: Mapping[str, str]) -> None:
        """Set those of the tags of an existing run that it has otherwise or not at all."""
        changed = dict(tags.items() - run.tags.items())
        if not changed:
            return
        try:
            self.log(run.run_id, tags=changed)
        except MlflowException as error:
            if not is_lasting(error):  # otherwise the run was deleted
                raise
        run.tags.update(changed)

    def remove_tag(self, run_id: str, tag: str) -> None:
        """Remove a tag, also if it was removed before and the response was lost."""
        try:
            self.client.delete_tag(run_id, tag)
        except MlflowException as error:
            if error.error_code != "RESOURCE_DOES_NOT_EXIST":
                raise

    # -- one run -----------------------------------------------------------------------------

    def last_steps(self, run_id: str) -> dict[str, int]:
        metrics = self.client.get_run(run_id).data.metrics
        return {
            name: max(point.step for point in self.client.get_metric_history(run_id, name))
            for name in metrics
        }

    def begin_run(self, run_id: str, tags: Mapping[str, str], params: Mapping[str, str]) -> None:
        """Mark an earlier run as running, with these tags and params, without tags of its end.

        MLflow's params are immutable: a param that the run already has keeps its value.
        """
        run = self.client.get_run(run_id)
        fresh = {name: value for name, value in params.items() if name not in run.data.params}
        self.log(run_id, tags=tags, params=fresh)
        ended = {names.TAG_FAILURE, names.TAG_PRUNED, names.TAG_PART}
        for tag in ended & run.data.tags.keys() - tags.keys():
            self.remove_tag(run_id, tag)
        if run.info.status != "RUNNING":
            self.client.update_run(run_id, status="RUNNING")

    def log(
        self,
        run_id: str,
        *,
        metrics: Sequence[Metric] = (),
        params: Mapping[str, str] = {},
        tags: Mapping[str, str] = {},
    ) -> None:
        """Log all of it in as few requests as MLflow's limits allow, usually one."""
        if not (metrics or params or tags):
            return
        left = [Param(*item) for item in params.items()]
        while len(left) > MAX_PARAMS:
            self.client.log_batch(run_id, params=left[:MAX_PARAMS])
            left = left[MAX_PARAMS:]
        given = [RunTag(*item) for item in tags.items()]
        if len(metrics) + len(left) + len(given) > MAX_METRICS:
            self.client.log_batch(run_id, params=left, tags=given)
            left, given = [], []
        self.client.log_batch(run_id, metrics=metrics, params=left, tags=given)

    def log_policy(self, run_id: str, content: bytes, tags: Mapping[str, str]) -> None:
        """Upload a policy as the logged model of a run with these tags, unless it was before."""
        # An earlier attempt may have created the model.
        of_run = f"tags.`{names.TAG_SOURCE_RUN}` = '{run_id}'"
        found, outputs = self.client.search_logged_models([self.id], of_run, max_results=1), None
        if not found:
            model = self._new_model(run_id, tags)
        elif (model := found[0]).status == LoggedModelStatus.READY:
            return
        else:
            outputs = self.client.get_run(run_id).outputs
        with TemporaryDirectory() as temporary:
            file, folder = Path(temporary, "policy.safetensors"), Path(temporary, "model")
            file.write_bytes(content)
            policy = write_model(file, folder, run_id=run_id, model_id=model.model_id)
            self.client.log_model_artifacts(model.model_id, str(folder))
        # MLflow would cache an upload client, with its threads, for each of 1,024 models.
        getattr(utils, "_artifact_repos_cache", {}).pop(model.model_id, None)
        steps = int(policy.about.get("env_steps", 0))
        if not outputs or model.model_id not in [o.model_id for o in outputs.model_outputs]:
            self.client.log_outputs(run_id, [LoggedModelOutput(model.model_id, steps)])
        self.client.finalize_logged_model(model.model_id, LoggedModelStatus.READY)

    def _new_model(self, run_id: str, tags: Mapping[str, str]) -> LoggedModel:
        shown = {key: tags[key] for key in names.TAGS_OF_A_MODEL if key in tags}
        return self.client.create_logged_model(
            self.id,
            name=MODEL_NAME,
            source_run_id=run_id,
            tags={**shown, names.TAG_SOURCE_RUN: run_id},
            params=shown,
            model_type=MODEL_NAME,
        )

    def _find_or_create(self) -> str:
        experiment = self.client.get_experiment_by_name(self._name)
        if experiment is None:
            root = self._store.artifact_root
            location = None if root is None else f"{root}/{quote(self._name)}"
            try:
                return self.client.create_experiment(
                    self._name, location, tags=names.EXPERIMENT_TAGS
                )
            except MlflowException as error:
                if error.error_code != "RESOURCE_ALREADY_EXISTS":
                    raise
                experiment = self.client.get_experiment_by_name(self._name)
        if experiment is None or experiment.lifecycle_stage != "active":
            raise TrackingError(
                f"the experiment {self._name!r} at {self._store.public_uri} must not be deleted. "
                "Restore it (mlflow experiments restore) or give the sweep another name."
            )
        return str(experiment.experiment_id)


def open_client(store: TrackingStore) -> MlflowClient:
    """Connect to the store, without MLflow's own retries and notices.

    MLflow's retries would block for minutes, and could create a run twice if a response gets
    lost. The sender retries instead, and looks for the run first. Only one process at a time may
    create the tables of a SQLite file: MLflow's migration crashes if several do.

    Raises:
        TrackingError: The SQLite file cannot be written.
    """
    os.environ["MLFLOW_HTTP_REQUEST_MAX_RETRIES"] = "0"
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", str(REQUEST_SECONDS))
    os.environ.setdefault("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "true")
    os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
    # Raised by MLflow's use of SQLAlchemy when its database code is imported.
    warnings.filterwarnings("ignore", r"The ``noload`` loader strategy", DeprecationWarning)
    # Raised by MLflow's own type hints when its model code is imported.
    warnings.filterwarnings("ignore", r".*Any type hint is inferred as AnyType", UserWarning)
    logging.getLogger("alembic").setLevel(logging.WARNING)
    # It logs tracebacks of errors that it also raises, and that the sender logs in one line.
    logging.getLogger("mlflow.store.db.utils").setLevel(logging.CRITICAL)
    if store.database is None:
        return MlflowClient(store.uri)
    try:
        store.database.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{store.database}.lock", timeout=SCHEMA_SECONDS), without_collections():
            is_new = not store.database.exists()
            if is_new:
                with contextlib.suppress(OSError, RuntimeError):
                    draft = store.database.with_suffix(".draft")
                    shutil.copyfile(empty_database(VERSION), draft)
                    draft.replace(store.database)
            client = MlflowClient(store.uri)
            client.search_experiments(max_results=1)
            if is_new:
                keep_empty_database(store.database, VERSION)
            if store.artifact_root is not None:
                follow_moved_storage(store.database, store.artifact_root)
            return client
    except (OSError, TimeoutError) as error:
        raise TrackingError(
            f"{store.database} must be writable for the local MLflow store: {error}. "
            "Choose another storage folder or name a server in mlflow.tracking_uri."
        ) from error
