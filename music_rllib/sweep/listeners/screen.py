"""The progress of a sweep on the screen: a live table on a terminal, plain lines elsewhere."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Self

from rich.console import Console, Group
from rich.live import Live
from rich.progress import Progress, Task
from rich.text import Text

from music_rllib import names
from music_rllib.command_line import clock, new_table
from music_rllib.experiment.plan import Node, Plan
from music_rllib.experiment.scheduler import DONE, Failure, Listener, Scheduler, Status
from music_rllib.names import ShortLabels
from music_rllib.store.history import Report, RunResult, last_values
from music_rllib.sweep.views.results import evaluation_text

REFRESH_SECONDS = 0.5
PACE_SECONDS = 600.0
"""Time over which the speed of a run is averaged."""
PROGRESS_SECONDS = 30.0
"""Time between two lines about the progress of a run, where there is no terminal."""
WIDE = 76
"""Smallest number of columns for the whole live table."""


class Display(Listener):
    """Shows running runs with their speed and remaining time; prints a line at the end of each."""

    def __init__(
        self,
        console: Console,
        plan: Plan,
        scheduler: Scheduler,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Print on `console`; `now` is a clock in seconds."""
        self._console = console
        self._plan = plan
        self._scheduler = scheduler
        self._now = now
        self._began = now()
        self.short = ShortLabels(
            {node.stage for node in plan.nodes} | {stage.name for stage in plan.searched},
            {node.run.task.name for node in plan.nodes}
            | {task.name for stage in plan.searched for task in stage.tasks},
        )
        self.headline: Callable[[], tuple[list[str], str | None]] = lambda: ([], None)
        """Returns a line for each stage and search, and the best condition so far."""
        self._best: str | None = None
        """The best condition that was printed last."""
        self._spent: dict[str, int] = {}
        """Env steps of runs that were interrupted, stopped early or failed."""
        self._progress = Progress(get_time=now, speed_estimate_period=PACE_SECONDS)
        """Env steps, speed and remaining time of the running runs."""
        self._running: dict[str, Task] = {}
        self._printed: dict[str, float] = {}
        """Node key to the time of its last line."""
        self._print_all = os.environ.get(names.VARIABLE_PROGRESS) == "all"
        self._refreshed = self._headed = self._began
        self._shares = False
        """Whether the screen says that other processes compute runs too."""
        self._live = Live(console=console, auto_refresh=False, transient=True)

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def say(self, text: str, style: str = "") -> None:
        """Print a line above the live table."""
        passed = clock(self._now() - self._began)
        self._console.print(Text(f"[{passed:>6}] {text}", style=style), soft_wrap=True)

    def _say_of(self, node: Node, text: str, style: str = "") -> None:
        self.say(f"{self.short(node.label)}: {text}", style)

    def started(self, node: Node) -> None:
        self._spent.pop(node.key, None)
        self._task(node)
        self._printed[node.key] = self._now()
        self._say_of(node, "started")

    def _task(self, node: Node) -> Task:
        if node.key not in self._running:
            self._progress.add_task("", total=node.run.env_steps, node=node, metrics={})
            self._running[node.key] = self._progress.tasks[-1]
        return self._running[node.key]

    def reported(self, node: Node, reports: list[Report]) -> None:
        task, steps = self._task(node), reports[-1].env_steps
        # Steps without learning are many times faster than the others.
        learns = steps > node.run.tac.steps_before_updates
        change = self._progress.update if learns else self._progress.reset
        change(task.id, completed=steps)
        task.fields["metrics"] |= last_values(reports)
        if self._console.is_terminal or steps >= node.run.env_steps:
            return  # the table shows it, or the line of `finished` will
        wanted = self._print_all and any(names.EVAL_EPISODES in one.metrics for one in reports)
        last = self._printed.setdefault(node.key, self._began)
        if wanted or self._now() - last >= PROGRESS_SECONDS:
            self._printed[node.key] = self._now()
            self._say_of(node, self._progress_text(task))

    def noted(self, node: Node, text: str) -> None:
        self._say_of(node, text)

    def remarked(self, text: str) -> None:
        self.say(text, "yellow")

    def finished(self, node: Node, result: RunResult) -> None:
        self._leave(node)
        self._spent.pop(node.key, None)
        evaluated = evaluation_text(node.run, result.metrics, any_step=True)
        cost = f"{result.env_steps:,} env steps in {clock(result.seconds)}"
        self._say_of(node, f"finished, {evaluated}, {cost}", "green")

    def failed(self, node: Node, failure: Failure) -> None:
        self._leave(node)
        cause = failure.cause.replace("\n", "\n" + " " * 13)
        self._say_of(node, f"FAILED: {cause}", "red")
        self.say(f"    whole traceback: {failure.log}")

    def skipped(self, node: Node, because: Node) -> None:
        self._say_of(node, f"skipped, it starts from {self.short(because.label)}", "yellow")

    def paused(self, node: Node) -> None:
        self._leave(node)

    def pruned(self, node: Node, reason: str) -> None:
        self._leave(node)

    def left(self, node: Node, holder: str) -> None:
        if not self._shares or node.key in self._running:
            self._shares = True
            self._say_of(node, f"computed by {holder}; this process takes runs that are free")
        self._leave(node)

    def _leave(self, node: Node) -> None:
        """Show a run no longer, and keep the env steps that it has spent if it is unfinished."""
        if (task := self._running.pop(node.key, None)) is not None:
            self._progress.remove_task(task.id)
            self._spent[node.key] = int(task.completed)

    def tick(self) -> None:
        now = self._now()
        if self._console.is_terminal:
            if now - self._refreshed >= REFRESH_SECONDS:
                self._refreshed = now
                self._live.update(self._view(), refresh=True)
        elif now - self._headed >= PROGRESS_SECONDS:
            self._headed = now
            _, best = self.headline()
            if best is not None and best != self._best:
                self._best = best
                self.say(best)

    def _view(self) -> Group:
        wide = self._console.width >= WIDE
        heads = ("running", "env steps", *["steps/s"] * wide, "left", "evaluated")
        table = new_table("", heads, left=["running"])
        for task in self._running.values():
            node, found = task.fields["node"], task.fields["metrics"]
            done = f"{task.completed:,} / {task.total:,}" if wide else f"{task.percentage:.0f} %"
            table.add_row(
                self.short(node.label),
                done if task.completed else "preparing",
                *["-" if task.speed is None else f"{task.speed:.0f}"] * wide,
                clock(task.time_remaining),
                evaluation_text(node.run, found, any_step=False)
                if names.EVAL_EPISODES in found
                else "-",
            )
        lines, best = self.headline()
        texts = [Text(line, style="dim") for line in [*lines, self._summary()]]
        return Group(table, *texts, *([Text(best)] if best else []))

    def _summary(self) -> str:
        """`1 of 4 runs finished, 8,000 of 24,000 env steps, 1:02 passed, about 2:10 left`."""
        done, running = self._scheduler.having(*DONE), self._running.values()
        reached = sum(task.completed for task in running)
        steps = sum(node.run.env_steps for node in done) + sum(self._spent.values()) + reached
        text = (
            f"{len(done)} of {len(self._plan.nodes)} runs finished, "
            f"{steps:,} of {self._plan.env_steps:,} env steps, "
            f"{clock(self._now() - self._began)} passed"
        )
        if not running or not all(task.speed for task in running):
            return text
        # If waiting runs train as fast as running ones, without further waits.
        to_do = self._scheduler.having(Status.WAITING, Status.STARTED)
        left = sum(node.run.env_steps for node in to_do) - reached
        together = left / sum(task.speed or 0.0 for task in running)
        return (
            f"{text}, about "
            f"{clock(max(together, *(task.time_remaining or 0.0 for task in running)))} left"
        )

    def _progress_text(self, task: Task) -> str:
        parts = [f"{task.completed:,} of {task.total:,} env steps"]
        if task.speed is not None:
            parts += [f"{task.speed:.0f} steps/s", f"{clock(task.time_remaining)} left"]
        if names.EVAL_EPISODES in (metrics := task.fields["metrics"]):
            parts.append(evaluation_text(task.fields["node"].run, metrics, any_step=True))
        return ", ".join(parts)
