"""`make bench`: the costs of a sweep, as ratios measured in one run."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from music_rllib.runtime.quiet import prepare_environment, quiet_third_parties

if TYPE_CHECKING:
    from rich.table import Table

    from benchmarks.measure import Row

GROUPS = {
    "step": "training_step",
    "environment": "environment",
    "gpu": "gpu",
    "replay": "sampling",
    "training": "whole_training",
    "success": "time_to_success",
    "checkpoint": "checkpoint",
    "memory": "memory",
    "sweep": "sweep",
    "warm": "warm_workers",
    "driver": "driver",
    "search": "search",
    "report": "report",
}
EXAMPLES = """\
examples:
  python -m benchmarks                       the whole table, several hours
  python -m benchmarks step environment      two groups of it
  python -m benchmarks --repeats 9 step      more turns
  BENCH_RUNS=12 python -m benchmarks warm    12 runs, not 60, in warm and in new processes

Stable-Baselines3, SBX and a JAX jit are compared with where they are installed:
pip install -e '.[bench]'. Targets count by wall and by CPU time; the latter is of all threads.
"""


def main() -> int:
    """Measure, print and write the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description=__doc__,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("groups", nargs="*", metavar="GROUP", help=f"of {', '.join(GROUPS)}")
    parser.add_argument("--repeats", type=int, default=5, help="turns of each (default 5)")
    parser.add_argument(
        "--output", type=Path, default=Path("results/bench"), help="folder for bench.json and .md"
    )
    arguments = parser.parse_args()
    if unknown := set(arguments.groups) - GROUPS.keys():
        parser.error(f"GROUP must be one of {', '.join(GROUPS)}, got {', '.join(sorted(unknown))}")
    if arguments.repeats < 1:
        parser.error(f"--repeats must be >= 1, got {arguments.repeats}")
    try:
        arguments.output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        parser.error(f"--output can't be a folder to write to: {error}")
    prepare_environment()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    return run(arguments.groups or list(GROUPS), arguments.repeats, arguments.output)


def run(groups: Sequence[str], repeats: int, folder: Path) -> int:
    """Measure the groups one after the other; the files contain the rows measured so far."""
    rows: list[Row] = []
    before, code = os.getloadavg()[0], 0
    try:
        for number, name in enumerate(groups, 1):
            print(f"measuring: {name} ({number} of {len(groups)})", file=sys.stderr, flush=True)
            rows += measure(name, repeats)
            write(rows, _machine(before), folder)
    except KeyboardInterrupt:
        print("stopped: the table has the groups before", file=sys.stderr)
        code = 130
    if rows:
        report(rows, _machine(before), folder)
    return code


def measure(name: str, repeats: int) -> Iterator[Row]:
    """All rows of a group, with Ray and torch as in a trial: one thread."""
    import ray
    import torch

    from benchmarks.measure import start_ray
    from music_rllib.runtime.process import keep_freed_memory

    quiet_third_parties()
    torch.set_num_threads(1)
    keep_freed_memory()  # the compared programs get it too
    if not ray.is_initialized():
        start_ray(2)
    module: Any = importlib.import_module(f"benchmarks.{GROUPS[name]}")
    yield from module.rows(repeats)


def write(rows: list[Row], machine: dict[str, Any], folder: Path) -> None:
    """The table as JSON and Markdown."""
    document = {"machine": machine, "rows": [asdict(row) for row in rows]}
    (folder / "bench.json").write_text(json.dumps(document, indent=1) + "\n")
    (folder / "bench.md").write_text(as_markdown(rows) + f"\n{_described(machine)}\n")


def report(rows: list[Row], machine: dict[str, Any], folder: Path) -> None:
    """Print the table, the missed targets, and the paths of the files."""
    from rich.console import Console

    console = Console(width=max(110, Console().width), highlight=False, soft_wrap=True)
    console.print(as_table(rows))
    console.print(_described(machine))
    missed = [row for row in rows if row.met is False]
    console.print(f"targets: {sum(row.met is True for row in rows)} met, {len(missed)} missed")
    for row in missed:
        console.print(f"  missed: {row.group}, {row.what}, {row.against}: asked {row.target}")
    console.print(f"written to {folder / 'bench.md'} and bench.json")


def _machine(load_before: float) -> dict[str, Any]:
    return {
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "load_average_before": round(load_before, 2),
        "load_average_after": round(os.getloadavg()[0], 2),
    }


def _described(machine: dict[str, Any]) -> str:
    return ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in machine.items())


COLUMNS = (
    "group", "what", "value", "by CPU", "against", "ratio", "range", "by CPU time", "range of it",
    "target", "met",
)  # fmt: skip


def cells(row: Row) -> tuple[str, ...]:
    """A row as text, in the order of `COLUMNS`."""
    return (
        row.group,
        row.what,
        f"{row.value:,.4g} {row.unit}",
        "" if row.cpu is None else f"{row.cpu:,.4g}",
        row.against,
        *_ratio(row.ratio, row.low, row.high),
        *_ratio(row.cpu_ratio, row.cpu_low, row.cpu_high),
        row.target,
        {True: "yes", False: "NO", None: ""}[row.met],
    )


def _ratio(median: float | None, low: float | None, high: float | None) -> tuple[str, str]:
    spread = "" if low is None or high is None else f"{low:.2f} - {high:.2f}"
    return "" if median is None else f"{median:.2f}", spread


def as_table(rows: list[Row]) -> Table:
    """The table for the terminal."""
    from rich.table import Table

    table = Table(title="medians over interleaved turns, one thread each")
    for column in COLUMNS:
        right = column not in ("group", "what", "against", "met")
        table.add_column(column, justify="right" if right else "left", overflow="fold")
    for row in rows:
        table.add_row(*cells(row))
    return table


def as_markdown(rows: list[Row]) -> str:
    """The table for the documentation."""
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS)]
    lines += ["| " + " | ".join(cells(row)) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "")


if __name__ == "__main__":
    sys.exit(main())
