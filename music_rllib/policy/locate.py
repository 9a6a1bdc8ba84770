"""Finds the policy that a user names by key, label or place, and the environment."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Iterator

from music_rllib.config.load import declared_tasks
from music_rllib.envs.tasks import Task
from music_rllib.labels import label_matches
from music_rllib.policy.policy import PolicyError
from music_rllib.redaction import redact
from music_rllib.store.sealed import SealedFolders
from music_rllib.store.storage import StorageFolder, below, open_storage, resolve_storage

_SHORTEST_KEY = 4
"""Characters of a key's beginning that are enough to name it."""
_LISTED = 8
"""Runs that a message lists."""


def find_policy(wanted: str, storage: str) -> str:
    """The place from which `load_policy` loads the policy that a user names.

    Args:
        wanted: a place (folder, file, URI), which is returned as it is; the key of a run or its
            beginning; or a run's label or enough parts of it (`q=1.5/seed0`).
        storage: the sweeps' storage, a folder or a URI, in which keys and labels are looked up.

    Returns:
        The folder of a finished run, or the newest checkpoint of an unfinished one.

    Raises:
        PolicyError: no run fits, or several do; the message lists them.
    """
    if "://" in wanted or wanted.startswith(("models:/", "runs:/")) or os.path.lexists(wanted):
        return wanted
    storage = resolve_storage(storage)[0]
    try:
        return _find(wanted, storage)
    except OSError as error:
        raise PolicyError(
            f"--storage must be a place that can be read, got {redact(storage)}: {error}"
        ) from error


def _find(wanted: str, storage: str) -> str:
    root = open_storage(storage)
    labels: dict[str, list[str]] = {}
    for key, label in _labels(root):
        labels.setdefault(key, []).append(label)  # sweeps that share a run label it differently
    nodes = SealedFolders(root / "nodes")
    finished = nodes.names()
    unfinished = [key for key in sorted((root / "work").folders()) if key not in finished]
    keys = _matching(wanted, [*finished, *unfinished], labels)
    if not keys:
        known = [labels.get(key, [key])[0] for key in finished][:_LISTED]
        there = f"finished there: {', '.join(known)}" if known else "no run is finished there"
        raise PolicyError(
            f"{wanted!r} must be a folder, or the key or label of a run in {storage}; {there}"
        )
    if len(keys) > 1:
        fits = [f"{labels[key][0]} ({key[:8]})" if key in labels else key for key in keys[:_LISTED]]
        more = f" and {len(keys) - _LISTED} more" if len(keys) > _LISTED else ""
        raise PolicyError(
            f"{wanted!r} must mean one run, it fits {', '.join(fits)}{more}; say more of its "
            "label, or its key"
        )
    if keys[0] in finished:
        return below(storage, f"nodes/{keys[0]}")
    checkpoints = SealedFolders(root / "work" / keys[0]).names()
    if not checkpoints:
        raise PolicyError(f"{wanted!r} must have a checkpoint, it has none in {storage} yet")
    return below(storage, f"work/{keys[0]}/{checkpoints[-1]}")


def named_environment(env: str | None) -> str | tuple[Task, ...]:
    """The environment of `--env` for `load_policy`: an id, or the tasks of a sweep's YAML file.

    Raises:
        ConfigError: that file can't be read, or is wrong.
    """
    if env is None:
        return ()
    return declared_tasks(env) if env.endswith((".yaml", ".yml")) else env


def _matching(wanted: str, keys: list[str], labels: dict[str, list[str]]) -> list[str]:
    by_label = [key for key in keys if wanted in labels.get(key, ())]
    if by_label:
        return by_label
    if wanted in keys:
        return [wanted]
    by_prefix = [key for key in keys if key.startswith(wanted)]
    if len(wanted) >= _SHORTEST_KEY and by_prefix:
        return by_prefix
    return [key for key in keys if any(label_matches(wanted, one) for one in labels.get(key, ()))]


def _labels(storage: StorageFolder) -> Iterator[tuple[str, str]]:
    """Key and label of every run in the plans of the storage's sweeps."""
    for name in sorted(storage.having("plan.json", storage.folders())):
        try:
            nodes = json.loads((storage / name).read("plan.json") or b"")["nodes"]
            labels = [(str(node["key"]), str(node["label"])) for node in nodes]
        except (ValueError, TypeError, LookupError, RecursionError) as error:
            plan = f"{storage.path}/{name}/plan.json"
            warnings.warn(f"{plan} is damaged, its labels are not known: {error!r}", stacklevel=2)
            continue
        yield from labels
