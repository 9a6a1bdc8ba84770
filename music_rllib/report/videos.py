"""Videos in a report: for each q an episode of the policy that is logged with its median run."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from music_rllib.envs.tasks import Task
from music_rllib.report.figures.choice import slug
from music_rllib.results.analysis import StageAnalysis
from music_rllib.results.data import ReportError, Sweep
from music_rllib.results.from_mlflow import download_policy
from music_rllib.tracking.store import TrackingStore

if TYPE_CHECKING:
    from music_rllib.policy.policy import Policy

__all__ = ["Film", "Films", "make_films"]

MOST = 6
"""Where there would be more, only the first task is filmed."""


@dataclass(frozen=True, kw_only=True)
class Film:
    """One episode."""

    entropic_index: str
    task: str
    run: str
    """The run's name."""
    success: bool | None
    ending: str
    """`mp4` or `gif`."""
    data: bytes

    @property
    def name(self) -> str:
        """Of its file."""
        return f"{slug(f'q-{self.entropic_index}-{self.task}')}.{self.ending}"

    @property
    def uri(self) -> str:
        """For the page, which fetches nothing."""
        kind = "video/mp4" if self.ending == "mp4" else "image/gif"
        return f"data:{kind};base64,{base64.b64encode(self.data).decode()}"


@dataclass(frozen=True, kw_only=True)
class Films:
    """The videos of a report, and why there are not more."""

    films: Sequence[Film] = ()
    why_not: str | None = None


def make_films(
    sweep: Sweep,
    analyses: Sequence[StageAnalysis],
    store: TrackingStore | None,
    seed: int,
    environments: Sequence[Task] = (),
) -> Films:
    """Film the last stage's policies. Never fails: what can't be is said.

    Played is in environments that are known, and in `environments`: those of the user.
    """
    if store is None:
        return Films(why_not="an exported sweep has no policies; report on the sweep in MLflow")
    wanted = list(_wanted(sweep, analyses))
    if not wanted:
        return Films(why_not="no run that was evaluated has finished")
    films: list[Film] = []
    reasons: list[str] = []
    for q, task, run in wanted:
        try:
            with TemporaryDirectory() as folder:
                policy = _policy(sweep, store, run, Path(folder), environments)
                films.append(_film(policy, sweep.runs[run].name, q, task, seed, Path(folder)))
        # An environment may raise anything, and no video is worth losing the report.
        except Exception as error:
            reasons.append(f"{sweep.runs[run].name}: {str(error).splitlines()[0]}")
    return Films(films=films, why_not=reasons[0] if reasons else None)


def _wanted(sweep: Sweep, analyses: Sequence[StageAnalysis]) -> Iterator[tuple[str, str, int]]:
    """(q, task, run): of each q's finished runs on a task the one in the middle."""
    if not analyses:
        return
    stage = analyses[-1].stage
    qs = list(dict.fromkeys(condition.entropic_index for condition in stage.conditions))
    tasks = stage.tasks if len(qs) * len(stage.tasks) <= MOST else stage.tasks[:1]
    for task in tasks:
        for q in qs[:MOST]:
            rated = [
                (rate, run)
                for condition in stage.conditions
                if condition.entropic_index == q
                for run in condition.runs
                if sweep.runs[run].task == task
                and sweep.runs[run].status == "FINISHED"
                and (rate := sweep.final(run, sweep.primary_metric(task))) is not None
            ]
            if rated:
                yield q, task, sorted(rated)[len(rated) // 2][1]


def _film(policy: Policy, run: str, q: str, task: str, seed: int, folder: Path) -> Film:
    from music_rllib.policy.video import film

    frames, (result,) = film(policy, 1, seed, f"q = {q}  ·  {task}")
    ending, data = _encoded(frames, folder)
    return Film(
        entropic_index=q,
        task=task,
        run=run,
        success=result.success,
        ending=ending,
        data=data,
    )


def _policy(
    sweep: Sweep, store: TrackingStore, run: int, folder: Path, environments: Sequence[Task]
) -> Policy:
    from music_rllib.policy.policy import load_policy

    file = download_policy(store, sweep.experiment_id, sweep.runs[run].run_id, folder)
    if file is None:
        raise ReportError("no policy is logged with it")
    return load_policy(file, environments)


def _encoded(frames: Sequence[object], folder: Path) -> tuple[str, bytes]:
    """As MP4, which is a tenth of a GIF, where there is an encoder."""
    from music_rllib.policy.video import VideoError, write_video

    try:
        write_video(folder / "film.mp4", frames)  # type: ignore[arg-type]
    except VideoError:
        write_video(folder / "film.gif", frames)  # type: ignore[arg-type]
        return "gif", (folder / "film.gif").read_bytes()
    return "mp4", (folder / "film.mp4").read_bytes()
