"""Where the module of a user's environment is looked for, beside the installed ones.

`env_id: lab_env:Lab-v0` imports `lab_env` first. It may be installed or on PYTHONPATH, lie beside
the sweep's file, or in the current folder. The folders come last in `sys.path`, and only when a
module is asked for, so that a `random.py` or `queue.py` there never replaces Python's own.
"""

from __future__ import annotations

import contextlib
import importlib.util
import site
import sys
import sysconfig
from functools import cache
from pathlib import Path

_folders: dict[str, None] = {}


def search_in(*folders: str | Path) -> None:
    """Adds folders in which `make_importable` looks; relative ones start at the current folder."""
    with contextlib.suppress(FileNotFoundError):  # the current folder was deleted
        _folders.update(dict.fromkeys(str(Path(folder).absolute()) for folder in folders))


def folders_for_workers() -> tuple[str, ...]:
    """The folders for `search_in` in a worker, those below the current folder also relative to it.

    The working folder of a Ray job lies elsewhere on another node, and has the same content.
    """
    search_in(".")
    with contextlib.suppress(FileNotFoundError):
        here = Path.cwd()
        below = [Path(one).relative_to(here) for one in _folders if Path(one).is_relative_to(here)]
        return (*_folders, *map(str, below))
    return tuple(_folders)


def make_importable(module: str) -> None:
    """Lets a module of the user's be imported, from one of the folders if it is not installed.

    Raises:
        ImportError: There is no such module, or an installed one of the same name hides it.
    """
    search_in(".")
    sys.path += [folder for folder in _folders if folder not in sys.path]
    top = module.partition(".")[0]
    spec = None if top in sys.modules else importlib.util.find_spec(top)
    if spec is None and top not in sys.modules:
        raise ModuleNotFoundError(
            f"there is no module {top!r}: it must be installed, on PYTHONPATH, beside the sweep's "
            f"file or in the current folder (it is not in {', '.join(_folders)}). A sweep that is "
            "resumed from its storage has no file: resume it from the module's folder",
            name=top,
        )
    origin = spec.origin if spec else getattr(sys.modules[top], "__file__", "built-in")
    if origin is not None and is_installed(origin):
        for folder in map(Path, _folders):
            if (folder / f"{top}.py").is_file() or (folder / top / "__init__.py").is_file():
                raise ImportError(
                    f"module {top!r} of {folder} must have another name: Python has one of its own "
                    f"({origin})",
                    name=top,
                )


def is_installed(file: str) -> bool:
    """Whether a module's file is of Python itself or of an installed package."""
    path = Path(file)
    return not path.is_absolute() or any(map(path.resolve().is_relative_to, _installed()))


@cache
def _installed() -> tuple[Path, ...]:
    paths = sysconfig.get_paths()
    folders = [paths[name] for name in ("stdlib", "platstdlib", "purelib", "platlib")]
    folders += [*site.getsitepackages(), site.getusersitepackages()]
    folders += [one for one in sys.path if Path(one).name in {"site-packages", "dist-packages"}]
    return tuple({Path(one).resolve() for one in folders})
