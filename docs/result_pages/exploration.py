"""What q does to exploration: the policy's entropy and the object's displacement at first."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from docs.result_pages.summary import STUDIES, between_q, complete_studies
from docs.result_pages.words import row, rule
from music_rllib import names
from music_rllib.results.claims import contrast
from music_rllib.results.conditions import Condition
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import Array


def exploration_table() -> Iterator[str]:
    """One row per study of q: means over the seeds, and paired differences from q = 1."""
    yield row(
        "task",
        "setting",
        "Shannon entropy (nats), q = 1, 1.5, 2",
        "object displacement (cm), q = 1, 1.5, 2",
        "q = 1.5 minus q = 1 (cm)",
        "q = 2 minus q = 1 (cm)",
    )
    yield rule(6)
    for sweep, study in complete_studies():
        pairs = [pair for claim in between_q(study.planned) for pair in claim.pairs]
        by_q = {one.entropic_index: one for pair in pairs for one in pair}
        if not by_q:
            continue
        conditions = [by_q[q] for q in ("1", "1.5", "2")]
        entropies = [_early(sweep, one, names.SHANNON_ENTROPY).mean() for one in conditions]
        moved = [100 * _early(sweep, one, names.TRAIN_DISPLACEMENT) for one in conditions]
        gaps = [contrast(one, moved[0], paired=True).difference for one in moved[1:]]
        yield row(
            study.planned[0].task,
            STUDIES[sweep.name],
            ", ".join(f"{entropy:.2f}" for entropy in entropies),
            ", ".join(f"{one.mean():.1f}" for one in moved),
            *(f"{g.value:+.1f} (95% CI {g.lower:.1f} to {g.upper:.1f})" for g in gaps),
        )


def _early(sweep: Sweep, condition: Condition, metric: str) -> Array:
    """`[seeds]`, in the order of the seeds."""
    of_seed = {sweep.runs[run].seed: sweep.early(run, metric) for run in condition.runs}
    return np.array([of_seed[seed] for seed in sorted(of_seed)], float)
