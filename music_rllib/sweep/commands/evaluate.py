"""`evaluate`: play episodes with the policy of a run, measure success, record video."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from music_rllib.command_line import Json, console_for, print_json
from music_rllib.errors import BadInputError

if TYPE_CHECKING:
    from rich.table import Table

    from music_rllib.policy.policy import Policy
    from music_rllib.policy.rollout import EpisodeResult

EXAMPLES = """\
Examples:
  music-rllib evaluate finetune/q=1.5/seed0
      20 episodes of a run, by its label or the parts of it that tell which
  music-rllib evaluate 4f2a09c1 --episodes 100 --json
      by its key or the key's beginning
  music-rllib evaluate results/smoke/best --video push.gif
      a policy's folder; and a film of the first three episodes
  music-rllib evaluate q=2/seed1 --storage s3://bucket/sweeps
  music-rllib evaluate policy --env my.yaml
      a policy for an environment of your own, as my.yaml declares it
  MLFLOW_TRACKING_URI=http://server:5000 music-rllib evaluate models:/m-1234
      a policy that was logged to MLflow
"""


def evaluate(
    run: Annotated[
        str,
        typer.Argument(
            metavar="RUN",
            help="Label, key or folder of a run; folder of a checkpoint; policy file; or MLflow "
            "model (models:/..., runs:/...).",
        ),
    ],
    storage: Annotated[
        str, typer.Option(metavar="PLACE", help="Storage in which labels and keys are looked up.")
    ] = "results",
    env: Annotated[
        str | None,
        typer.Option(
            metavar="ENV",
            help="Environment of a task that is neither built in nor part of Gymnasium: the sweep "
            "file that declares it, or its id. The policy file alone is not trusted, because "
            "making an environment runs its code.",
        ),
    ] = None,
    episodes: Annotated[int, typer.Option(metavar="N", min=1, help="Number of episodes.")] = 20,
    seed: Annotated[
        int, typer.Option(metavar="N", min=0, help="Equal seeds give equal starts and goals.")
    ] = 0,
    video: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Record the first episodes as .mp4 or .gif."),
    ] = None,
    video_episodes: Annotated[
        int, typer.Option(metavar="N", min=1, help="Number of recorded episodes.")
    ] = 3,
    json: Json = False,
) -> int:
    """Play episodes with the policy of a run, measure success, record video.

    Deterministic ones; the run may be finished or not. Starts no Ray.
    """
    from music_rllib.policy import find_policy, load_policy, named_environment

    if not storage:
        raise BadInputError("--storage must not be empty, got ''")
    _check_video(video)
    place = find_policy(run, storage)
    try:
        policy = load_policy(place, named_environment(env))
        results = _play(policy, episodes, seed)
        if video:
            _film(policy, video, min(video_episodes, episodes), seed)
    except OSError as error:
        raise BadInputError(str(error)) from error
    document = _document(place, policy, results, seed) | {"video": str(video) if video else None}
    if json:
        print_json(document)
        return 0
    console = console_for()
    console.print(_table(document))
    if video:
        console.print(f"Video: {video}", soft_wrap=True)
    return 0


def _check_video(path: Path | None) -> None:
    """Refuse a file that can't be written, before minutes of episodes are played."""
    from music_rllib.policy.video import FORMATS

    if path is None:
        return
    if path.suffix.lower() not in FORMATS:
        raise BadInputError(f"--video must end in {' or '.join(FORMATS)}, got {str(path)!r}")
    if not path.absolute().parent.is_dir():
        raise BadInputError(f"--video must be in a folder that exists, got {str(path)!r}")


def _play(policy: Policy, episodes: int, seed: int) -> list[EpisodeResult]:
    from music_rllib.policy.rollout import open_task, play

    with closing(open_task(policy)) as env:
        return list(play(policy, env, episodes, seed))


def _film(policy: Policy, path: Path, episodes: int, seed: int) -> None:
    from music_rllib.policy.video import film, write_video

    title = f"{policy.task.name}  ·  {policy.variant}  ·  {policy.env_steps:,} env steps"
    frames, _ = film(policy, episodes, seed, title)
    write_video(path, frames)


def _document(
    place: str, policy: Policy, results: list[EpisodeResult], seed: int
) -> dict[str, Any]:
    from dataclasses import asdict

    from music_rllib.redaction import redact

    successes = [result.success for result in results if result.success is not None]
    return {
        "run": redact(place),
        "node_key": policy.node_key,
        "task": policy.task.name,
        "env_id": policy.environment.env_id if policy.environment else None,
        "variant": policy.variant,
        "training_seed": policy.seed,
        "env_steps": policy.env_steps,
        "episodes": len(results),
        "seed": seed,
        "success_rate": _mean(successes),
        "success_rate_interval": _interval(successes),
        "success_rate_any_step": _mean(result.success_any_step for result in results),
        "episode_return": _mean(result.episode_return for result in results),
        "object_displacement": _mean(result.object_displacement for result in results),
        "results": [asdict(result) for result in results],
    }


def _mean(values: Iterable[float | None]) -> float | None:
    """The mean of those values that are there; None where there are none."""
    numbers = [value for value in values if value is not None]
    return sum(numbers) / len(numbers) if numbers else None


def _interval(successes: list[bool]) -> list[float] | None:
    """Clopper and Pearson's 95 % interval of the policy's success rate over starts and goals."""
    from music_rllib.results.statistics import clopper_pearson

    if not successes:
        return None
    lower, upper = clopper_pearson(sum(successes) / len(successes), len(successes))
    return [float(lower), float(upper)]


def _table(document: dict[str, Any]) -> Table:
    from rich.table import Table

    table = Table(
        title=f"{document['task']}, {document['variant']}, training seed "
        f"{document['training_seed']}, after {document['env_steps']:,} env steps",
        title_justify="left",
        caption=f"{document['episodes']} episodes, seed {document['seed']}: {document['run']}",
        caption_justify="left",
    )
    for name in ("", "mean", "95 % interval"):
        table.add_column(name, justify="left" if not name else "right")
    interval = document["success_rate_interval"]
    table.add_row(
        "success at the last step",
        _percent(document["success_rate"]),
        "-" if interval is None else f"{interval[0]:.0%} to {interval[1]:.0%}",
    )
    table.add_row("success at any step", _percent(document["success_rate_any_step"]), "")
    table.add_row("return of an episode", f"{document['episode_return']:.2f}", "")
    if document["object_displacement"] is not None:
        table.add_row("object's displacement", f"{document['object_displacement']:.3f}", "")
    return table


def _percent(rate: float | None) -> str:
    return "-" if rate is None else f"{rate:.0%}"
