"""A Tune searcher that suggests the nodes of a plan as soon as their inputs are published."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ray.tune.search import Searcher

from music_rllib.experiment.plan import Node
from music_rllib.experiment.scheduler import Scheduler


class DagSearcher(Searcher):
    """Suggests each waiting node once, when it can run.

    Tune asks again and again. `None` makes it go on with the trials it has, and while it has none
    it asks once a second: that happens only where a search waits for another driver's trials, as a
    node only waits for one that is being computed. `FINISHED` makes it ask no more. Failures never
    stop the others.

    Nothing of this is restored from Tune's snapshots: the node store has what is finished.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        config_of: Callable[[Node], dict[str, Any]],
        advance: Callable[[], bool] = lambda: False,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """Suggest the nodes of `scheduler`.

        Args:
            scheduler: Has the nodes and their statuses.
            config_of: Makes the Tune config of a node.
            advance: Lets the searches add nodes to the scheduler; returns whether they may add
                more later.
            stopped: Returns whether nothing more is to be suggested.
        """
        super().__init__()
        self._scheduler = scheduler
        self._config_of = config_of
        self._advance = advance
        self._stopped = stopped

    def suggest(self, trial_id: str) -> dict[str, Any] | str | None:
        """The config of a node that can run, None for "not now", or `FINISHED`."""
        if self._stopped():
            return str(Searcher.FINISHED)
        more = self._advance()
        node = self._scheduler.next_ready()
        if node is None:
            done = self._scheduler.all_handed_out and not more
            return str(Searcher.FINISHED) if done else None
        self._scheduler.start(node.key)
        return self._config_of(node)

    def on_trial_complete(
        self, trial_id: str, result: dict[str, Any] | None = None, error: bool = False
    ) -> None:
        """Do nothing: the callback `TuneEvents`, which has the cause, moves the node.

        Tune calls it before it asks for the next suggestion.
        """

    def save_to_dir(self, checkpoint_dir: str, session_str: str = "default") -> None:
        """Save nothing."""

    def __getstate__(self) -> dict[str, Any]:
        # Tune pickles the searcher into its snapshot, which nobody reads.
        return {}
