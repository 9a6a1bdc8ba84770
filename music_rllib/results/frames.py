"""Load a sweep as pandas frames, with the same columns from a storage and from an export."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from music_rllib import names
from music_rllib.results.analysis import analyse
from music_rllib.results.archive import metrics_table
from music_rllib.results.conditions import ALL_TASKS, find_stages
from music_rllib.results.data import Sweep
from music_rllib.results.read import read_sweep

if TYPE_CHECKING:
    from collections.abc import Iterator


_SETTINGS = {
    "q": (names.SETTING_ENTROPIC_INDEX, "tac.entropic_index", names.TAG_ENTROPIC_INDEX),
    "alpha": (names.SETTING_ALPHA, "tac.alpha", names.TAG_ALPHA),
    "mi_reward_weight": (
        names.SETTING_MI_REWARD_WEIGHT,
        "music.mi_reward_weight",
        names.TAG_MI_REWARD_WEIGHT,
    ),
}
"""Settings that can be schedules: metric with the value at step 0, param, and tag with the words,
whose numbers are rounded."""
_RUN_COLUMNS = {
    **dict.fromkeys(("name", "stage", "variant", "task", "condition"), "str"),
    "seed": "Int64",
    **dict.fromkeys(_SETTINGS, "float64"),
    "status": "str",
    **dict.fromkeys(("started", "ended"), "datetime64[ms, UTC]"),
    **dict.fromkeys(("last_step", "budget"), "Int64"),
    "primary_metric": "str",
    **dict.fromkeys(("score", "shannon_entropy", "tsallis_entropy"), "float64"),
    **dict.fromkeys(("source", "failure"), "str"),
}
_CURVE_COLUMNS = {
    **dict.fromkeys(("key", "metric"), "str"),
    "env_steps": "int64",
    "value": "float64",
    "time": "datetime64[ms, UTC]",
}
_ENTROPIES = ("shannon_entropy", "tsallis_entropy")
_CONDITION_COLUMNS = {
    **dict.fromkeys(("stage", "variant", "task", "condition"), "str"),
    "q": "float64",
    "metric": "str",
    **dict.fromkeys(("seeds", "runs"), "int64"),
    **dict.fromkeys(("mean", "lower", "upper"), "float64"),
    **{f"{name}{end}": "float64" for name in _ENTROPIES for end in ("", "_lower", "_upper")},
}


@dataclass(frozen=True, kw_only=True)
class Frames:
    """Frames of one sweep; docs/reports.md describes the columns."""

    name: str
    runs: pd.DataFrame = field(repr=False)
    """One row per run, indexed by `key`: names, settings, last values."""
    curves: pd.DataFrame = field(repr=False)
    """One row per value of a metric: `key`, `metric`, `env_steps`, `value`, `time`."""
    conditions: pd.DataFrame = field(repr=False)
    """One row per condition and task: the mean over the seeds with its 95% CI."""
    earlier: str | None = None
    """A sentence about runs of earlier versions of the sweep, which are not in the frames."""


def load_sweep(place: str | Path, *, storage: str | Path | None = None) -> Frames:
    """Load the runs, curves and conditions of a sweep as pandas frames.

    Args:
        place: A sweep's folder in a storage (`results/my_sweep`, `s3://bucket/sweeps/my_sweep`), a
            folder that `report --export` wrote, or a sweep's name.
        storage: Storage of a sweep that is given by its name; None: `results`.

    Raises:
        BadInputError: There is no such sweep, or the folder holds something else.
        StorageError: The storage can't be read, or finished runs in it are damaged.
    """
    within = None if storage is None else str(storage)
    return frames_of(read_sweep(str(place), within).sweep)


def frames_of(sweep: Sweep) -> Frames:
    """Frames of a sweep that was read with all its metrics."""
    keys = [run.node_key or run.run_id for run in sweep.runs]
    return Frames(
        name=sweep.name,
        runs=_runs(sweep, keys),
        curves=_curves(sweep, keys),
        conditions=_frame(list(_conditions(sweep)), _CONDITION_COLUMNS),
        earlier=sweep.earlier,
    )


def _runs(sweep: Sweep, keys: list[str]) -> pd.DataFrame:
    labels = {
        run: condition.label
        for stage in find_stages(sweep)
        for condition in stage.conditions
        for run in condition.runs
    }
    rows = []
    for position, run in enumerate(sweep.runs):
        metric = sweep.primary_metric(run.task)
        rows.append(
            {
                **{name: getattr(run, name) for name in ("name", "stage", "variant", "task")},
                "condition": labels[position],
                "seed": run.seed or None,
                **{name: _at_start(sweep, position, name) for name in _SETTINGS},
                "status": run.status,
                "started": run.started,
                "ended": run.ended,
                "last_step": sweep.last_step(position),
                "budget": run.budget,
                "primary_metric": metric,
                "score": sweep.final(position, metric) if run.is_finished else None,
                "shannon_entropy": sweep.final(position, names.SHANNON_ENTROPY),
                "tsallis_entropy": sweep.final(position, names.ENTROPY),
                "source": run.tags.get(names.TAG_SOURCE_NODE),
                "failure": run.failure,
            }
        )
    frame = _frame(rows, _RUN_COLUMNS)
    settings = pd.DataFrame([dict(run.params) for run in sweep.runs], index=frame.index)
    # These params already have a column.
    settings = settings.drop(columns=["env_steps", "seed", "variant"], errors="ignore")
    frame = pd.concat([frame, settings.sort_index(axis=1).apply(_typed)], axis=1)
    return frame.set_index(pd.Index(keys, name="key", dtype="str"))


def _at_start(sweep: Sweep, run: int, setting: str) -> float | None:
    """A setting at step 0; of a run without a report as its params, or else its words, have it."""
    metric, param, tag = _SETTINGS[setting]
    value, record = sweep.final(run, metric), sweep.runs[run]
    if value is not None:
        return value
    for name in (param, f"{param}.value"):
        for part in ("", ".initial", ".start"):
            with suppress(KeyError, ValueError):
                return float(record.params[f"{name}{part}"])
        with suppress(LookupError, TypeError, ValueError):
            # Until the first measurement, an entropy counts as the highest of the points.
            falls = record.params.get(f"{name}.follows") == "shannon_entropy"
            return float(json.loads(record.params[f"{name}.points"])[-1 if falls else 0][1])
    with suppress(ValueError):
        return float(record.tags.get(tag, "").split(" ")[0])
    return None


def _typed(texts: pd.Series[Any]) -> Any:
    """A column of numbers if all texts are numbers, else of texts."""
    try:
        return pd.to_numeric(texts)
    except ValueError:
        return texts.astype("str")


def _curves(sweep: Sweep, keys: list[str]) -> pd.DataFrame:
    values = metrics_table(sweep).to_pandas().rename(columns={"time_ms": "time"})
    values["key"] = pd.Series(keys, dtype="str").take(values["run"]).array
    return _frame(values, _CURVE_COLUMNS)


def _conditions(sweep: Sweep) -> Iterator[dict[str, Any]]:
    for analysis in analyse(sweep):
        for scope in analysis.scopes:
            for final in scope.finals:
                condition = final.condition
                own = [r for r in condition.runs if scope.name in (ALL_TASKS, sweep.runs[r].task)]
                if scope.name == ALL_TASKS and not condition.entropic_index:
                    own = []  # each task has its own q
                at_start = (_at_start(sweep, run, "q") for run in own)
                row = {
                    "stage": analysis.stage.name,
                    "variant": analysis.stage.variant,
                    "task": scope.name,
                    "condition": condition.label,
                    "q": next(filter(None, at_start), None),
                    "metric": scope.metric,
                    "seeds": final.seeds,
                    "runs": final.runs,
                    "mean": final.value,
                    "lower": float(final.estimate.lower),
                    "upper": float(final.estimate.upper),
                }
                entropies = analysis.entropies[scope.name, condition]
                for name, entropy in zip(_ENTROPIES, entropies, strict=True):
                    if entropy is not None:
                        row[name] = float(entropy.value)
                        row[f"{name}_lower"] = float(entropy.lower)
                        row[f"{name}_upper"] = float(entropy.upper)
                yield row


def _frame(rows: Any, columns: dict[str, str]) -> pd.DataFrame:
    """A frame with these columns and types, even without rows; times are in ms."""
    return pd.DataFrame(rows, columns=list(columns)).astype(columns)
