"""`compare`: the conditions of a stage side by side, with intervals."""

from __future__ import annotations

from typing import Annotated

import typer

from music_rllib.command_line import Json, console_for, print_json
from music_rllib.sweep.commands import Place, StageName, Storage

EXAMPLES = """\
Examples:
  music-rllib compare results/smoke
  music-rllib compare results/smoke --metric evaluation/object_displacement
  music-rllib compare results/search --stage finetune --json

The answer comes first. It compares the areas under the learning curves (the
mean over the budget), paired by seed if conditions share seeds: superior,
worse, equivalent within a margin, or undecided (docs/comparing_q.md).
Comparisons that the sweep's 'analysis' planned before the runs are marked.

Tables of final values follow, without a test: the mean over the seeds that
have finished on every task with its 95% CI (docs/reports.md), the difference
from the best mean, and the probability that a run of the best condition ends
better. Runs on fresh seeds of a search are never mixed with the runs of its
trials. The report has the same numbers.
"""


def compare(
    sweep: Place,
    storage: Storage = None,
    stage: StageName = None,
    metric: Annotated[
        str | None,
        typer.Option(
            metavar="METRIC",
            help="Metric to compare, by its last value in each run. Default: the objective of a "
            "search, otherwise the primary metric of each task (success rate, or return without "
            "success).",
        ),
    ] = None,
    minimize: Annotated[
        bool, typer.Option("--minimize", help="Lower values of the metric are better.")
    ] = False,
    json: Json = False,
) -> int:
    """Compare values of q, or of other settings, with 95% confidence intervals."""
    from music_rllib.experiment.sweep_files import find_sweep
    from music_rllib.sweep.views.compare import compare_document, compare_view

    document = compare_document(find_sweep(sweep, storage), stage, metric, minimize=minimize)
    if json:
        print_json(document)
    else:
        console_for().print(compare_view(document))
    return 0
