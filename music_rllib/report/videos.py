"""Videos in a report: for each q, an episode of the policy of its median run."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from music_rllib.envs.tasks import Task
from music_rllib.errors import first_line
from music_rllib.report.figures.choice import slug
from music_rllib.results.analysis import StageAnalysis
from music_rllib.results.data import RunRecord, Sweep
from music_rllib.store.storage import below

MOST = 6
"""Largest number of videos; if there would be more, only the first task has videos."""
SEED = 0
"""Seed of the episodes: every q has the same start and goal."""
_OUTCOMES = {True: "goal reached", False: "goal not reached", None: "the task declares no success"}


@dataclass(frozen=True, kw_only=True)
class Video:
    """An episode."""

    label: str
    """`q = 1.5 on FetchPush`."""
    caption: str
    file: str
    """Name of its file, which ends with `.mp4` or `.gif`."""
    data: bytes

    @property
    def is_gif(self) -> bool:
        return self.file.endswith(".gif")

    @property
    def uri(self) -> str:
        """The video as a data URI: the page must not fetch anything."""
        kind = "image/gif" if self.is_gif else "video/mp4"
        return f"data:{kind};base64,{base64.b64encode(self.data).decode()}"


@dataclass(frozen=True, kw_only=True)
class Videos:
    """The videos of a report, and the reason if some are missing."""

    videos: Sequence[Video] = ()
    missing: str | None = None


def make_videos(
    sweep: Sweep,
    analyses: Sequence[StageAnalysis],
    storage: str | None,
    environments: Sequence[Task] = (),
) -> Videos:
    """Record policies of the last of these stages on built-in tasks and the user's `environments`.

    It never fails: the result has the reason why a video is missing. An exported sweep has no
    `storage` with policies.
    """
    if storage is None:
        return Videos(missing="an exported sweep has no policies; report on the sweep itself")
    chosen = list(_median_runs(sweep, analyses))
    if not chosen:
        return Videos(missing="no run that was evaluated has finished")
    videos: list[Video] = []
    reasons: list[str] = []
    for q, run in chosen[:MOST]:
        try:
            videos.append(_record(storage, run, q, environments))
        # An environment may raise anything, and no video is worth losing the report.
        except Exception as error:
            reasons.append(f"{run.name}: {first_line(error)}")
    if left := ", ".join(f"q = {q}" for q, _ in chosen[MOST:]):
        reasons.append(f"{left}: a report has at most {MOST} videos")
    return Videos(videos=videos, missing=reasons[0] if reasons else None)


def _median_runs(
    sweep: Sweep, analyses: Sequence[StageAnalysis]
) -> Iterator[tuple[str, RunRecord]]:
    """For each task and q of the last stage, q and the median finished run by its final value."""
    if not analyses:
        return
    stage = analyses[-1].stage
    conditions = stage.compared or stage.conditions
    qs = list(dict.fromkeys(condition.entropic_index for condition in conditions))
    tasks = stage.tasks if len(qs) * len(stage.tasks) <= MOST else stage.tasks[:1]
    for task in tasks:
        for q in qs:
            runs = [run for one in conditions if one.entropic_index == q for run in one.runs]
            if (median := sweep.median_run(runs, task, sweep.primary_metric(task))) is not None:
                yield q or median.entropic_index, median


def _record(storage: str, run: RunRecord, q: str, environments: Sequence[Task]) -> Video:
    """An episode as an MP4, or as a GIF of ten times its size if there is no encoder."""
    from music_rllib.policy.policy import load_policy
    from music_rllib.policy.video import VideoError, film, write_video

    policy = load_policy(below(storage, f"nodes/{run.node_key}"), environments)
    frames, (episode,) = film(policy, 1, SEED, f"q = {q}  ·  {run.task}")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "video.mp4"
        try:
            write_video(path, frames)
        except VideoError:
            path = path.with_suffix(".gif")
            write_video(path, frames)
        return Video(
            label=f"q = {q} on {run.task}",
            caption=f"{_OUTCOMES[episode.success]}. {run.name}",
            file=f"{slug(f'q-{q}-{run.task}')}{path.suffix}",
            data=path.read_bytes(),
        )
