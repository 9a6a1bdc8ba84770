"""Fingerprint of an environment: the source, model files and package versions that determine it.

A run's key is a hash of its settings, the same on every machine. The environment's results also
depend on its code, so a run keeps a *fingerprint*, from name to version or content hash:

    {"package gymnasium": "1.2.3", "source lab_env.py": "5b0c…", "file assets/arm.xml": "91d4…"}

- **Sources**: the module in front of the id, the modules of its entry point, of its classes and of
  the wrappers of its registration, the module of a user's own intrinsic reward, and all modules
  that these import. Modules that belong to Python or are installed do not count (an editable
  installation counts as source).
- **Files** in the folder of these modules, or of their package, and below: models (`MODELS`), and
  every other file whose name appears in the sources or in a model; also files that `env_kwargs`
  name.
- **Packages**: versions of those that hold the environment's classes or that the modules import.

Built-in tasks have the versions of Gymnasium-Robotics and MuJoCo only.
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import importlib
import importlib.metadata
import importlib.util
import itertools
import json
import os
import re
import sys
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib.machinery import PathFinder
from pathlib import Path, PurePosixPath
from typing import Any

import gymnasium as gym

from music_rllib.envs.tasks import BUILT_IN_TASKS, is_installed, make_importable, register_robotics

Fingerprint = Mapping[str, str]

MODELS = frozenset(
    {".xml", ".mjcf", ".mjb", ".urdf", ".sdf", ".xacro", ".stl", ".obj", ".msh", ".dae", ".ply"}
    | {".glb", ".gltf", ".usd", ".usda", ".usdc"}
)
"""Suffixes of files that describe bodies and scenes."""
MOST_ENTRIES = 5000
"""Maximum number of folder entries searched for the files of one module."""
MOST_BYTES = 64 * 2**20
"""A larger file is hashed by its beginning and its size."""
_WITHOUT_EFFECT = frozenset(
    {"music_rllib", "numpy", "matplotlib", "pygame", "PIL", "cv2", "imageio"}
)
"""Packages without an effect on results: they draw, or their versions compute the same."""
_PACKAGE, _SOURCE, _FILE = "package ", "source ", "file "


def fingerprint_of(
    env_id: str, env_kwargs: Mapping[str, Any], modules: Sequence[str] = ()
) -> Fingerprint:
    """The fingerprint of an environment; imports its module, but does not make the environment.

    `modules` are imported too, and their sources, files and packages are added.

    Raises:
        ImportError: A module is not found.
        gymnasium.error.Error: There is no such environment.
    """
    if env_id in {task.env_id for task in BUILT_IN_TASKS.values()}:
        found = {_PACKAGE + name: _version(name) for name in ("gymnasium-robotics", "mujoco")}
        if modules:
            register_robotics()  # their strings may name its ids
            found |= _fingerprint_of_modules(map(_imported, modules))
        return found | _files_of_arguments(env_kwargs)
    register_robotics()
    walk = _Walk(_relative_texts(env_kwargs))
    roots = [*_modules_of(env_id), *map(_imported, modules)]
    for text in _relative_texts(env_kwargs):
        walk.add_environment(text)
    found = _fingerprint_of_modules(roots, walk)
    return dict(sorted((found | _files_of_arguments(env_kwargs, walk.hashed)).items()))


def _fingerprint_of_modules(modules: Iterable[str], walk: _Walk | None = None) -> dict[str, str]:
    walk = walk or _Walk()
    for module in modules:
        walk.visit(module, is_root=True)
    return walk.packages | walk.sources | walk.files()


def _imported(module: str) -> str:
    make_importable(module)
    importlib.import_module(module)
    return module


def digest_of(fingerprint: Fingerprint) -> str:
    """A short hash of a fingerprint."""
    return _hash(json.dumps(dict(fingerprint), sort_keys=True).encode())


def differences(before: Fingerprint, after: Fingerprint) -> list[str]:
    """One line per difference, such as `lab_env.py changed` or `mujoco 3.8.0 -> 3.8.1`."""
    lines = []
    for name in sorted({**before, **after}):
        old, new = before.get(name), after.get(name)
        kind, _, what = name.partition(" ")
        if old == new:
            continue
        if old is None or new is None:
            lines.append(f"{what} is {'new' if old is None else 'no longer used'}")
        else:
            lines.append(f"{what} {old} -> {new}" if kind == "package" else f"{what} changed")
    return lines


def on_another_machine(driver: Fingerprint, worker: Fingerprint) -> list[str]:
    """Differences between a worker and its driver, without files that only one of them has.

    Environments may generate models. A worker that lacks a file fails when it opens the file.
    """
    alone = {name for name in driver.keys() ^ worker.keys() if name.startswith(_FILE)}
    return differences(
        {name: driver[name] for name in driver.keys() - alone},
        {name: worker[name] for name in worker.keys() - alone},
    )


def _modules_of(env_id: str) -> Iterator[str]:
    """Names of the modules that register the environment, define its classes and wrap it."""
    module = env_id.rpartition(":")[0]
    if module:
        yield _imported(module)
    with warnings.catch_warnings():  # `gymnasium.make` prints the warning about an old version
        warnings.simplefilter("ignore")
        spec = gym.envs.registration._find_spec(env_id)
    entries = [spec.entry_point, *(wrapper.entry_point for wrapper in spec.additional_wrappers)]
    for entry in (*entries, *spec.kwargs.values()):
        if isinstance(entry, str) and ":" in entry and entry in entries:
            yield entry.partition(":")[0]
            entry = gym.envs.registration.load_env_creator(entry)
        for one in getattr(entry, "__mro__", (getattr(entry, "func", entry),)):
            if isinstance(name := getattr(one, "__module__", None), str):
                yield name


class _Walk:
    """The modules that an environment depends on, found by following imports."""

    def __init__(self, texts: Iterable[str] = ()) -> None:
        """`texts` may name files, as strings in the sources do."""
        self.packages: dict[str, str] = {}
        self.sources: dict[str, str] = {}
        self._seen: set[tuple[str, bool]] = set()
        self._folders: dict[Path, Path] = {}
        """Folder of each module or package -> folder from which it is imported."""
        self._strings = {*texts}
        """All strings in the sources, and those given, which may name files."""
        self.hashed: set[Path] = set()
        """The files that `files` found."""

    def visit(self, name: str, *, is_root: bool = False) -> None:
        """Add a module, if one has this name, and what it imports."""
        top = name.partition(".")[0]
        if (name, is_root) in self._seen or top in _WITHOUT_EFFECT:
            return
        self._seen.add((name, is_root))
        file = _file_of(name if is_root or not self._is_elsewhere(top) else top)
        if file is None:
            return
        if not is_installed(str(file)):
            self._add_source(name, file)
        elif version := _version_of(top, file):
            self.packages |= version
            if is_root and file.suffix == ".py":
                # The packages that an installed class imports, such as its simulator.
                imports = _imports(_parsed(file.read_bytes()).body, _package(name, file))
                for other in {one.partition(".")[0] for one in imports} - _WITHOUT_EFFECT - {top}:
                    if (theirs := _file_of(other)) is not None and is_installed(str(theirs)):
                        self.packages |= _version_of(other, theirs)

    def _is_elsewhere(self, top: str) -> bool:
        file = _file_of(top)
        return file is not None and is_installed(str(file))

    def _add_source(self, name: str, file: Path) -> None:
        depth = name.count(".") + (file.stem == "__init__")
        root = file.parents[depth]
        data = file.read_bytes()
        self.sources[_SOURCE + file.relative_to(root).as_posix()] = _hash(
            data.replace(b"\r\n", b"\n") if file.suffix == ".py" else data
        )
        self._folders[root / name.partition(".")[0] if depth else root] = root
        if file.suffix != ".py":
            return
        tree = _parsed(data)
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                self._strings.add(node.value)
                self.add_environment(node.value)
        above = name.rpartition(".")[0]
        for other in (*([above] if above else []), *_imports(ast.walk(tree), _package(name, file))):
            self.visit(other)

    def add_environment(self, text: str) -> None:
        """Add the environment that a string names, such as one that a function wraps."""
        if _OWN_ID.fullmatch(text):
            self.visit(text.partition(":")[0])
        spec = gym.registry.get(text)
        if spec and str(spec.entry_point).startswith(("gymnasium.", "gymnasium_robotics.")):
            with contextlib.suppress(Exception):  # a package that it needs may not be installed
                for module in _modules_of(text):
                    self.visit(module, is_root=True)

    def files(self) -> dict[str, str]:
        """Hashes of models in the folders of the sources, and of files that these name."""
        found = {
            path: path.relative_to(root).as_posix()
            for folder, root in self._folders.items()
            for path in _entries(folder)
        }
        named = {PurePosixPath(text).name for text in self._strings if "." in text[-8:]}
        models = [path for path in found if path.suffix.lower() in MODELS]
        for path in (path for path in models if path.suffix.lower() in {".xml", ".urdf", ".mjcf"}):
            named |= {Path(one).name for one in _FILE_ATTRIBUTE.findall(_text(path))}
        wanted = {path: found[path] for path in found if path in models or path.name in named}
        for text, root in itertools.product(self._strings, self._folders):
            # A relative path such as `../assets/arm.xml`, or an absolute one.
            if "/" in text and "." in text[-8:] and "\n" not in text and len(text) < 500:
                path = Path(os.path.normpath(root / text))
                if path not in found and path.is_file():
                    wanted[path] = text
        found_now = {}
        for path, name in wanted.items():
            with contextlib.suppress(OSError):  # deleted meanwhile, as a generated model may be
                found_now[_FILE + name] = _hash_of(path)
                self.hashed.add(path.resolve())
        return found_now


_OWN_ID = re.compile(r"[A-Za-z_][\w.]*:[\w./-]+-v\d+")
"""An id with its module in front, such as `lab_env:Lab-v0`."""
_FILE_ATTRIBUTE = re.compile(r"""\b(?:file|filename)\s*=\s*["']([^"']+)["']""")


def _imports(nodes: Iterable[ast.AST], package: str) -> Iterator[str]:
    """Names that statements import: modules, and possibly attributes of modules."""
    for node in nodes:
        if isinstance(node, ast.Try):
            yield from _imports(node.body, package)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = package.rsplit(".", node.level - 1)[0]
                base = f"{above}.{base}" if base else above
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and node.args:
            called = getattr(node.func, "attr", getattr(node.func, "id", ""))
            name = getattr(node.args[0], "value", None)
            if called in {"import_module", "__import__"} and isinstance(name, str):
                yield name if not name.startswith(".") else f"{package}{name}"


def _parsed(data: bytes) -> ast.Module:
    """The syntax tree of a source; an empty one if this Python can't parse it."""
    try:
        return ast.parse(data)
    except (SyntaxError, ValueError):
        return ast.Module([], [])


def _package(name: str, file: Path) -> str:
    return name if file.stem == "__init__" else name.rpartition(".")[0]


def _file_of(name: str) -> Path | None:
    """The file of a module, which is not imported; None for built-in and missing ones."""
    package, *rest = name.split(".")
    try:
        spec = importlib.util.find_spec(package)
        for part in rest:
            if spec is None:
                return None
            locations = spec.submodule_search_locations
            folders = getattr(sys.modules.get(package), "__path__", locations)
            if folders is None:  # `from module import name`
                return None
            # By its last name, since a package without `__init__.py` needs an imported parent.
            spec = PathFinder.find_spec(part, [*folders])
            package = f"{package}.{part}"
    except (ImportError, ValueError, AttributeError):
        return None
    file = Path(spec.origin) if spec and spec.has_location and spec.origin else None
    return file if file and file.is_file() else None


@cache
def _version(distribution: str) -> str:
    return importlib.metadata.version(distribution)


def _version_of(top: str, file: Path) -> dict[str, str]:
    """The version of the distribution of an installed module; {} for Python's own modules."""
    if not {"site-packages", "dist-packages"} & {*file.parts}:
        return {}
    try:
        name = importlib.metadata.metadata(top)["Name"]
    except importlib.metadata.PackageNotFoundError:
        names = importlib.metadata.packages_distributions().get(top)
        if not names:
            return {}
        name = sorted(names)[0]
    return {_PACKAGE + re.sub(r"[-_.]+", "-", name).lower(): _version(name)}


def _entries(folder: Path) -> Iterator[Path]:
    """Files below a folder except Python's, breadth first."""
    left, folders = MOST_ENTRIES, [folder]
    while folders and left > 0:
        folder = folders.pop(0)
        try:
            entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
        except OSError:
            continue
        names = {entry.name for entry in entries}
        # The storage of a sweep, or a virtual environment.
        if {"nodes", "work"} <= names or "pyvenv.cfg" in names:
            continue
        left -= len(entries)
        for entry in entries:
            path = Path(entry.path)
            if entry.name.startswith((".", "__pycache__", "node_modules", "mlruns")):
                continue
            if entry.is_dir(follow_symlinks=False):
                folders.append(path)
            elif entry.is_file() and path.suffix not in {".py", ".pyc"}:
                yield path


def _relative_texts(arguments: Any) -> Iterator[str]:
    """Strings of an environment's arguments that may name files beside its modules."""
    if isinstance(arguments, str) and not arguments.startswith(("/", "~")):
        yield arguments
    elif isinstance(arguments, Mapping | list | tuple):
        for one in arguments.values() if isinstance(arguments, Mapping) else arguments:
            yield from _relative_texts(one)


def _files_of_arguments(arguments: Any, known: Collection[Path] = ()) -> dict[str, str]:
    """Hashes of the files that an environment's arguments name, without `known` ones.

    A file beside the environment's module is found wherever the sweep is started.
    """
    if isinstance(arguments, Mapping):
        arguments = list(arguments.values())
    if isinstance(arguments, list | tuple):
        found: dict[str, str] = {}
        parts = (_files_of_arguments(one, known).items() for one in arguments)
        for name, value in itertools.chain(*parts):
            # Files of different folders may have the same name.
            other = found.get(name, value)
            found[name] = (
                value if other == value else _hash("".join(sorted((other, value))).encode())
            )
        return found
    if not isinstance(arguments, str) or len(arguments) > 1000 or "." not in arguments:
        return {}
    path = Path(arguments).expanduser()
    try:
        is_new = path.is_file() and path.resolve() not in known
        return {_FILE + path.name: _hash_of(path)} if is_new else {}
    except (OSError, ValueError):
        return {}


def _text(path: Path) -> str:
    with path.open("rb") as file:
        return file.read(2**20).decode(errors="replace")


def _hash_of(path: Path) -> str:
    with path.open("rb") as file:
        data = file.read(MOST_BYTES)
    size = path.stat().st_size
    return _hash(data if size <= MOST_BYTES else data + str(size).encode())


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]
