"""`make profile`: a flame graph of a training run, Python and native frames."""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

EXAMPLES = """\
examples:
  python -m benchmarks.profile                            results/profile.svg, half a minute of it
  python -m benchmarks.profile --seconds 120 --native     with the frames of torch and MuJoCo
  python -m benchmarks.profile --format speedscope --output profile.json
"""


def main() -> int:
    """Profile `benchmarks.peer`, which trains TAC with HER on FetchPush, 3 x 128."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.profile",
        description=__doc__,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--output", type=Path, default=Path("results/profile.svg"))
    parser.add_argument("--seconds", type=int, default=30, help="of training (default 30)")
    parser.add_argument("--native", action="store_true", help="frames of compiled code, too")
    parser.add_argument("--format", choices=["flamegraph", "speedscope", "raw"],
                        default="flamegraph")  # fmt: skip
    arguments = parser.parse_args()
    py_spy = shutil.which("py-spy", path=str(Path(sys.executable).parent)) or shutil.which("py-spy")
    if py_spy is None:
        parser.error("py-spy must be installed: pip install py-spy")
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    return record(py_spy, arguments)


def record(py_spy: str, arguments: argparse.Namespace) -> int:
    """Run the training under py-spy, which follows it from its first line on."""
    options = ["--output", str(arguments.output), "--format", arguments.format]
    if arguments.native:
        options.append("--native")
    training = [sys.executable, "-m", "benchmarks.peer", "ours", "128", "0.4"]
    arguments.output.unlink(missing_ok=True)
    finished = subprocess.run(
        [py_spy, "record", *options, "--", *training],
        input=f"{arguments.seconds}\n",
        capture_output=True,
        text=True,
        check=False,
    )
    if finished.returncode or not arguments.output.exists():
        print(finished.stderr, file=sys.stderr)
        return 1
    print(f"{arguments.output}: {finished.stdout.splitlines()[-1]}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
