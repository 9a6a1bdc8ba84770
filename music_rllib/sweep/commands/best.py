"""`best`: export the winning policy with its configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from music_rllib.command_line import Json, console_for, print_json
from music_rllib.sweep.commands.arguments import Place, StageName, Storage

EXAMPLES = """\
Examples:
  music-rllib best results/smoke
      export to results/smoke/best
  music-rllib best s3://bucket/sweeps/search --output policy
      export from a bucket to a local folder
  music-rllib evaluate policy --episodes 100
"""


def best(
    sweep: Place,
    storage: Storage = None,
    stage: StageName = None,
    output: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Target folder; by default 'best' in the folder of the sweep. With several "
            "tasks, each has its own folder inside.",
        ),
    ] = None,
    json: Json = False,
) -> int:
    """Export the best policy with its configuration, and print how it was chosen.

    After a search, the best policy is the first of the ranking on fresh seeds; before the ranking
    is complete, it is the best trial.
    """
    from music_rllib.experiment.location import find_sweep
    from music_rllib.store.storage import sweep_folder
    from music_rllib.sweep.export import export_best

    found = find_sweep(sweep, storage)
    folder = output or sweep_folder(found.storage, found.name) / "best"
    chosen = export_best(found, stage, folder)
    if json:
        print_json(chosen)
        return 0
    console = console_for()
    console.print(chosen["why"], soft_wrap=True)
    if chosen["entropies"]:
        console.print(_entropies_text(chosen["entropies"]), soft_wrap=True)
    if (earlier := found.earlier()) is not None:
        console.print(earlier, soft_wrap=True)
    for policy in chosen["policies"]:
        console.print(f"{policy['task']}: {policy['folder']}", soft_wrap=True)
    return 0


def _entropies_text(entropies: dict[str, Any]) -> str:
    from music_rllib import names
    from music_rllib.results.statistics import with_interval

    words = {names.SHANNON_ENTROPY: "Shannon entropy (nats)", names.ENTROPY: "S_q"}
    texts = (
        f"{words[metric]} {with_interval(entropy['value'], entropy['interval'])}"
        for metric, entropy in entropies.items()
    )
    return f"its policies at the end: {', '.join(texts)}"
