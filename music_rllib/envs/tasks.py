"""Tasks: an environment, its horizon, and its split into agent and surrounding state.

MUSIC (paper III-A) needs to know which observation entries belong to the agent (x, for Fetch the
gripper's position) and which to its surroundings (y, the object's position). Users declare further
tasks in a sweep's YAML under `environments:`::

    environments:
      MyPush:
        env_id: my_package.envs:MyPush-v0   # a Gymnasium id; `module:` in front is imported first
        horizon: 100
        agent_indices: 0:3                  # or a list, [0, 1, 2]
        surrounding_indices: [3, 4, 5]

This module imports no environment; `music_rllib.envs.make` makes them.
"""

from __future__ import annotations

import contextlib
import difflib
import importlib.util
import os
import site
import sys
import sysconfig
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Self

from pydantic import (
    Field,
    JsonValue,
    field_validator,
    model_validator,
)

from music_rllib import names
from music_rllib.envs.features import Indices, Mirror, Symmetries, Translation, check_split
from music_rllib.schedules import Plain, StrictModel

LAST_SEED = 2**31 - 1
"""Largest seed of a reset: environments often keep it in a signed 32-bit integer."""
Seed = Annotated[int, Field(ge=0, le=LAST_SEED)]


class Task(StrictModel):
    """One environment as experiments see it."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=80)
    """Name in sweeps, labels and reports. Does not influence results."""
    env_id: str = Field(min_length=1)
    """Gymnasium id, with `module:` in front if that module registers it."""
    horizon: int = Field(gt=0)
    """Steps per episode; the environment is truncated there."""
    agent_indices: Indices = ()
    """Entries of the observation (of `observation["observation"]` if it is a goal dict) that are
    the agent state x: a list of positions, or a range such as `0:3`."""
    surrounding_indices: Indices = ()
    """Entries that are the surrounding state y. If both are empty, the task can't be used with
    MUSIC."""
    success_key: str | None = "is_success"
    """Key of `info` that reports success; a step without the key is not a success. null: the
    environment does not define success."""
    env_kwargs: dict[str, Plain] = Field(default_factory=dict)
    """Arguments of `gymnasium.make`, as YAML reads them: `1e2` is the float 100.0. Only
    `max_episode_steps: 1e2` becomes an integer."""
    reward_range: tuple[float, float] | None = None
    """Smallest and largest reward of a step; null: not known. Changes no result; it serves to
    detect diverged critics and to score failed runs."""
    seed_range: tuple[Seed, Seed] = (0, LAST_SEED)
    """Smallest and largest seed that the environment's `reset` accepts."""
    mi_reward_weight: float = Field(1.0, ge=0)
    """Default weight of the intrinsic reward in MUSIC-r."""
    moved_distance: float | None = Field(None, gt=0)
    """Distance in the goal's units from which the achieved goal has moved, for
    `replay.hindsight_episodes: moved`. null: it has moved if a sparse reward changes; with dense
    rewards a fifth of the environment's `distance_threshold`."""
    symmetries: Symmetries = Symmetries()
    """Symmetries of the environment, for `replay.symmetries`."""

    @field_validator("env_kwargs")
    @classmethod
    def _whole_steps(cls, value: dict[str, JsonValue]) -> dict[str, JsonValue]:
        steps = value.get("max_episode_steps")
        whole = isinstance(steps, float) and steps.is_integer()
        return {**value, "max_episode_steps": int(steps)} if whole else value  # type: ignore[arg-type]

    @model_validator(mode="after")
    def _split_is_sound(self) -> Self:
        check_split(self.agent_indices, self.surrounding_indices)
        return self

    @model_validator(mode="after")
    def _range_is_ordered(self) -> Self:
        if self.reward_range is not None and self.reward_range[0] > self.reward_range[1]:
            raise ValueError(f"reward_range must be [smallest, largest], got {self.reward_range}")
        if self.seed_range[0] > self.seed_range[1]:
            raise ValueError(f"seed_range must be [smallest, largest], got {self.seed_range}")
        return self

    @property
    def primary_metric(self) -> str:
        """Metric by which runs are compared: success rate, or return without a success key."""
        return names.primary_metric(self.success_key)

    @property
    def has_split(self) -> bool:
        """Whether the task has agent and surrounding state, which MUSIC needs."""
        return bool(self.surrounding_indices)

    def identity(self) -> dict[str, Any]:
        """Settings that define the task, without its name and its training settings.

        The default `seed_range` is omitted: run keys are older than this setting.
        """
        excluded = {"name", "reward_range", "mi_reward_weight", "moved_distance", "symmetries"}
        if self.seed_range == (0, LAST_SEED):
            excluded.add("seed_range")
        return self.model_dump(mode="json", exclude=excluded)


_SPARSE = (-1.0, 0.0)
"""Rewards of the built-in tasks: 0 at the goal, -1 elsewhere."""


def _fetch(name: str, *, split: bool = True, mi_reward_weight: float = 1.0) -> Task:
    # Observation: positions of gripper, object, and object relative to gripper; fingers; angles,
    # velocities, and angular velocities of the object; velocities of gripper and fingers. Reach has
    # no object. The table is symmetric about y = 0.75, in front of the robot.
    mirror = (
        Mirror(
            positions=(1, 4), goal=(1,), plane=0.75, signs=(7, 11, 13, 15, 17, 19, 21), action=(1,),
            swap=((9, 10), (23, 24)),
        )
        if split
        else Mirror(
            positions=(1,), goal=(1,), plane=0.75, signs=(6,), action=(1,), swap=((3, 4), (8, 9))
        )
    )  # fmt: skip
    moves = [
        Translation(positions=(axis, axis + 3) if split else (axis,), goal=(axis,), distance=0.1)
        for axis in (0, 1)
    ]
    return Task(
        name=name,
        env_id=f"{name}-v4",
        horizon=50,
        agent_indices=(0, 1, 2) if split else (),
        surrounding_indices=(3, 4, 5) if split else (),
        reward_range=_SPARSE,
        mi_reward_weight=mi_reward_weight,
        symmetries=Symmetries(mirror=mirror, translate=tuple(moves)),
    )


BUILT_IN_TASKS: Mapping[str, Task] = MappingProxyType(
    {
        task.name: task
        for task in (
            # Reach has no object; observation[3:6] are fingers and velocity.
            _fetch("FetchReach", split=False),
            _fetch("FetchPush"),
            _fetch("FetchPickAndPlace"),
            # The original MUSIC halves the weight on Slide.
            _fetch("FetchSlide", mi_reward_weight=0.5),
            # Observation: 24 joint angles, their 24 velocities, the object's 6 velocities and its
            # pose. The split uses only the position, so that distances of surrounding states are in
            # meters.
            Task(
                name="HandManipulateBlock",
                env_id="HandManipulateBlock-v1",
                horizon=100,
                agent_indices=tuple(range(24)),
                surrounding_indices=(54, 55, 56),
                reward_range=_SPARSE,
            ),
            Task(
                name="PointCarry",
                env_id="music_rllib.envs.point_carry:PointCarry-v0",
                horizon=50,
                agent_indices=(0, 1),
                surrounding_indices=(2, 3),
                reward_range=_SPARSE,
                mi_reward_weight=0.5,
            ),
        )
    }
)
"""Tasks of Gymnasium-Robotics, and PointCarry; tests compare each with its environment."""


def closest(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """`" (did you mean 'FetchPush'?)"`, or an empty string if no known name is similar."""
    by_folded = {candidate.casefold(): candidate for candidate in known}
    matches = difflib.get_close_matches(name.casefold(), by_folded, n=1, cutoff=cutoff)
    return f" (did you mean {by_folded[matches[0]]!r}?)" if matches else ""


# Modules of environments --------------------------------------------------------------------------
# `env_id: lab_env:Lab-v0` imports `lab_env` first. The module may be installed, be on PYTHONPATH,
# or lie beside the sweep's file or in the current folder. These two folders are appended to
# `sys.path` when a module is needed, so that a `random.py` there never replaces Python's own.

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
    drop_farama_notice()
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
    """Remove the notices that `gymnasium_robotics` prints on import."""
    with contextlib.suppress(ImportError):
        import farama_notifications

        farama_notifications.notifications.pop("gymnasium_robotics", None)
