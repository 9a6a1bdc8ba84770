"""The command `tracking`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import typer

from music_rllib.command_line import add_command, new_app, run_app
from music_rllib.errors import FAILED

EXAMPLES = """\
Examples:
  music-rllib tracking deliver results/smoke
  music-rllib tracking deliver results/smoke --timeout 600
  music-rllib tracking deliver s3://lab/results/smoke

Exit codes: 0 all is delivered, 1 something is left, 2 bad input.
"""


app = new_app(no_args_is_help=True)


@app.callback()
def tracking() -> None:
    """Look after what sweeps log to MLflow."""


def deliver(
    place: Annotated[
        str,
        typer.Argument(
            metavar="SWEEP",
            help="The sweep's folder, its URI in a bucket, or its name in results/.",
        ),
    ],
    tracking_uri: Annotated[
        str | None,
        typer.Option(
            metavar="URI",
            help="Send there instead of where the sweep was logged; needed where that URI holds "
            "a password, which is not kept.",
        ),
    ] = None,
    timeout: Annotated[
        float, typer.Option(metavar="SECONDS", min=1.0, help="How long to try.")
    ] = 60.0,
) -> int:
    """Send to MLflow what it has not of a sweep. Sending twice changes nothing."""
    from music_rllib.redaction import for_people
    from music_rllib.tracking.from_store import deliver as deliver_sweep

    pending = deliver_sweep(place, tracking_uri, timeout)
    if pending:
        reason = for_people(pending.error or f"not done within {timeout:.0f} s")
        left = f"{pending.records} records and {pending.artefacts} artefacts are left"
        typer.echo(f"{left}: {reason}", err=True)
        return FAILED
    typer.echo(f"MLflow has everything of {for_people(place)}")
    return 0


add_command(app, "deliver", deliver, EXAMPLES)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `python -m music_rllib.tracking` and return its exit code."""
    return run_app(app, "python -m music_rllib.tracking", arguments)
