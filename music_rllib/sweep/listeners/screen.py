"""The progress of a sweep on the screen: a live table on a terminal, plain lines elsewhere."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Self

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from music_rllib import names
from music_rllib.command_line import clock, new_table, percent
from music_rllib.experiment.plan import Node, Plan
from music_rllib.experiment.scheduler import Failure, Listener, Scheduler, Status
from music_rllib.names import ShortLabels
from music_rllib.store.history import Report, RunResult, last_values
from music_rllib.sweep.views.results import evaluation_text

REFRESH_SECONDS = 0.5
PROGRESS_SECONDS = 30.0
"""Time between two lines about the progress of a run, where there is no terminal."""
WIDE = 76
"""Smallest number of columns for the whole live table."""


class Throughput:
    """Speed and remaining time of one run, from its reports.

    Args:
        budget: Environment steps of the run.
        warm_up: Number of initial steps without learning, which are many times faster than the
            others and do not count.
        now: Seconds on any clock.
    """

    def __init__(self, budget: int, warm_up: int, now: float) -> None:
        self.budget, self._warm_up, self._updated = budget, warm_up, now
        self.env_steps = 0
        self.metrics: dict[str, float] = {}
        """The last value of each metric."""
        self._recent: deque[Report] = deque(maxlen=6)

    def add(self, reports: Iterable[Report], now: float) -> None:
        """Add new reports."""
        reports = list(reports)
        for report in reports:
            if report.env_steps <= self._warm_up:
                self._recent.clear()
            self._recent.append(report)
            self.env_steps = report.env_steps
        self.metrics |= last_values(reports)
        self._updated = now

    @property
    def steps_per_second(self) -> float | None:
        """Speed over the last few reports; None before the first one after the warm-up."""
        if self.env_steps <= self._warm_up:
            return None
        first, last = self._recent[0], self._recent[-1]
        steps, seconds = last.env_steps - first.env_steps, last.seconds - first.seconds
        if len(self._recent) == 1:  # since the start
            steps, seconds = last.env_steps, last.seconds
        return steps / seconds if seconds > 0 else None

    def seconds_left(self, now: float) -> float | None:
        """Estimated remaining time; None if the speed is not known yet."""
        rate = self.steps_per_second
        if rate is None:
            return None
        return max((self.budget - self.env_steps) / rate - (now - self._updated), 0.0)


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
        self._running: dict[str, tuple[Node, Throughput]] = {}
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
        self._running[node.key] = (node, self._new_throughput(node))
        self._printed[node.key] = self._now()
        self._say_of(node, "started")

    def _new_throughput(self, node: Node) -> Throughput:
        return Throughput(node.run.env_steps, node.run.tac.steps_before_updates, self._now())

    def reported(self, node: Node, reports: list[Report]) -> None:
        _, throughput = self._running.setdefault(node.key, (node, self._new_throughput(node)))
        throughput.add(reports, self._now())
        if self._console.is_terminal or throughput.env_steps >= node.run.env_steps:
            return  # the table shows it, or the line of `finished` will
        wanted = self._print_all and any(names.EVAL_EPISODES in one.metrics for one in reports)
        last = self._printed.setdefault(node.key, self._began)
        if wanted or self._now() - last >= PROGRESS_SECONDS:
            self._printed[node.key] = self._now()
            self._say_of(node, self._progress_text(node, throughput))

    def noted(self, node: Node, text: str) -> None:
        self._say_of(node, text)

    def remarked(self, text: str) -> None:
        self.say(text, "yellow")

    def finished(self, node: Node, result: RunResult) -> None:
        self._running.pop(node.key, None)
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
        """Keep the env steps that an unfinished run has spent."""
        if (running := self._running.pop(node.key, None)) is not None:
            _, throughput = running
            self._spent[node.key] = throughput.env_steps

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
        for node, throughput in self._running.values():
            rate, found = throughput.steps_per_second, throughput.metrics
            value = evaluation_text(node.run, found, any_step=False)
            done = f"{throughput.env_steps:,} / {throughput.budget:,}"
            if not wide:
                done = percent(throughput.env_steps / throughput.budget)
            table.add_row(
                self.short(node.label),
                done if throughput.env_steps else "preparing",
                *["-" if rate is None else f"{rate:.0f}"] * wide,
                clock(throughput.seconds_left(self._now())),
                value if names.EVAL_EPISODES in found else "-",
            )
        lines, best = self.headline()
        texts = [Text(line, style="dim") for line in [*lines, self._summary()]]
        return Group(table, *texts, *([Text(best)] if best else []))

    def _summary(self) -> str:
        """`1 of 4 runs finished, 8,000 of 24,000 env steps, 1:02 passed, about 2:10 left`."""
        done = self._scheduler.having(Status.FINISHED, Status.REUSED)
        steps = sum(node.run.env_steps for node in done)
        steps += sum(throughput.env_steps for _, throughput in self._running.values())
        steps += sum(self._spent.values())
        text = (
            f"{len(done)} of {len(self._plan.nodes)} runs finished, "
            f"{steps:,} of {self._plan.env_steps:,} env steps, "
            f"{clock(self._now() - self._began)} passed"
        )
        left = self._seconds_left()
        return text if left is None else f"{text}, about {clock(left)} left"

    def _seconds_left(self) -> float | None:
        """Remaining time if waiting runs train as fast as running ones, without further waits.

        None before every running run has a speed.
        """
        running = [throughput for _, throughput in self._running.values()]
        rates = [rate for run in running if (rate := run.steps_per_second) is not None]
        if not rates or len(rates) < len(running):
            return None
        to_do = self._scheduler.having(Status.WAITING, Status.STARTED)
        steps = sum(node.run.env_steps for node in to_do) - sum(run.env_steps for run in running)
        left = [run.seconds_left(self._now()) or 0.0 for run in running]
        return max(steps / sum(rates), *left)

    def _progress_text(self, node: Node, throughput: Throughput) -> str:
        parts = [f"{throughput.env_steps:,} of {throughput.budget:,} env steps"]
        rate, left = throughput.steps_per_second, throughput.seconds_left(self._now())
        if rate is not None:
            parts += [f"{rate:.0f} steps/s", f"{clock(left)} left"]
        if names.EVAL_EPISODES in throughput.metrics:
            parts.append(evaluation_text(node.run, throughput.metrics, any_step=True))
        return ", ".join(parts)
