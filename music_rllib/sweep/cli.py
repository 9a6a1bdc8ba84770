"""`python -m music_rllib.sweep`: the commands of a sweep, and `run` where no command is given."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from music_rllib.command_line import Group, add_command, new_app, run_app
from music_rllib.sweep.commands import best, clean, compare, evaluate, files, run, status, stop

COMMANDS: dict[str, tuple[Callable[..., int], str]] = {
    "run": (run.run, run.RUN_EXAMPLES),
    "plan": (run.plan, run.PLAN_EXAMPLES),
    "status": (status.status, status.EXAMPLES),
    "stop": (stop.stop, stop.EXAMPLES),
    "resume": (run.resume, run.RESUME_EXAMPLES),
    "compare": (compare.compare, compare.EXAMPLES),
    "best": (best.best, best.EXAMPLES),
    "evaluate": (evaluate.evaluate, evaluate.EXAMPLES),
    "clean": (clean.clean, clean.EXAMPLES),
    "init": (files.init, files.INIT_EXAMPLES),
    "presets": (files.presets, files.PRESETS_EXAMPLES),
    "schema": (files.schema, files.SCHEMA_EXAMPLES),
}
"""Name to the function and the examples of its help, in the order of the help."""
EXIT_CODES = """\
Exit codes: 0 success; 1 a run failed or Ray died, the state is kept; 2 bad
input or damaged results, nothing was started; 130 stopped by Ctrl-C, 143 by
SIGTERM.
"""
EPILOG = f"""\
A file without a command in front is run; without arguments, the packaged sweep.
'music-rllib' is the same program with every command of the package.

Examples:
  python -m music_rllib.sweep
  python -m music_rllib.sweep my.yaml --storage /data/results
  python -m music_rllib.sweep status /data/results/mine
  ray job submit --working-dir . -- \\
    python -m music_rllib.sweep my.yaml --storage /data/results
      as a job of a Ray cluster

{EXIT_CODES}"""


class _RunsByDefault(Group):
    """Commands, and `run` where none is given."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put `run` in front of arguments without a command."""
        if not args or args[0] not in {*self.commands, *ctx.help_option_names}:
            if args and (command := _closest_command(args[0], self.commands)) is not None:
                ctx.fail(
                    f"COMMAND must be one of {', '.join(self.commands)}, or a sweep's YAML file, "
                    f"got {args[0]!r} (did you mean {command!r}?)"
                )
            args = ["run", *args]
        return super().parse_args(ctx, args)


def _closest_command(word: str, commands: Iterable[str]) -> str | None:
    """The command that a word misspells; None for what is a file or looks like one."""
    if word.startswith("-") or {".", "/", "="} & {*word} or Path(word).exists():
        return None
    return next(iter(difflib.get_close_matches(word.lower(), commands, n=1)), None)


app = new_app(epilog=EPILOG, cls=_RunsByDefault)
for _name, (_function, _examples) in COMMANDS.items():
    add_command(app, _name, _function, _examples)


@app.callback()
def sweep() -> None:
    """Train every run of a sweep, compare and search, and log to MLflow."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program with these arguments, or with the process's own; the exit code."""
    return run_app(app, "python -m music_rllib.sweep", arguments)
