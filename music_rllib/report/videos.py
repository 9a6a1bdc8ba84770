"""Videos in a report: for each q an episode of the policy of its median run."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from music_rllib.envs.tasks import Task
from music_rllib.errors import first_line
from music_rllib.report.figures.choice import slug
from music_rllib.results.analysis import StageAnalysis
from music_rllib.results.data import RunRecord, Sweep
from music_rllib.store.storage import below

if TYPE_CHECKING:
    from music_rllib.policy.policy import Policy

MOST = 6
"""Largest number of videos; if there would be more, only the first task is filmed."""


@dataclass(frozen=True, kw_only=True)
class Film:
    """One filmed episode."""

    entropic_index: str
    task: str
    run: str
    """Name of the run."""
    success: bool | None
    ending: str
    """`mp4` or `gif`."""
    data: bytes

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"{slug(f'q-{self.entropic_index}-{self.task}')}.{self.ending}"

    @property
    def uri(self) -> str:
        """The video as a data URI, as the page fetches nothing."""
        kind = "video/mp4" if self.ending == "mp4" else "image/gif"
        return f"data:{kind};base64,{base64.b64encode(self.data).decode()}"


@dataclass(frozen=True, kw_only=True)
class Films:
    """The videos of a report, and the reason if some are missing."""

    films: Sequence[Film] = ()
    why_not: str | None = None


def make_films(
    sweep: Sweep,
    analyses: Sequence[StageAnalysis],
    storage: str | None,
    seed: int,
    environments: Sequence[Task] = (),
) -> Films:
    """Film the last stage's policies on the built-in tasks and in the user's `environments`.

    It never fails: the result says why a video is missing.

    Args:
        sweep: the sweep.
        analyses: the statistics of its stages.
        storage: the storage that has the policies; None for an exported sweep.
        seed: the seed of the episodes.
        environments: tasks of the user.
    """
    if storage is None:
        return Films(why_not="an exported sweep has no policies; report on the sweep itself")
    chosen = list(_median_runs(sweep, analyses))
    if not chosen:
        return Films(why_not="no run that was evaluated has finished")
    films: list[Film] = []
    reasons: list[str] = []
    for q, run in chosen:
        try:
            with TemporaryDirectory() as folder:
                policy = _policy(storage, run, environments)
                films.append(_film(policy, run, q, seed, Path(folder)))
        # An environment may raise anything, and no video is worth losing the report.
        except Exception as error:
            reasons.append(f"{run.name}: {first_line(error)}")
    return Films(films=films, why_not=reasons[0] if reasons else None)


def _median_runs(
    sweep: Sweep, analyses: Sequence[StageAnalysis]
) -> Iterator[tuple[str, RunRecord]]:
    """For each task and q of the last stage, q and the median finished run by its final value."""
    if not analyses:
        return
    stage = analyses[-1].stage
    # Of a search the chosen ones; its trials may be anything.
    conditions = stage.compared or stage.conditions
    qs = list(dict.fromkeys(condition.entropic_index for condition in conditions))
    tasks = stage.tasks if len(qs) * len(stage.tasks) <= MOST else stage.tasks[:1]
    for task in tasks:
        for q in qs[:MOST]:
            rated = [
                (rate, run)
                for condition in conditions
                if condition.entropic_index == q
                for run in condition.runs
                if sweep.runs[run].task == task
                and sweep.runs[run].status == "FINISHED"
                and (rate := sweep.final(run, sweep.primary_metric(task))) is not None
            ]
            if rated:
                _, median = sorted(rated)[len(rated) // 2]
                yield q, sweep.runs[median]


def _policy(storage: str, run: RunRecord, environments: Sequence[Task]) -> Policy:
    from music_rllib.policy.policy import load_policy

    return load_policy(below(storage, f"nodes/{run.node_key}"), environments)


def _film(policy: Policy, run: RunRecord, q: str, seed: int, folder: Path) -> Film:
    """An episode as an MP4, or as a GIF of ten times its size where there is no encoder."""
    from music_rllib.policy.video import VideoError, film, write_video

    frames, (episode,) = film(policy, 1, seed, f"q = {q}  ·  {run.task}")
    video = folder / "film.mp4"
    try:
        write_video(video, frames)
    except VideoError:
        video = folder / "film.gif"
        write_video(video, frames)
    return Film(
        entropic_index=q,
        task=run.task,
        run=run.name,
        success=episode.success,
        ending=video.suffix.removeprefix("."),
        data=video.read_bytes(),
    )
