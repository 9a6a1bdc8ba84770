"""The layers import downwards only, and the lower ones load no Ray.

Modules are found by walking the package: a new one is held to its layer's rule from its first
day, and one in a new place must be given a layer here.
"""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "music_rllib"

# From the bottom up. A module may import its own part of the package and what stands lower.
LAYERS: tuple[tuple[str, ...], ...] = (
    (
        "_allocator",
        "_autoscaler",
        "_cluster",
        "_quiet",
        "entropy_scale",
        "limits",
        "tsallis",
        "mutual_information",
        "schedules",
        "tracking.names",
        "policy.network",
    ),
    ("estimator", "replay", "tracking"),
    ("results",),
    ("envs",),
    ("tac",),
    ("experiment",),
    ("search",),
    ("policy",),
    ("sweep", "reports", "serve"),
    ("report",),
)

# Only these may load Ray; everything else is usable, and tested, without it.
MAY_LOAD_RAY = (
    "_autoscaler",
    "tac.algorithm",
    "tac.config",
    "tac.env_runner",
    "tac.kernels.network",
    "tac.kernels.update",
    "tac.learner",
    "tac.module",
    "experiment.training",
    "serve.application",
    "sweep",
)
# torch and numpy only: no environments, no tracking.
PURE = ("_allocator", "tsallis", "mutual_information", "schedules", "estimator", "replay")
# Read by the command line before anything heavy is needed.
LIGHT = ("", "_quiet", "tracking.names")


def _modules() -> list[str]:
    """Dotted names below ``music_rllib``, "" for the package itself."""
    names = []
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        if parts[-1] == "__main__":  # importing it would run the program
            continue
        names.append(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return sorted(names)


MODULES = _modules()


def _is_in(module: str, part: str) -> bool:
    return module == part or module.startswith(f"{part}.")


def _layer(module: str) -> tuple[int, str]:
    """Height and part of a module; the most exact entry counts (``tracking.names``)."""
    matches = [
        (len(part), height, part)
        for height, parts in enumerate(LAYERS)
        for part in parts
        if _is_in(module, part)
    ]
    assert matches, f"music_rllib.{module} has no layer: give it one in {Path(__file__).name}"
    _, height, part = max(matches)
    return height, part


def _is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")


def _import_nodes(tree: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    """Every import that can run, those inside functions too."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif not _is_type_checking(node):
            yield from _import_nodes(node)


def _own_imports(module: str) -> set[str]:
    """The modules below ``music_rllib`` that ``module`` imports."""
    path = PACKAGE.joinpath(*module.split("."))
    source = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    imported: set[str] = set()
    for node in _import_nodes(ast.parse(source.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            assert node.level == 0, f"{source}: imports are absolute here"
            # `from music_rllib.tracking import names` imports a module, or a name in one.
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            if not name.startswith("music_rllib."):
                continue
            below = name.removeprefix("music_rllib.")
            while below not in MODULES and "." in below:
                below = below.rpartition(".")[0]
            if below in MODULES:
                imported.add(below)
    return imported


@pytest.mark.parametrize("module", [name for name in MODULES if name])
def test_imports_point_downwards(module: str) -> None:
    height, part = _layer(module)
    for imported in sorted(_own_imports(module)):
        below, other = _layer(imported)
        assert part == other or below < height, (
            f"music_rllib.{module} (layer {height}) imports music_rllib.{imported} (layer {below})"
        )


def _forbidden(module: str) -> list[str]:
    forbidden = ["ray"]
    if any(_is_in(module, part) for part in PURE):
        forbidden += ["gymnasium", "mlflow", "pandas"]
    if module in LIGHT:
        forbidden += ["gymnasium", "mlflow", "torch", "numpy", "pydantic"]
    return forbidden


def test_lower_layers_load_no_ray() -> None:
    """In one fresh process, the strictest first: what one module loads stays loaded."""
    checked = {
        module: _forbidden(module)
        for module in MODULES
        if not any(_is_in(module, part) for part in MAY_LOAD_RAY)
    }
    order = sorted(checked, key=lambda module: (-len(checked[module]), module))
    code = (
        "import importlib, json, sys\n"
        "for module, forbidden in json.loads(sys.argv[1]):\n"
        "    importlib.import_module('music_rllib.' + module if module else 'music_rllib')\n"
        "    loaded = [name for name in forbidden if name in sys.modules]\n"
        "    assert not loaded, f'music_rllib.{module} loads {loaded}'\n"
    )
    argument = json.dumps([(module, checked[module]) for module in order])
    done = subprocess.run(
        [sys.executable, "-c", code, argument],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_the_rules_name_what_exists() -> None:
    """A rule about a module that was renamed would hold nothing."""
    for part in (*PURE, *LIGHT, *MAY_LOAD_RAY):
        assert any(_is_in(module, part) for module in MODULES) or part == "", part
