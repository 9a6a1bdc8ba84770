"""`evaluate`: play episodes with a run's policy, count and film them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from music_rllib.errors import BadInputError
from music_rllib.sweep.cli_helpers import Commands, add_json, console_for, print_json

if TYPE_CHECKING:
    from rich.table import Table

    from music_rllib.policy.policy import Policy
    from music_rllib.policy.rollout import EpisodeResult

__all__ = ["register"]

EPILOG = """\
examples:
  python -m music_rllib.sweep evaluate finetune/q=1.5/FetchPush/seed=0
      20 episodes of a run, by its label; keys and their beginnings do as well
  python -m music_rllib.sweep evaluate results/nodes/4f2a09c1b7d35e8806aa --episodes 100 --json
      a finished node, or a checkpoint (results/work/KEY/NUMBER), by its folder
  python -m music_rllib.sweep evaluate 4f2a09 --storage s3://bucket/sweeps --video push.mp4
      and a film of the first three episodes
  python -m music_rllib.sweep evaluate policy --env my.yaml
      a policy for an environment of your own, as my.yaml declares it
  MLFLOW_TRACKING_URI=http://server:5000 python -m music_rllib.sweep evaluate models:/m-...
      a policy that was logged to MLflow
"""


def register(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "evaluate",
        help="play episodes with a run's policy, count and film them",
        description="Play deterministic episodes with the policy of a run, finished or not, and "
        "say how often it succeeds. Starts no Ray.",
        epilog=EPILOG,
    )
    parser.add_argument(
        "run",
        metavar="RUN",
        help="A run's label, key or folder; a checkpoint's folder; a policy's file; or an MLflow "
        "model (models:/..., runs:/...).",
    )
    parser.add_argument(
        "--storage",
        default="results",
        metavar="PLACE",
        help="Where labels and keys are looked up (default: results).",
    )
    parser.add_argument(
        "--env",
        metavar="ENV",
        help="The environment, where it is neither a built-in task's nor Gymnasium's own: a "
        "sweep's YAML file that declares it, or its id. What a policy's file says is not enough: "
        "making an environment runs its code.",
    )
    parser.add_argument(
        "--episodes", type=_positive, default=20, metavar="N", help="How many (default: 20)."
    )
    parser.add_argument(
        "--seed",
        type=_not_negative,
        default=0,
        metavar="N",
        help="Equal seeds give equal starts and goals (default: 0).",
    )
    parser.add_argument(
        "--video", type=Path, metavar="FILE", help="Film the first episodes, as .mp4 or .gif."
    )
    parser.add_argument(
        "--video-episodes",
        type=_positive,
        default=3,
        metavar="N",
        help="How many of them (default: 3).",
    )
    add_json(parser)
    parser.set_defaults(execute=_execute)


def _positive(text: str) -> int:
    number = _not_negative(text)
    if number == 0:
        raise argparse.ArgumentTypeError("must be > 0, got 0")
    return number


def _not_negative(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be a whole number >= 0, got {text!r}")
    return int(text)


def _execute(arguments: argparse.Namespace) -> int:
    from music_rllib.policy import PolicyError, find_policy, load_policy, named_environment
    from music_rllib.policy.video import VideoError

    if not arguments.storage:
        raise BadInputError("--storage must not be empty, got ''")
    _check_video(arguments.video)
    console = console_for(arguments)
    try:
        place = find_policy(arguments.run, arguments.storage)
        policy = load_policy(place, named_environment(arguments.env))
        results = _play(policy, arguments)
        if arguments.video:
            _film(policy, arguments)
    except (PolicyError, VideoError, OSError) as error:
        raise BadInputError(str(error)) from error
    document = _document(place, policy, results, arguments)
    if arguments.json:
        print_json(document)
        return 0
    console.print(_table(document))
    if arguments.video:
        console.print(f"Video: {arguments.video}", soft_wrap=True)
    return 0


def _check_video(path: Path | None) -> None:
    """Before minutes of episodes are played."""
    from music_rllib.policy.video import FORMATS

    if path is None:
        return
    if path.suffix.lower() not in FORMATS:
        raise BadInputError(f"--video must end in {' or '.join(FORMATS)}, got {str(path)!r}")
    if not path.absolute().parent.is_dir():
        raise BadInputError(f"--video must be in a folder that exists, got {str(path)!r}")


def _play(policy: Policy, arguments: argparse.Namespace) -> list[EpisodeResult]:
    from music_rllib.policy.rollout import open_task, play

    env = open_task(policy)
    try:
        return list(play(policy, env, arguments.episodes, arguments.seed))
    finally:
        env.close()


def _film(policy: Policy, arguments: argparse.Namespace) -> None:
    from music_rllib.policy.video import film, write_video

    episodes = min(arguments.video_episodes, arguments.episodes)
    title = f"{policy.task.name}  ·  {policy.variant}  ·  {policy.env_steps:,} env steps"
    frames, _ = film(policy, episodes, arguments.seed, title)
    write_video(arguments.video, frames)


def _document(
    place: str, policy: Policy, results: list[EpisodeResult], arguments: argparse.Namespace
) -> dict[str, Any]:
    from dataclasses import asdict

    success = [result.success for result in results if result.success is not None]
    some = [result.success_any_step for result in results if result.success_any_step is not None]
    moved = [r.object_displacement for r in results if r.object_displacement is not None]
    return {
        "run": place,
        "node_key": policy.node_key,
        "task": policy.task.name,
        "env_id": policy.environment.env_id if policy.environment else None,
        "variant": policy.variant,
        "training_seed": policy.seed,
        "env_steps": policy.env_steps,
        "episodes": len(results),
        "seed": arguments.seed,
        "success_rate": _mean(success),
        "success_rate_interval": _interval(success),
        "success_rate_any_step": _mean(some),
        "episode_return": _mean([result.episode_return for result in results]),
        "object_displacement": _mean(moved),
        "video": str(arguments.video) if arguments.video else None,
        "results": [asdict(result) for result in results],
    }


def _mean(values: list[Any]) -> float | None:
    return sum(values) / len(values) if values else None


def _interval(successes: list[bool]) -> list[float] | None:
    """Clopper and Pearson's 95 % interval: of this policy, over starts and goals."""
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
