"""A Tune searcher that hands out the nodes of a plan as their inputs are published."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ray.tune.search import Searcher

from music_rllib.experiment.plan import Node
from music_rllib.experiment.scheduler import Scheduler

__all__ = ["DagSearcher"]


class DagSearcher(Searcher):
    """Suggests each waiting node once, when it can run.

    Tune asks again and again. `None` makes it go on with the trials it has, and while it has none
    it asks once a second: that happens only where a search waits for another driver's trials, as a
    node only waits for one that is being computed. `FINISHED` makes it ask no more. Failures never
    stop the others.

    Nothing of this is restored from Tune's snapshots; the node store says what is finished.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        config_of: Callable[[Node], dict[str, Any]],
        advance: Callable[[], bool] = lambda: False,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """Hand out the nodes in `scheduler`.

        Args:
            scheduler: Where they are.
            config_of: Makes a Tune config of a node.
            advance: Lets a search put more in the scheduler; whether more may come later.
            stopped: Whether nothing more is to be handed out.
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
        """Nothing: the callback, which is told afterwards with the cause, moves the node.

        Tune informs it before it asks for the next suggestion.
        """

    def save_to_dir(self, checkpoint_dir: str, session_str: str = "default") -> None:
        """Leave nothing behind."""

    def __getstate__(self) -> dict[str, Any]:
        # Tune pickles the searcher into its snapshot, which nobody reads.
        return {}
