"""Find the module of a user's environment.

`env_id: lab_env:Lab-v0` imports `lab_env` first. The module may be installed, be on PYTHONPATH, or
lie beside the sweep's file or in the current folder. These two folders are appended to `sys.path`
when a module is needed, so that a `random.py` there never replaces Python's own.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import site
import sys
import sysconfig
from functools import cache
from pathlib import Path

_folders: dict[str, None] = {}


def search_in(*folders: str | Path) -> None:
    """Add folders that `make_importable` searches."""
    with contextlib.suppress(FileNotFoundError):  # the current folder was deleted
        _folders.update(dict.fromkeys(str(Path(folder).absolute()) for folder in folders))


def folders_for_workers() -> tuple[str, ...]:
    """The folders for `search_in` in a worker.

    Folders below the current one are also given relative to it, since the working folder of a Ray
    job has the same content on every node, but not the same path.
    """
    search_in(".")
    with contextlib.suppress(FileNotFoundError):
        here = Path.cwd()
        below = [Path(one).relative_to(here) for one in _folders if Path(one).is_relative_to(here)]
        return (*_folders, *map(str, below))
    return tuple(_folders)


def make_importable(module: str) -> None:
    """Make a user's module importable from one of the folders, unless it is installed.

    Raises:
        ImportError: There is no such module, or an installed one has the same name.
    """
    search_in(".")
    sys.path += [folder for folder in _folders if folder not in sys.path]
    top = module.partition(".")[0]
    spec = None if top in sys.modules else importlib.util.find_spec(top)
    if spec is None and top not in sys.modules:
        raise ModuleNotFoundError(
            f"there is no module {top!r}: it must be installed, on PYTHONPATH, beside the sweep's "
            f"file or in the current folder (it is not in {', '.join(_folders)}). Start a "
            "resumed sweep, or the run.yaml of `best`, in the module's folder",
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
    """Whether a module's file belongs to Python or to an installed package."""
    path = Path(file)
    return not path.is_absolute() or any(map(path.resolve().is_relative_to, _installed()))


@cache
def _installed() -> tuple[Path, ...]:
    paths = sysconfig.get_paths()
    folders = [paths[name] for name in ("stdlib", "platstdlib", "purelib", "platlib")]
    folders += [*site.getsitepackages(), site.getusersitepackages()]
    folders += [one for one in sys.path if Path(one).name in {"site-packages", "dist-packages"}]
    return tuple({Path(one).resolve() for one in folders})


@cache
def register_robotics() -> None:
    """Register the robotics tasks with Gymnasium, without printing their package's notice.

    Raises:
        gymnasium.error.DependencyNotInstalled: MuJoCo can't be imported.
    """
    import gymnasium as gym

    drop_farama_notice()
    try:
        import gymnasium_robotics
    except Exception as error:  # of any type, if the machine lacks the renderer of MUJOCO_GL
        renderer = os.environ.get("MUJOCO_GL")
        if renderer is None:
            raise
        raise gym.error.DependencyNotInstalled(
            f"MuJoCo can't be loaded with MUJOCO_GL={renderer} ({error}): unset it, or install "
            "what it needs (Debian: libosmesa6 for osmesa, libegl1 for egl)"
        ) from error

    gym.register_envs(gymnasium_robotics)


def drop_farama_notice() -> None:
    """Remove the notice about the Adroit hand, which `gymnasium_robotics` prints on import."""
    try:
        import farama_notifications as farama
    except ImportError:
        return
    notice = getattr(farama, "GYMNASIUM_ROBOTICS_ADROIT_WARNING", None)
    versions = farama.notifications.get("gymnasium_robotics", {})
    for version in [version for version, text in versions.items() if text == notice]:
        del versions[version]
