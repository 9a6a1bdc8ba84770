"""The tables of a search: ranking, importance of the settings, trials."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from music_rllib.experiment.plan import short
from music_rllib.results import statistics as st
from music_rllib.results.statistics import Estimate
from music_rllib.results.tables import DASH, UNFOLDED_ROWS, Entry, Share, Table

_TRIALS = {"judged": "scored", "pruned": "stopped early", "failed": "failed", "running": "running"}


def search_in_words(search: Entry) -> str:
    """A sentence with the search's mode, sampler, objectives and numbers of trials."""
    states = [trial["state"] for study in search["arms"] for trial in study["trials"]]
    counts = ", ".join(
        f"{states.count(state)} {word}" for state, word in _TRIALS.items() if state in states
    )
    aims = " and ".join(f"{aim['direction']} {aim['name']}" for aim in search["objectives"])
    start = f"{search['mode'].capitalize()} ({search['sampler']}): {aims}"
    return f"{start}; trials: {counts or 'none'}."


def search_tables(search: Entry) -> Iterator[Table]:
    """The ranking on fresh seeds, the importance of each setting, and every trial."""
    trials = [trial for study in search["arms"] for trial in study["trials"]]
    settings = list(dict.fromkeys(name for trial in trials for name in trial["values"]))
    aims = [aim["name"] for aim in search["objectives"]]
    yield Table(
        title="Ranking on fresh seeds",
        note="These settings were trained again with seeds that the search did not use, so that "
        "selection does not bias them. Last column: the probability that a run of the best "
        "setting ends better than a run of this one.",
        header=(
            *("Rank", "Trial", *settings, *aims, "Seeds"),
            *("In the search", "Probability that the best is better"),
        ),
        rows=[
            (
                place,
                _setting(row["trial"]),
                *(_setting(row["values"].get(name)) for name in settings),
                *_objectives(row, "fresh", len(aims)),
                len(row["scores"][0]) if row.get("scores") else None,
                f"failed: {row['failure']}"
                if "failure" in row
                else [value for value in row.get("searched") or () if value is not None],
                None if (better := row.get("best_is_better_with")) is None else Share(better),
            )
            for place, row in enumerate(search["ranking"] or (), start=1)
        ],
    )
    for study in search["arms"]:
        complete = sum(trial["state"] == "judged" for trial in study["trials"])
        shares = study["importance"] if complete >= st.IMPORTANCE_TRIALS else None
        values = ", ".join(f"{name} = {_setting(value)}" for name, value in study["values"].items())
        yield Table(
            title=f"Importance of the settings{values and f' at {values}'}",
            note="Share of the objective's variance over the trials (functional ANOVA).",
            header=("Setting", "Share"),
            rows=[(name, Share(share)) for name, share in (shares or {}).items()],
        )
    yield Table(
        title="Trials",
        note="Each trial on the seeds of the search: selection biases the best one upwards.",
        header=("Trial", *settings, "State", *aims, "Why it was stopped"),
        folded=len(trials) > UNFOLDED_ROWS,
        rows=[
            (
                trial["number"],
                *(_setting(trial["values"].get(name)) for name in settings),
                _TRIALS.get(trial["state"], trial["state"]),
                *_objectives(trial, "objective", len(aims)),
                trial["reason"] or "",
            )
            for trial in trials
            if trial["state"] != "waiting"
        ],
    )


def _setting(value: object) -> str:
    if value is None:
        return DASH
    return f"{value:.4g}" if isinstance(value, float) else short(value, "")


def _objectives(row: Entry, field: str, count: int) -> Iterator[Estimate | None]:
    """The estimate of each objective; None where it is unknown."""
    for aim in range(count):
        value = (row.get(field) or [None] * count)[aim]
        ends = (row.get("interval") or [(None, None)] * count)[aim]
        low, high = (np.array(np.nan if end is None else end) for end in ends)
        yield None if value is None else Estimate(value=np.array(value), lower=low, upper=high)
