"""``python -m music_rllib.tracking``: send what a sweep could not deliver to MLflow."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from music_rllib.errors import TrackingError
from music_rllib.redaction import for_people

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)


@app.callback()
def main() -> None:
    """Look after what sweeps log to MLflow."""


@app.command()
def deliver(
    sweep_folder: Annotated[
        Path, typer.Argument(help="The sweep's folder: the one that holds tracking/.")
    ],
    tracking_uri: Annotated[
        str | None,
        typer.Option(
            help="Send there instead of where the sweep was logged; needed where that URI holds "
            "a password, which is not kept."
        ),
    ] = None,
    timeout: Annotated[float, typer.Option(min=1.0, help="Seconds to try for.")] = 60.0,
) -> None:
    """Send what the spools of a sweep still hold. Sending twice changes nothing.

    Example: python -m music_rllib.tracking deliver results/smoke

    Exit codes: 0 all is delivered, 1 something is left, 2 bad input.
    """
    from music_rllib.tracking.session import deliver as deliver_sweep

    try:
        left = deliver_sweep(sweep_folder, tracking_uri, timeout)
    except TrackingError as error:
        typer.echo(f"error: {for_people(error)}", err=True)
        raise typer.Exit(2) from error
    if left:
        reason = left.error or f"not done within {timeout:.0f} s"
        typer.echo(
            f"{left.records} records and {left.artefacts} artefacts are left: {for_people(reason)}",
            err=True,
        )
        raise typer.Exit(1)
    typer.echo(f"MLflow has everything of {sweep_folder}")


if __name__ == "__main__":
    app(prog_name="python -m music_rllib.tracking")
