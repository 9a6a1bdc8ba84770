"""Sub-packages import downwards only; most modules do not load Ray, not even indirectly."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from tests.processes import fresh

PACKAGE = Path(__file__).parents[3] / "music_rllib"

# Only these may load Ray; everything else is usable, and tested, without it.
MAY_LOAD_RAY = (
    "runtime.ray_cluster",
    "tac",
    "training",
    "serve.application",
    "sweep",
    "tune",
)
# torch and numpy only: no environments, no tracking.
PURE = ("functional", "intrinsic", "replay", "runtime.process", "schedules")
# Imported by the command line before heavy libraries are needed.
LIGHT = ("", "command_line", "errors", "names", "runtime.quiet")


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


def test_imports_point_downwards() -> None:
    """The contracts of pyproject.toml hold."""
    program = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run(
        [program], cwd=PACKAGE.parent, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


def _forbidden(module: str) -> list[str]:
    forbidden = ["ray"]
    if any(_is_in(module, part) for part in PURE):
        forbidden += ["gymnasium", "mlflow", "pandas"]
    if module in LIGHT:
        forbidden += ["gymnasium", "mlflow", "torch", "numpy", "pydantic"]
    return forbidden


def test_lower_layers_load_no_ray() -> None:
    """In one fresh process, the strictest modules first, because imports remain loaded."""
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
    fresh("-c", code, argument)


def test_a_driver_loads_only_the_modules_that_it_needs() -> None:
    """Each import takes at least a third of a second, and memory for the whole sweep."""
    never = ["torch", "scipy.stats", "matplotlib", "optuna"]  # optuna: without a search
    code = (
        "import sys\n"
        "def check(*heavy):\n"
        "    loaded = [name for name in heavy if name in sys.modules]\n"
        "    assert not loaded, loaded\n"
        "import music_rllib.sweep.driver\n"
        f"check('ray', 'mlflow', 'pandas', *{never!r})\n"  # a user waits for the plan
        "import music_rllib.sweep.execution, music_rllib.tune.runner\n"
        f"check(*{never!r})\n"
    )
    fresh("-c", code)


def test_a_run_begins_without_torchs_compiler() -> None:
    """It would take a second and 70 MB in each process; torch's seeds and optimizers load it."""
    code = (
        "import sys, torch\n"
        "from ray.rllib.utils.torch_utils import set_torch_seed\n"
        "from music_rllib.kernels.adam import FusedAdam\n"
        "from music_rllib.tac.random_state import determinism_without_compiler\n"
        "with determinism_without_compiler():\n"
        "    set_torch_seed(0)\n"
        "assert torch.version.cuda or torch.are_deterministic_algorithms_enabled()\n"
        "optimizer = FusedAdam([torch.zeros(1, requires_grad=True)], 0.1)\n"
        "optimizer.load_state_dict(optimizer.state_dict())\n"
        "optimizer.zero_grad()\n"
        "assert 'torch._dynamo' not in sys.modules\n"
    )
    fresh("-c", code)


def test_the_rules_name_existing_modules() -> None:
    """A rule about a renamed module would check nothing."""
    for part in (*PURE, *LIGHT, *MAY_LOAD_RAY):
        assert any(_is_in(module, part) for module in MODULES) or part == "", part
