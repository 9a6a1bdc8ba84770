"""`evaluate`: play episodes with the policy of a run, measure success, record video."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from music_rllib.command_line import Json, console_for, print_json
from music_rllib.errors import BadInputError

if TYPE_CHECKING:
    from music_rllib.policy import Policy
    from music_rllib.policy.rollout import EpisodeResult

EXAMPLES = """\
Examples:
  music-rllib evaluate finetune/q=1.5/seed0
      20 episodes of a run, by its label or enough parts of it
  music-rllib evaluate 4f2a09c1 --episodes 100 --json
      by its key or the beginning of its key
  music-rllib evaluate results/smoke/best --video push.gif
      the folder of a policy; record the first three episodes
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
    """Play deterministic episodes with the policy of a run, without starting Ray.

    The run may be finished or not. Prints the success rate with its 95% CI; records video if asked.
    """
    from music_rllib.policy import find_policy, load_policy, named_environment
    from music_rllib.policy.rollout import open_task, play
    from music_rllib.policy.video import check_video_file, film, write_video

    if video is not None:
        check_video_file(video)
    place = find_policy(run, storage)
    try:
        policy = load_policy(place, named_environment(env))
        if video is not None:  # first: it may fail, and many episodes take minutes
            title = f"{policy.task.name}  ·  {policy.variant}  ·  {policy.env_steps:,} env steps"
            frames, _ = film(policy, min(video_episodes, episodes), seed, title)
            write_video(video, frames)
        with closing(open_task(policy)) as task:
            results = list(play(policy, task, episodes, seed))
    except OSError as error:
        raise BadInputError(str(error)) from error
    document = _document(place, policy, results, seed) | {"video": str(video) if video else None}
    if json:
        print_json(document)
    else:
        _show(document)
    return 0


def _document(
    place: str, policy: Policy, results: list[EpisodeResult], seed: int
) -> dict[str, Any]:
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
    """The mean of the values that are not None; None if there are none."""
    numbers = [value for value in values if value is not None]
    return sum(numbers) / len(numbers) if numbers else None


def _interval(successes: list[bool]) -> list[float] | None:
    """The Clopper-Pearson 95% CI of the policy's success rate over starts and goals."""
    from music_rllib.results.statistics import clopper_pearson

    if not successes:
        return None
    lower, upper = clopper_pearson(sum(successes) / len(successes), len(successes))
    return [float(lower), float(upper)]


def _show(document: dict[str, Any]) -> None:
    from music_rllib.command_line import new_table, percent

    title = (
        f"{document['task']}, {document['variant']}, training seed {document['training_seed']}, "
        f"after {document['env_steps']:,} env steps"
    )
    table = new_table(title, ("", "mean", "95% CI"), left=[""])
    low, high = document["success_rate_interval"] or (None, None)
    interval = "-" if low is None else f"{percent(low)} to {percent(high)}"
    table.add_row("success at the last step", percent(document["success_rate"]), interval)
    table.add_row("success at any step", percent(document["success_rate_any_step"]), "")
    table.add_row("return of an episode", f"{document['episode_return']:.2f}", "")
    if document["object_displacement"] is not None:
        table.add_row("displacement of the object", f"{document['object_displacement']:.3f}", "")
    console = console_for()
    console.print(table)
    episodes = f"{document['episodes']} episodes, seed {document['seed']}: {document['run']}"
    console.print(episodes, soft_wrap=True)
    if document["video"]:
        console.print(f"Video: {document['video']}", soft_wrap=True)
