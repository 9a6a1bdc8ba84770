"""`best`: export the winning policy with its configuration."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from music_rllib.sweep.cli_helpers import Commands, add_json, add_place, console_for, print_json

__all__ = ["register"]

EPILOG = """\
examples:
  python -m music_rllib.sweep best results/smoke
      into results/smoke/best
  python -m music_rllib.sweep best s3://bucket/sweeps/search --output policy
      from a cluster's storage into a local folder
  python -m music_rllib.sweep evaluate policy --episodes 100
"""


def register(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "best",
        help="export the winning policy with its configuration",
        description="Export the policy of the best condition, with its configuration and how it "
        "was chosen. After a search that is the first of the ranking on fresh seeds, and the best "
        "judged trial where there is no ranking yet.",
        epilog=EPILOG,
    )
    add_place(parser)
    parser.add_argument("--stage", help="Of which stage; the last one by default.")
    parser.add_argument(
        "--output",
        type=Path,
        metavar="FOLDER",
        help="Where to put it: 'best' in the sweep's folder by default. Of several tasks each has "
        "a folder of its own in it.",
    )
    add_json(parser)
    parser.set_defaults(execute=_execute)


def _execute(arguments: argparse.Namespace) -> int:
    from music_rllib.experiment.location import find_sweep
    from music_rllib.sweep.export import export_best

    found = find_sweep(arguments.sweep, arguments.storage)
    sweep = found.open()
    chosen = export_best(sweep, arguments.stage, arguments.output or sweep.folder / "best")
    if arguments.json:
        print_json(chosen)
        return 0
    console = console_for(arguments)
    console.print(chosen["why"], soft_wrap=True)
    if chosen["entropies"]:
        console.print(_entropies(chosen["entropies"]), soft_wrap=True)
    for policy in chosen["policies"]:
        console.print(f"{policy['task']}: {policy['folder']}", soft_wrap=True)
    return 0


def _entropies(found: dict[str, Any]) -> str:
    from music_rllib import names
    from music_rllib.results.comparison import with_interval

    words = {names.SHANNON_ENTROPY: "Shannon entropy (nats)", names.ENTROPY: "S_q"}
    texts = (
        f"{words[metric]} {with_interval(one['value'], one['interval'])}"
        for metric, one in found.items()
    )
    return f"its policies at the end: {', '.join(texts)}"
