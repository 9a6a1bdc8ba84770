"""The fingerprint covers the sources, files and packages of an environment."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium as gym
import pytest

from music_rllib.config.run_settings import RunSettings
from music_rllib.envs import fingerprint as module
from music_rllib.envs.fingerprint import (
    Fingerprint,
    differences,
    digest_of,
    fingerprint_of,
    on_another_machine,
)
from music_rllib.envs.make import make_env
from music_rllib.envs.tasks import BUILT_IN_TASKS, search_in
from music_rllib.intrinsic.settings import IntrinsicSettings
from tests.processes import fresh

FILES = {
    "lab/__init__.py": "",
    "lab/envs/__init__.py": "import gymnasium as gym\n"
    "gym.register('Lab-v0', 'lab.envs.push:Push', additional_wrappers=("
    "gym.envs.registration.WrapperSpec('Scaled', 'lab_wrappers:Scaled', None),))\n",
    "lab/envs/push.py": "from ..base import Base\nclass Push(Base):\n    pass\n",
    "lab/base.py": "import gymnasium as gym, os\nfrom lab import rewards\n"
    "MODEL = os.path.join(os.path.dirname(__file__), 'assets', 'push.xml')\n"
    "class Base(gym.Env):\n    def reset(self):\n        import lab_late\n",
    "lab/rewards.py": "import importlib\nSHIFT = 'shift.json'\n"
    "helper = lambda: importlib.import_module('lab_dynamic')\n",
    "lab/assets/push.xml": '<mujoco><include file="robot.inc"/></mujoco>',
    "lab/assets/robot.inc": "<body/>",
    "lab/assets/meshes/finger.stl": "solid",
    "lab/shift.json": "{}",
    "lab/unused.py": "",
    "lab/notes.txt": "",
    "lab_wrappers.py": "import gymnasium as gym\nclass Scaled(gym.Wrapper):\n    pass\n",
    "lab_late.py": "",
    "lab_dynamic.py": "",
    "scene.txt": "",
    "lab.yaml": "",
    "results/nodes/a/x.xml": "",
    "results/work/b": "",
}
IMPORTED = ("lab", "lab_wrappers", "lab_late", "lab_dynamic")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.setattr("music_rllib.envs.tasks._folders", {})
    monkeypatch.setattr(sys, "path", [*sys.path])
    search_in(tmp_path)
    yield tmp_path
    for name in [name for name in sys.modules if name.partition(".")[0] in IMPORTED]:
        del sys.modules[name]
    gym.registry.pop("Lab-v0", None)


def now(folder: Path) -> Fingerprint:
    return fingerprint_of("lab.envs:Lab-v0", {"scene": str(folder / "scene.txt"), "size": 2})


def test_an_own_reward_is_part_of_the_environment_of_its_runs_only(folder: Path) -> None:
    (folder / "lab_late.py").write_text("import lab_dynamic\n")
    task = BUILT_IN_TASKS["FetchPush"]
    plain = RunSettings(task=task, variant="tac", seed=0)
    own = plain.model_copy(update={"intrinsic": IntrinsicSettings(reward="lab_late:Mine")})

    def of(run: RunSettings) -> Fingerprint:
        return fingerprint_of(task.env_id, task.env_kwargs, run.own_modules)

    before = of(own)
    new = {name for name in before.keys() - of(plain).keys() if name.startswith("source")}
    assert new == {"source lab_late.py", "source lab_dynamic.py"}
    assert (plain.code, own.code) == ("FetchPush", "FetchPush with lab_late")
    (folder / "lab_dynamic.py").write_text("x = 1\n")
    assert differences(before, of(own)) == ["lab_dynamic.py changed"]


def test_sources_models_and_packages_are_found(folder: Path) -> None:
    found = now(folder)
    packages = {name for name in found if name.startswith("package ")}
    assert packages == {"package gymnasium"}
    assert set(found) - packages == {
        "source lab/__init__.py",
        "source lab/envs/__init__.py",
        "source lab/envs/push.py",
        "source lab/base.py",
        "source lab/rewards.py",
        "source lab_wrappers.py",
        "source lab_late.py",
        "source lab_dynamic.py",
        "file lab/assets/push.xml",
        "file lab/assets/robot.inc",
        "file lab/assets/meshes/finger.stl",
        "file lab/shift.json",
        "file scene.txt",
    }


def test_files_of_the_same_name_are_told_apart(
    folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    outside = tmp_path_factory.mktemp("models")
    files = [outside / name / "model.xml" for name in ("robots", "scenes")]
    for file in files:
        file.parent.mkdir()
        file.write_text("<mujoco/>")

    def of() -> Fingerprint:
        return fingerprint_of("lab.envs:Lab-v0", {"files": [*map(str, files)]})

    before = of()
    for file in files:
        changed = before
        edited(file)
        before = of()
        assert differences(changed, before) == ["model.xml changed"]


def test_a_module_that_is_imported_later_is_not_imported(folder: Path) -> None:
    (folder / "lab_late.py").write_text("raise SystemExit('no display')\n")
    base = folder / "lab/base.py"
    base.write_text(base.read_text().replace("import lab_late", "from lab_late import Window"))
    assert "source lab_late.py" in now(folder)
    assert "lab_late" not in sys.modules


def test_folders_without_an_init_file_are_packages(folder: Path) -> None:
    (folder / "lab_late.py").write_text("from lab_tools.poses.grasp import top\n")
    (folder / "lab_tools/poses/grasp").mkdir(parents=True)
    (folder / "lab_tools/poses/grasp/top.py").write_text("")
    assert "source lab_tools/poses/grasp/top.py" in now(folder)


def crlf(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))


def edited(path: Path) -> None:
    path.write_text(path.read_text() + "#\n")


@pytest.mark.parametrize(
    ("name", "change", "line"),
    [
        ("lab/envs/push.py", edited, "lab/envs/push.py changed"),
        ("lab/rewards.py", edited, "lab/rewards.py changed"),
        ("lab_wrappers.py", edited, "lab_wrappers.py changed"),
        ("lab_late.py", edited, "lab_late.py changed"),
        ("lab_dynamic.py", edited, "lab_dynamic.py changed"),
        ("lab/assets/push.xml", edited, "lab/assets/push.xml changed"),
        ("lab/assets/robot.inc", edited, "lab/assets/robot.inc changed"),
        ("lab/assets/meshes/finger.stl", edited, "lab/assets/meshes/finger.stl changed"),
        ("lab/shift.json", Path.unlink, "lab/shift.json is no longer used"),
        ("scene.txt", edited, "scene.txt changed"),
        ("lab/unused.py", edited, None),
        ("lab/notes.txt", edited, None),
        ("lab.yaml", edited, None),
        ("results/nodes/a/x.xml", edited, None),
        ("lab/base.py", crlf, None),
    ],
)
def test_a_change_is_named(
    folder: Path, name: str, change: Callable[[Path], None], line: str | None
) -> None:
    before = now(folder)
    change(folder / name)
    after = now(folder)
    assert differences(before, after) == ([line] if line else [])
    assert (digest_of(before) == digest_of(after)) == (line is None)


def test_a_built_in_task_has_versions_of_packages_only(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = fingerprint_of("FetchPush-v4", {})
    assert set(before) == {"package gymnasium-robotics", "package mujoco"}
    assert fingerprint_of("FetchPush-v4", {"reward_type": "dense"}) == before
    assert set(fingerprint_of("Pusher-v5", {})) == {"package gymnasium", "package mujoco"}
    own = module._version
    monkeypatch.setattr(module, "_version", lambda name: "9" if name == "mujoco" else own(name))
    assert differences(before, fingerprint_of("FetchPush-v4", {})) == [
        f"mujoco {before['package mujoco']} -> 9"
    ]


def test_a_model_that_a_worker_generated_is_not_a_difference() -> None:
    driver = {"source lab.py": "a", "file a.xml": "1"}
    assert not on_another_machine(driver, {"source lab.py": "a", "file tmp1.xml": "2"})
    assert on_another_machine(driver, {"source lab.py": "b", "file a.xml": "2"}) == [
        "a.xml changed",
        "lab.py changed",
    ]


def test_a_module_that_is_missing_or_hidden_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("music_rllib.envs.tasks._folders", {})
    monkeypatch.setattr(sys, "path", [*sys.path])
    search_in(tmp_path)
    said = rf"no module 'lab_nowhere'.*{tmp_path}.*run\.yaml of `best`, in the module's folder"
    with pytest.raises(ModuleNotFoundError, match=said):
        make_env("lab_nowhere:Lab-v0")
    (tmp_path / "queue.py").write_text("raise RuntimeError('hidden')")
    with pytest.raises(ImportError, match=r"'queue' of .* must have another name: Python has one"):
        make_env("queue:Lab-v0")


@pytest.mark.parametrize("name", ["level.npy", "maps/level.npy"])
def test_a_file_beside_the_module_counts_wherever_the_sweep_is_started(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An environment opens `Path(__file__).parent / file`; `env_kwargs` has `file`."""
    level = folder / "lab" / name
    level.parent.mkdir(exist_ok=True)
    level.write_text("1")
    found = []
    for place in (folder / "lab", level.parent, folder, Path("/")):
        monkeypatch.chdir(place)
        found.append(fingerprint_of("lab.envs:Lab-v0", {"file": name}))
    assert [differences(found[0], one) for one in found[1:]] == [[], [], []]
    level.write_text("2")
    now_found = fingerprint_of("lab.envs:Lab-v0", {"file": name})
    assert differences(found[0], now_found) == [f"lab/{name} changed"]


def test_an_environment_inside_another_counts(folder: Path) -> None:
    """Its id is in a string: an own one, or one of Gymnasium with its simulator."""
    inner = folder / "lab_inner.py"
    inner.write_text("import gymnasium as gym\ngym.register('Inner-v0', gym.Env)\n")
    (folder / "lab_late.py").write_text(
        "import gymnasium as gym\n"
        "make = lambda: gym.Wrapper(gym.make('lab_inner:Inner-v0'))\n"
        "other = lambda: gym.make('Pusher-v5')\n"
        "gym.register('Lab-v0', make)\n"
    )
    before = fingerprint_of("lab_late:Lab-v0", {})
    assert "package mujoco" in before
    inner.write_text(inner.read_text() + "# changed\n")
    after = fingerprint_of("lab_late:Lab-v0", {})
    assert differences(before, after) == ["lab_inner.py changed"]


def test_a_reward_that_names_an_id_has_one_fingerprint(folder: Path) -> None:
    """Whatever its process has registered before; other processes compare it."""
    (folder / "lab_reward.py").write_text("SCALES = {'FetchPush-v4': 1.0}\n")
    code = (
        "from music_rllib.envs.fingerprint import fingerprint_of\n"
        "from music_rllib.envs.tasks import register_robotics\n"
        "first = fingerprint_of('FetchPush-v4', {}, ['lab_reward'])\n"
        "register_robotics()\n"
        "assert first == fingerprint_of('FetchPush-v4', {}, ['lab_reward'])\n"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])}
    fresh("-c", code, cwd=folder, env=environment)
