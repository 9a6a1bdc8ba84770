"""`resume`: go on with a sweep from what its storage knows of it."""

from __future__ import annotations

from music_rllib.command_line import Json
from music_rllib.sweep.cli_helpers import AcceptChanges, Place, RetrainDamaged, Seeds, Storage

EXAMPLES = """\
Examples:
  music-rllib resume results/smoke
      no file needed: the configuration is in the storage
  music-rllib resume results/smoke --seeds 10
      extended by seeds: only the new ones are trained
  ray job submit --working-dir . -- \\
    python -m music_rllib.sweep resume s3://bucket/sweeps/smoke
      in a new job, after the head of a cluster has died
"""


def resume(
    sweep: Place,
    storage: Storage = None,
    seeds: Seeds = None,
    accept_changes: AcceptChanges = False,
    retrain_damaged: RetrainDamaged = False,
    json: Json = False,
) -> int:
    """Go on with a sweep that was stopped or killed.

    By the configuration that it has left in its storage.
    """
    from music_rllib.experiment.location import find_sweep
    from music_rllib.sweep.driver import run_sweep

    return run_sweep(
        find_sweep(sweep, storage),
        seeds=seeds,
        accept_changes=accept_changes,
        retrain_damaged=retrain_damaged,
        as_json=json,
    )
