"""Every call to MLflow that tracking makes, and which failures are worth a retry."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple
from urllib.parse import quote

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

from music_rllib import names
from music_rllib.errors import TrackingError
from music_rllib.redaction import redact
from music_rllib.tracking.connection import configure_mlflow, open_client
from music_rllib.tracking.policy_model import MODEL_NAME, write_model
from music_rllib.tracking.store import TrackingStore

MAX_METRICS = 1000
"""MLflow's limit for the metrics of one request."""
_LASTING_ERRORS = frozenset(
    {
        "INVALID_PARAMETER_VALUE",
        "BAD_REQUEST",
        "INVALID_STATE",
        "RESOURCE_DOES_NOT_EXIST",
        "NOT_FOUND",
        "ENDPOINT_NOT_FOUND",
    }
)
Status = Literal["FINISHED", "FAILED", "KILLED"]

_HINTS = {
    r"error code 40[13]\b": "Set MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD in the "
    "environment.",
    r"\b5\d\d error responses|error code 5\d\d\b": "The server's own log says why.",
}
"""Pattern of a server's error message -> advice that is appended to it."""

_PART = r"(?!\.{1,2}(?:/|$))[\w.\-: ]+"
_METRIC_NAME = re.compile(rf"{_PART}(?:/{_PART})*")


def check_metric_name(name: str) -> None:
    """Raise ValueError if MLflow would refuse the metric name."""
    if len(name) > 250 or not _METRIC_NAME.fullmatch(name):
        raise ValueError(
            "a metric's name must have at most 250 letters, digits, '_', '-', '.', ':', spaces, "
            f"and single slashes between them, got {name!r}"
        )


def is_lasting(error: Exception) -> bool:
    """Whether a retry cannot succeed: MLflow refuses the value, or the run was deleted."""
    return isinstance(error, MlflowException) and error.error_code in _LASTING_ERRORS


class KnownRun(NamedTuple):
    """A run that exists in MLflow."""

    run_id: str
    started: int
    """Start time in ms since the epoch."""
    complete: bool = False
    """Whether it is finished and all of its data has arrived."""
    environment: str = ""
    """Its `names.TAG_ENVIRONMENT`."""
    current: str = names.CURRENT
    """`names.TAG_CURRENT`; empty for runs of earlier versions of this package."""
    parent: str = ""
    """Id of the parent run; empty for one that this object has created."""


class Experiment:
    """The MLflow experiment of a sweep: finds, creates and updates the sweep's runs.

    The constructor creates the experiment if it does not exist, and raises TrackingError if the
    store refuses that. Every method but `known_id` asks the server, and raises MLflow's errors.
    """

    def __init__(self, store: TrackingStore, name: str, sweep_id: str, plan: str) -> None:
        self._store = store
        self._name = name
        self._sweep_id = sweep_id
        self._plan = plan
        self._earlier: list[KnownRun] = []
        """Parent runs of other plans of the sweep."""
        self._known: dict[str, KnownRun] | None = None
        """Runs by node key ("" for the sweep's own run); None until the server has listed them."""
        configure_mlflow()
        try:
            self._client = open_client(store)
            self.id = self._find_or_create()
        except TrackingError:
            raise
        except Exception as error:
            raise TrackingError(
                f"MLflow at {store.public_uri} must accept the experiment {name!r}, "
                f"it answered: {mlflow_reason(error)}"
            ) from error

    def find(self, node_key: str, environment: str | None = None) -> KnownRun | None:
        """The run of a node, or the sweep's own run ("").

        Lists all runs of the sweep on the first call. A run of another environment is deleted (as
        MLflow does it, so that it can be restored), because another one takes its place.
        """
        if self._known is None:
            self._known = self._list()
        known = self._known.get(node_key)
        if known and environment and known.environment and known.environment != environment:
            self.delete(node_key)
            return None
        return known

    def delete(self, node_key: str) -> None:
        """Delete a node's run, if there is one, so that it can still be restored."""
        known = self.find(node_key)
        if known is not None and self._known is not None:
            self._client.delete_run(known.run_id)
            del self._known[node_key]

    def known_id(self, node_key: str) -> str | None:
        """Run id of a node whose run was found or created before; sends no request."""
        run = (self._known or {}).get(node_key)
        return None if run is None else run.run_id

    def create(self, node_key: str, name: str, time: int, tags: Mapping[str, str]) -> KnownRun:
        """A new run that began at `time` (ms since the epoch), for a node or the sweep itself."""
        kind = names.KIND_RUN if node_key else names.KIND_SWEEP
        identity = {names.TAG_KIND: kind, names.TAG_SWEEP_ID: self._sweep_id}
        identity[names.TAG_CURRENT] = names.CURRENT
        own = (names.TAG_NODE_KEY, node_key) if node_key else (names.TAG_PLAN, self._plan)
        identity |= [own]
        known, self._known = self._known or {}, None  # listed again if the response gets lost
        run = self._client.create_run(
            self.id, start_time=time, tags={**tags, **identity}, run_name=name
        )
        environment = tags.get(names.TAG_ENVIRONMENT, "")
        new = KnownRun(str(run.info.run_id), time, environment=environment)
        self._known = known | {node_key: new}
        return self._known[node_key]

    def _list(self) -> dict[str, KnownRun]:
        """The sweep's runs by node key; the older run where two have the same key."""
        wanted, token = f"tags.`{names.TAG_SWEEP_ID}` = '{self._sweep_id}'", None
        known: dict[str, KnownRun] = {}
        self._earlier = []
        while True:
            page = self._client.search_runs(
                [self.id],
                wanted,
                max_results=1000,
                order_by=["attributes.start_time ASC"],
                page_token=token,
            )
            for run in page:
                tags = run.data.tags
                complete = run.info.status == "FINISHED" and names.TAG_INCOMPLETE not in tags
                node_key = tags.get(names.TAG_NODE_KEY, "")
                found = KnownRun(
                    run.info.run_id,
                    run.info.start_time,
                    complete,
                    environment=tags.get(names.TAG_ENVIRONMENT, ""),
                    current=tags.get(names.TAG_CURRENT, ""),
                    parent=tags.get(names.TAG_PARENT_RUN, ""),
                )
                if node_key or tags.get(names.TAG_PLAN) == self._plan:
                    known.setdefault(node_key, found)
                else:
                    self._earlier.append(found)
            token = page.token
            if not token:
                return known

    def keep_current(self, node_keys: Collection[str]) -> None:
        """Mark the runs of these nodes, and the sweep's own run, as current, and no others.

        A run of an earlier plan that is current again becomes a child of the current parent run.
        """
        parent = self.find("")
        of_plan = {} if parent is None else {names.TAG_PARENT_RUN: parent.run_id}
        for node_key, run in list((self._known or {}).items()):
            if not node_key:
                self._mark(run, {names.TAG_CURRENT: names.CURRENT})
            elif node_key in node_keys:
                self._mark(run, {names.TAG_CURRENT: names.CURRENT, **of_plan})
            else:
                self._mark(run, {names.TAG_CURRENT: names.SUPERSEDED})
        for run in self._earlier:
            self._mark(run, {names.TAG_CURRENT: names.SUPERSEDED})

    def _mark(self, run: KnownRun, tags: Mapping[str, str]) -> None:
        """Set the tags of a run that it does not have."""
        has = {names.TAG_CURRENT: run.current, names.TAG_PARENT_RUN: run.parent}
        changed = dict(tags.items() - has.items())
        if run.parent == "" and run.current == names.CURRENT:  # created with all of them
            changed.pop(names.TAG_PARENT_RUN, None)
        if not changed:
            return
        try:
            self.set_tags(run.run_id, changed)
        except MlflowException as error:
            if not is_lasting(error):  # else it was deleted
                raise

    def last_steps(self, run_id: str) -> dict[str, int]:
        """Last step of each metric of the run."""
        metrics = self._client.get_run(run_id).data.metrics
        return {
            name: max(point.step for point in self._client.get_metric_history(run_id, name))
            for name in metrics
        }

    def begin_run(self, run_id: str, tags: Mapping[str, str], params: Mapping[str, str]) -> None:
        """Mark the run as running, with these tags and params, and without an earlier end's tags.

        MLflow's params are immutable, but a sweep may be continued with other settings, such as
        more seeds: a changed param becomes a tag.
        """
        run = self._client.get_run(run_id)
        known = run.data.params
        changed = {
            names.TAG_CHANGED_PREFIX + key: value
            for key, value in params.items()
            if known.get(key, value) != value or names.TAG_CHANGED_PREFIX + key in run.data.tags
        }
        self.set_tags(run_id, {**tags, **changed})
        fresh = [Param(key, value) for key, value in params.items() if key not in known]
        self._client.log_batch(run_id, params=fresh, synchronous=True)
        for tag in {names.TAG_FAILURE, names.TAG_PRUNED} & run.data.tags.keys() - tags.keys():
            self._client.delete_tag(run_id, tag)
        if run.info.status != "RUNNING":
            self._client.update_run(run_id, status="RUNNING")

    def set_tags(self, run_id: str, tags: Mapping[str, str]) -> None:
        """Set tags; existing tags of the same names are overwritten."""
        values = [RunTag(*item) for item in tags.items()]
        self._client.log_batch(run_id, tags=values, synchronous=True)

    def delete_tag(self, run_id: str, tag: str) -> None:
        """Delete a tag that the run has."""
        self._client.delete_tag(run_id, tag)

    def log_metrics(self, run_id: str, metrics: Sequence[Metric]) -> None:
        """Log values of metrics; logging them twice changes nothing."""
        self._client.log_batch(run_id, metrics=metrics, synchronous=True)

    def end_run(self, run_id: str, status: Status, time: int) -> None:
        """Mark the run as ended at ``time`` (ms since the epoch)."""
        self._client.set_terminated(run_id, status=status, end_time=time)

    def keep_view(self, key: str, content: str) -> None:
        """Save a view of the experiment's pages under `key`."""
        self._client.set_experiment_tag(self.id, names.TAG_VIEW_PREFIX + key, content)

    def upload(self, run_id: str, name: str, content: bytes) -> None:
        """Upload a file as the artefact `name`."""
        folder, _, base = name.rpartition("/")
        with TemporaryDirectory() as temporary:
            file = Path(temporary, base)
            file.write_bytes(content)
            self._client.log_artifact(run_id, str(file), folder or None)
        _forget_repository(run_id)

    def log_policy(self, run_id: str, name: str, content: bytes) -> None:
        """Upload a policy as the run's logged model, unless that is there already.

        A server without logged models (MLflow 2) gets it as the artefact `name`.
        """
        try:
            model = self._policy_model(run_id)
        except MlflowException as error:
            if error.error_code != "ENDPOINT_NOT_FOUND":
                raise
            self.upload(run_id, name, content)
            return
        if model.status == LoggedModelStatus.READY:
            return
        with TemporaryDirectory() as temporary:
            file, folder = Path(temporary, "policy.safetensors"), Path(temporary, "model")
            file.write_bytes(content)
            policy = write_model(file, folder, run_id=run_id, model_id=model.model_id)
            self._client.log_model_artifacts(model.model_id, str(folder))
            _forget_repository(model.model_id)
        steps = int(policy.about.get("env_steps", 0))
        outputs = self._client.get_run(run_id).outputs
        if not outputs or model.model_id not in [o.model_id for o in outputs.model_outputs]:
            self._client.log_outputs(run_id, [LoggedModelOutput(model.model_id, steps)])
        self._client.finalize_logged_model(model.model_id, LoggedModelStatus.READY)

    def _policy_model(self, run_id: str) -> LoggedModel:
        """The run's logged model; created unless an earlier attempt has created it."""
        found = self._client.search_logged_models(
            [self.id], f"tags.`{names.TAG_SOURCE_RUN}` = '{run_id}'", max_results=1
        )
        if found:
            return found[0]
        tags = self._client.get_run(run_id).data.tags
        shown = {key: tags[key] for key in names.TAGS_OF_A_MODEL if key in tags}
        return self._client.create_logged_model(
            self.id,
            name=MODEL_NAME,
            source_run_id=run_id,
            tags={**shown, names.TAG_SOURCE_RUN: run_id},
            params=shown,
            model_type=MODEL_NAME,
        )

    def _find_or_create(self) -> str:
        experiment = self._client.get_experiment_by_name(self._name)
        if experiment is None:
            root = self._store.artefact_root
            location = None if root is None else f"{root}/{quote(self._name)}"
            try:
                return self._client.create_experiment(
                    self._name, location, tags=names.EXPERIMENT_TAGS
                )
            except MlflowException as error:
                if error.error_code != "RESOURCE_ALREADY_EXISTS":
                    raise
                experiment = self._client.get_experiment_by_name(self._name)
        if experiment is None or experiment.lifecycle_stage != "active":
            raise TrackingError(
                f"the experiment {self._name!r} at {self._store.public_uri} must not be deleted. "
                "Restore it (mlflow experiments restore) or give the sweep another name."
            )
        return str(experiment.experiment_id)


def attach(store: TrackingStore, run_id: str, folder: str, name: str, note: str) -> None:
    """Upload a folder as a run's artefacts below `name`, and set the description of the run."""
    configure_mlflow()
    client = open_client(store)
    client.log_artifacts(run_id, folder, name)
    client.set_tag(run_id, names.TAG_NOTE, note)


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


def _forget_repository(owner: str) -> None:
    """Free MLflow's upload client of a run or model, with its threads; it would cache 1,024."""
    getattr(utils, "_artifact_repos_cache", {}).pop(owner, None)
