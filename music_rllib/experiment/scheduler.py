"""The states of a sweep's nodes while it runs, and the interface of listeners to its events."""

from __future__ import annotations

import os
import zlib
from collections.abc import Collection, Iterator
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple

from music_rllib.experiment.plan import Node, Plan
from music_rllib.store.history import Report, RunResult


class Status(StrEnum):
    """The state of a node."""

    WAITING = "waiting"
    """It waits for its input or its turn."""
    STARTED = "started"
    """It is being computed."""
    FINISHED = "finished"
    REUSED = "reused"
    """It was in the store before this sweep started."""
    FAILED = "failed"
    SKIPPED = "skipped"
    """Its input failed or was skipped."""
    PAUSED = "paused"
    """It is computed up to its trial's rung."""
    PRUNED = "pruned"
    """It is not computed any further: its trial was stopped early, or failed."""


DONE = (Status.FINISHED, Status.REUSED)
LOST = (Status.FAILED, Status.SKIPPED)


class Scheduler:
    """The nodes of a plan and their states."""

    def __init__(self, plan: Plan, finished: Collection[str]) -> None:
        """All nodes of `plan`; nodes with a key in `finished` are done, the others wait."""
        self._nodes = {node.key: node for node in plan.nodes}
        seeds = list(dict.fromkeys(node.run.seed for node in plan.nodes))
        inputs = {node.input.key for node in plan.nodes if node.input is not None}
        groups = {
            node.key: (seeds.index(node.run.seed), node.key not in inputs) for node in plan.nodes
        }
        self._turns = {key: (*group, turn) for turn, (key, group) in enumerate(groups.items())}
        self._until: dict[str, int] = {}
        self._elsewhere: dict[str, None] = {}
        self._salt: bytes | None = None
        """Makes an order of this process, once others compute nodes of the plan too."""
        self._status = {
            key: Status.REUSED if key in finished else Status.WAITING for key in self._nodes
        }

    def __getitem__(self, key: str) -> Status:
        return self._status[key]

    def knows(self, key: str) -> bool:
        return key in self._nodes

    def is_planned(self, key: str) -> bool:
        """Whether the node was in the plan before any search requested it."""
        return key in self._turns

    def node(self, key: str) -> Node:
        return self._nodes[key]

    def having(self, *statuses: Status) -> list[Node]:
        """Nodes in one of these states, in the order of the plan."""
        return [node for key, node in self._nodes.items() if self._status[key] in statuses]

    @property
    def all_handed_out(self) -> bool:
        """Whether no node waits."""
        return Status.WAITING not in self._status.values()

    @property
    def complete(self) -> bool:
        """Whether no node waits or is being computed."""
        return self.all_handed_out and Status.STARTED not in self._status.values()

    def next_ready(self) -> Node | None:
        """The next waiting node whose input is done; None if there is none.

        All nodes of a seed come before those of the next seed, so that an interrupted sweep can
        compare its settings. Within a seed, nodes from which others start come first, so that the
        last runs of a sweep do not wait for each other; then in the order of the plan. Nodes that
        a search has added come last, in the order of their addition. Nodes that another process
        computes do not count.
        """
        ready = (
            node
            for node in self.having(Status.WAITING)
            if node.key not in self._elsewhere and self._input_is_there(node)
        )
        return min(ready, key=self._turn, default=None)

    def _turn(self, node: Node) -> tuple[int, bool, int]:
        """The order of the plan, or one of this process if others take nodes of the plan too."""
        seed, late, turn = self._turns.get(node.key, (len(self._turns), True, 0))
        if self._salt is not None:
            turn = zlib.crc32(self._salt + node.key.encode())
        return seed, late, turn

    def is_awaited(self, key: str) -> bool:
        """Whether a node waits for this one."""
        waiting = self.having(Status.WAITING)
        return any(node.input is not None and node.input.key == key for node in waiting)

    def waits_for_input(self, key: str) -> bool:
        """Whether the node waits for a node that is not done."""
        return self._status[key] is Status.WAITING and not self._input_is_there(self._nodes[key])

    def _input_is_there(self, node: Node) -> bool:
        if node.input is None or node.input.checkpoint is not None:
            return True
        return self._status[node.input.key] in DONE

    def request(self, node: Node, until: int | None, *, finished: bool) -> None:
        """Add a node that a search requests, or have a known one computed further.

        Args:
            node: The node; its input must be known.
            until: Environment steps up to which it is to be computed; None for its end.
            finished: Whether the node, if it is new, is in the store.
        """
        key = node.key
        if key not in self._nodes:
            lost = node.input is not None and self._status.get(node.input.key) in LOST
            waiting = Status.SKIPPED if lost else Status.WAITING
            self._add(node, Status.REUSED if finished else waiting)
            if until is not None:
                self._until[key] = until
            return
        before = self._until.get(key)
        if until is None:
            self._until.pop(key, None)
        elif before is not None:
            self._until[key] = max(before, until)
        further = before is not None and (until is None or until > before)
        if self._status[key] is Status.PRUNED or (self._status[key] is Status.PAUSED and further):
            if self._status[key] is Status.PRUNED and until is not None:
                self._until[key] = until
            self._move(key, self._status[key], Status.WAITING)

    def add_pruned(self, node: Node, *, finished: bool) -> None:
        """Add a node of a trial that ended earlier, which is not to be computed."""
        if node.key not in self._nodes:
            self._add(node, Status.REUSED if finished else Status.PRUNED)

    def _add(self, node: Node, status: Status) -> None:
        self._nodes[node.key] = node
        self._status[node.key] = status

    def until(self, key: str) -> int | None:
        """Environment steps up to which the node is to be computed; None for its end."""
        return self._until.get(key)

    def pause(self, key: str, env_steps: int) -> None:
        """Record that the node is computed that far; it waits if more was requested meanwhile."""
        until = self._until.get(key)
        more = until is None or until > env_steps
        self._move(key, Status.STARTED, Status.WAITING if more else Status.PAUSED)

    def prune(self, key: str) -> bool:
        """Stop computing the node; returns False if it is not waiting or paused."""
        if self._status[key] not in (Status.WAITING, Status.PAUSED):
            return False
        self._move(key, self._status[key], Status.PRUNED)
        return True

    def start(self, key: str) -> None:
        self._move(key, Status.WAITING, Status.STARTED)

    @property
    def elsewhere(self) -> list[Node]:
        """Waiting nodes that another process computes."""
        return [self._nodes[key] for key in self._elsewhere if self._status[key] is Status.WAITING]

    def leave(self, key: str) -> None:
        """Record that another process computes the node."""
        self._salt = self._salt or os.urandom(8)
        self._elsewhere[key] = None
        self._status[key] = Status.WAITING

    def take_back(self, key: str) -> None:
        """Record that no other process computes the node any more."""
        self._elsewhere.pop(key, None)

    def finish(self, key: str) -> None:
        """Record that the node is in the store, from this process or another one."""
        self._elsewhere.pop(key, None)
        assert self._status[key] in (Status.STARTED, Status.WAITING)
        self._status[key] = Status.FINISHED

    def fail(self, key: str) -> list[Node]:
        """Record that the node failed; skips and returns the waiting nodes that depend on it."""
        self._move(key, Status.STARTED, Status.FAILED)
        dependants = list(self._dependants({key}))
        for node in dependants:
            self._move(node.key, Status.WAITING, Status.SKIPPED)
        return dependants

    def _dependants(self, lost: set[str]) -> Iterator[Node]:
        for node in self._nodes.values():  # every node comes after its input
            waits = self._status[node.key] is Status.WAITING
            if waits and node.input is not None and node.input.key in lost:
                lost.add(node.key)
                yield node

    def _move(self, key: str, before: Status, after: Status) -> None:
        assert self._status[key] is before, f"{key} is {self._status[key]}, not {before}"
        self._status[key] = after


class Failure(NamedTuple):
    """Why a run failed."""

    cause: str
    """One or two lines."""
    log: Path
    """File with the whole traceback."""


class Listener:
    """Receives a sweep's events in the driver's loop; it must be fast and must not raise."""

    def started(self, node: Node) -> None:
        """A worker started computing the node."""

    def reported(self, node: Node, reports: list[Report]) -> None:
        """The node has new reports; after a restart, all reports of its checkpoint again."""

    def noted(self, node: Node, text: str) -> None:
        """A message about the node, other than a failure."""

    def remarked(self, text: str) -> None:
        """A message about the whole sweep."""

    def finished(self, node: Node, result: RunResult) -> None:
        """The node is in the store."""

    def failed(self, node: Node, failure: Failure) -> None:
        """The run failed."""

    def skipped(self, node: Node, because: Node) -> None:
        """The node won't be computed because another node failed."""

    def paused(self, node: Node) -> None:
        """The node is computed up to its trial's rung."""

    def pruned(self, node: Node, reason: str) -> None:
        """The node isn't computed any further because its trial was stopped early."""

    def left(self, node: Node, holder: str) -> None:
        """Another process, in words, computes the node."""

    def tick(self) -> None:
        """Called in every iteration of the driver's loop."""
