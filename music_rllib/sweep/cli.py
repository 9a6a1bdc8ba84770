"""The command line of the sweeper: finds the sub-commands, and turns errors into exit codes."""

from __future__ import annotations

import argparse
import difflib
import importlib
import os
import pkgutil
import signal
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import ModuleType, TracebackType

from music_rllib.errors import BAD_INPUT, BadInputError
from music_rllib.sweep import commands as package
from music_rllib.sweep.cli_helpers import Formatter

__all__ = ["main"]

PROGRAM = "python -m music_rllib.sweep"
DESCRIPTION = """\
Train every run of a sweep, compare and search, and log everything to MLflow.

A file without a command in front is run: the same as 'run FILE'.
"""
EPILOG = """\
examples:
  python -m music_rllib.sweep
      the packaged sweep: MUSIC-u, then MUSIC-r over q, on FetchPush, a few minutes
  python -m music_rllib.sweep tune_configs/smoke.yaml --dry-run
      check the file and show what would run
  python -m music_rllib.sweep run my.yaml --storage /data/results --name first-try
      the same sweep under another name; runs that are finished there are reused
  python -m music_rllib.sweep status results/first-try
      how far it is; 'compare', 'best' and 'evaluate' say what came of it
  RAY_ADDRESS=10.0.0.1:6379 python -m music_rllib.sweep my.yaml
      on a Ray cluster
  ray job submit --working-dir . -- python -m music_rllib.sweep my.yaml --storage /data/results
      as a job of a Ray cluster

Running a command again continues: finished runs are reused, others go on from their last
checkpoint.
'COMMAND --help' has each command's options and examples.

exit codes: 0 all is well, 1 a run failed or Ray died (state kept), 2 bad input or damaged results
(nothing was started), 130 stopped by Ctrl-C, 143 by SIGTERM (state kept).
"""
ORDER = ("run", "plan", "status", "stop", "resume", "compare", "best", "evaluate", "clean")
"""Of the commands in the help; others follow by name."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program with these arguments, or the process's; the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    modules = _commands()
    if not given or given[0] not in {*modules, "-h", "--help"}:
        if given and (meant := _meant(given[0], modules)) is not None:
            print(
                f"error: COMMAND must be one of {', '.join(modules)}, or a sweep's YAML file, got "
                f"{given[0]!r} (did you mean {meant!r}?)",
                file=sys.stderr,
            )
            return BAD_INPUT
        given.insert(0, "run")
    parsed = _parser(modules).parse_args(given)
    sys.excepthook = _show_unexpected
    try:
        return int(parsed.execute(parsed))
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except BrokenPipeError:
        # The reader has gone (`| head`); without this Python complains again at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        if not isinstance(error, _bad_input()):
            raise
        from music_rllib.redaction import for_people

        print(f"error: {for_people(error)}", file=sys.stderr)
        return BAD_INPUT


def _show_unexpected(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """A defect's traceback, without the passwords that an environment put into its message."""
    import traceback

    from music_rllib.redaction import for_people

    print(for_people("".join(traceback.format_exception(kind, error, trace))), file=sys.stderr)


def _meant(word: str, commands: Iterable[str]) -> str | None:
    """The command that a word is a mistyped form of, unless it is a file or looks like one."""
    if word.startswith("-") or {".", "/"} & {*word} or Path(word).exists():
        return None
    return next(iter(difflib.get_close_matches(word.lower(), commands, n=1)), None)


def _commands() -> dict[str, ModuleType]:
    found = {module.name for module in pkgutil.iter_modules(package.__path__)}
    names = [*(name for name in ORDER if name in found), *sorted(found.difference(ORDER))]
    return {name: importlib.import_module(f"{package.__name__}.{name}") for name in names}


def _parser(modules: dict[str, ModuleType]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=Formatter,
        allow_abbrev=False,
    )
    commands = parser.add_subparsers(metavar="COMMAND", required=True, parser_class=_Parser)
    for module in modules.values():
        module.register(commands)
    return parser


class _Parser(argparse.ArgumentParser):
    """Of a sub-command: its examples keep their lines, options are written in full."""

    def __init__(self, **options: object) -> None:
        settings = {"formatter_class": Formatter, "allow_abbrev": False} | options
        super().__init__(**settings)  # type: ignore[arg-type]

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Refuse what isn't known here: the parser above would show its own usage for it."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return found, unknown


def _bad_input() -> tuple[type[Exception], ...]:
    """Errors whose message tells the user what to change."""
    # Only here: they would load what the quick answers of the program don't need.
    from music_rllib.config.load import ConfigError
    from music_rllib.errors import TrackingError
    from music_rllib.experiment.demand import DemandError
    from music_rllib.runtime.machine import ClusterError
    from music_rllib.store.handoff import HandoffError
    from music_rllib.store.object_folder import StorageError
    from music_rllib.sweep.preflight import HardwareError, TaskError

    return (
        BadInputError,
        ClusterError,
        ConfigError,
        DemandError,
        HandoffError,
        HardwareError,
        StorageError,
        TaskError,
        TrackingError,
    )
