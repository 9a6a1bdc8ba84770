"""Play an environment before anything is trained, and find its problems."""

from __future__ import annotations

import contextlib
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from pydantic import BaseModel

from music_rllib.envs.beside import Beside
from music_rllib.envs.episodes import EARLY_END, END_AT_GOAL, Episode, Recording
from music_rllib.envs.features import beyond_observation
from music_rllib.envs.goal_functions import (
    augmentation_of,
    goal_end_of,
    goal_reward_of,
    moved_distance_of,
)
from music_rllib.envs.make import Env, episode_limit, make_env, reset_seed
from music_rllib.envs.played_values import FEWEST_EPISODES, PlayedValues
from music_rllib.envs.tasks import Task, closest
from music_rllib.envs.values import (
    GOAL_KEYS,
    BadNumberError,
    check_action_space,
    check_torch_type,
    flag_of,
    observation_sizes,
    shown,
    to_bounds,
)
from music_rllib.errors import first_line, one_line
from music_rllib.replay.buffer import GoalEnd, GoalReward
from music_rllib.replay.trajectories import ReplayLayout

EPISODE_SECONDS = 10.0
"""Time limit of an episode, which is cut there."""
MOST_STEPS, MOST_SECONDS = 20_000, 2.0
"""Limits of the further episodes that are played until a success and a second reward are seen."""
REPEATED_STEPS = 50
"""Number of steps that are compared after two resets with the same seed."""
_SIMILAR = 0.85
"""Similarity above which a key counts as misspelled."""


class Question(BaseModel):
    """A task, and what its runs use.

    That is the values of `replay.hindsight_episodes` of those with hindsight, whether one has
    MUSIC's or another intrinsic reward, and the names of the others.
    """

    task: Task
    hindsight: tuple[str, ...] = ()
    intrinsic: bool = False
    rewards: tuple[str, ...] = ()


class Played(NamedTuple):
    """An episode, and whether its last step terminated or truncated it."""

    episode: Episode
    ends: tuple[bool, bool]


class RefusedError(Exception):
    """The environment breaks a rule and is not played any longer; the message is one line."""


class Probe:
    """Play the environment of one task, and collect problems and remarks.

    `watch` is called with the name of each call of the environment, before it.
    """

    def __init__(self, question: Question, watch: Callable[[str], None]) -> None:
        self._task, self._hindsight, self._watch = question.task, question.hindsight, watch
        self._intrinsic, self._rewards = question.intrinsic, question.rewards
        self.problems: list[str] = []
        """Reasons to refuse the task."""
        self.remarks: list[str] = []
        """Other findings that a user should know."""
        self.sizes: list[int] = []
        """Numbers in an observation, a goal and an action; empty for unsupported spaces."""
        self._steps = 0
        self._keys: Counter[str] = Counter()
        self._unused: set[str] = set()
        self._reward: GoalReward | None = None
        self._end: GoalEnd | None = None
        self._terminates = False

    def run(self) -> None:
        """Make the environment, play it and close it."""
        task = self._task
        try:
            env: Env = self._call("make", make_env, task.env_id, **task.env_kwargs)
        except RefusedError as error:
            cause = str(error).removeprefix("make must not raise, it raised ")
            rule = "env_id must name an environment that can be made"
            self.problems.append(f"{rule}, got {task.env_id!r}: {cause}")
            return
        try:
            self._check(env)
        except RefusedError as error:
            self.problems.append(str(error))
        try:
            self._call("close()", type(env).close, env)  # the one of `make_env` does not raise
        except RefusedError as error:
            self.remarks.append(f"{error}; the exception is ignored")

    def _call(self, name: str, function: Callable[..., Any], /, *args: Any, **options: Any) -> Any:
        self._watch(name)
        try:
            return function(*args, **options)
        except BaseException as error:  # an environment may raise anything, also SystemExit
            *_, (frame, line) = traceback.walk_tb(error.__traceback__)
            place = f"{frame.f_code.co_filename}, line {line}"
            raise RefusedError(
                f"{name} must not raise, it raised {one_line(error)} ({place})"
            ) from error

    def _check(self, env: Env) -> None:
        task = self._task
        action, size, goal = self._spaces(env)
        self.sizes = [size, goal, int(action.shape[0])]
        self._layout = ReplayLayout(size, int(action.shape[0]), goal, task.horizon)
        self._values = PlayedValues(env.observation_space, size, goal)
        self.problems += beyond_observation(task.agent_indices, task.surrounding_indices, size)
        if (limit := episode_limit(env, task.horizon)) < task.horizon:
            # A registered function may return an environment with a limit inside, which this keeps.
            raised = f"; env_kwargs: {{max_episode_steps: {task.horizon}}} would raise that"
            self.problems.append(
                f"horizon must be <= {limit}, the environment's own limit, got {task.horizon}"
                f"{'' if 'max_episode_steps' in task.env_kwargs else raised}"
            )
        if self._hindsight and not goal:
            self.problems.append(
                "must have goals for replay.hindsight_k > 0, its observations have none; "
                "replay: {hindsight_k: 0} turns hindsight off, which some presets turn on"
            )
        least = {"diayn": 2, "discern": 1}
        self.problems += [
            f"must have goals of {least[name]} dimensions or more for intrinsic.reward {name}, "
            f"they have {goal}"
            for name in self._rewards
            if goal < least.get(name, 0)
        ]
        smallest, largest = task.seed_range
        self._try_seeds(env, smallest, largest)
        first = self._play(env, largest, actions=0)
        if self._hindsight and goal:
            self._check_goals(env, task.seed_range)
        self._check_symmetries(env, smallest)
        self._play(env, smallest, actions=1, steps=REPEATED_STEPS)
        if self._repeat(env, first, largest):
            self._check_second(env, first, task.seed_range)
        self._play_more(env)
        if (now := self._spaces(env)) != (action, size, goal):
            raise RefusedError(
                f"spaces must stay the same after reset(), got {action}, then {now[0]}"
            )
        try:
            check_torch_type()
        except ValueError as error:
            self.problems.append(str(error))
        self._add_remarks()

    def _spaces(self, env: Env) -> tuple[spaces.Box, int, int]:
        """The action space, and the sizes of observation and goal."""
        try:
            return check_action_space(env.action_space), *observation_sizes(env.observation_space)
        except ValueError as error:
            raise RefusedError(str(error).removeprefix("environment: ")) from None
        except Exception as error:
            rule = "must have action_space and observation_space before reset()"
            raise RefusedError(f"{rule}: {one_line(error)}") from error

    # -- calls of the environment ---------------------------------------------------------

    def _try_seeds(self, env: Env, smallest: int, largest: int) -> None:
        """Name `seed_range` if the environment refuses only some seeds."""
        if (refused := self._refusal(env, largest)) is None:
            return
        raised = refused.__cause__ is not None
        if raised and smallest < largest:
            largest_refused, refused = refused, self._refusal(env, smallest)
            if refused is None:
                raise RefusedError(
                    f"reset must accept all seeds of seed_range, {smallest} to {largest}: "
                    f"{largest_refused}; seed_range: [{smallest}, N] declares N as the largest"
                )
            with contextlib.suppress(BaseException):  # raised if the seed is not the reason
                env.reset()
                refused = RefusedError(
                    f"{refused}; reset() without a seed works: if only some seeds are allowed, "
                    "declare them with seed_range: [SMALLEST, LARGEST]"
                )
        raise refused

    def _refusal(self, env: Env, seed: int) -> RefusedError | None:
        try:
            self._reset(env, seed)
        except RefusedError as error:
            return error
        return None

    def _reset(self, env: Env, seed: int) -> Any:
        result = self._call(f"reset(seed={seed})", env.reset, seed=seed)
        if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], Mapping)):
            raise RefusedError(
                "reset() must return (observation, info) with a dictionary info, as Gymnasium's "
                f"environments do, got {shown(result)}"
            )
        if isinstance(result[0], Mapping) and isinstance(env.observation_space, spaces.Dict):
            self._unused |= result[0].keys() | env.observation_space.keys()
        return result[0]

    def _step(self, env: Env, action: Any) -> tuple[Any, Any, bool, bool, Mapping[Any, Any]]:
        try:
            result = self._call("step()", env.step, action)
        except RefusedError as error:
            if not isinstance(error.__cause__, ValueError | TypeError):
                raise
            # A wrapper of Gymnasium may have expected five values.
            try:
                result = env.unwrapped.step(action)
            except BaseException:
                raise error from None
            _check_step(result)
            raise
        return _check_step(result)

    def _check_goals(self, env: Env, seed_range: tuple[int, int]) -> None:
        self._watch(call := "compute_reward()")
        seed, _ = seed_range
        try:
            reward = goal_reward_of(env, seed_range)
            if "moved" in self._hindsight and self._task.moved_distance is None:
                moved_distance_of(env, reward, seed)
            self._watch(call := "compute_terminated()")
            self._end = goal_end_of(env, seed)
        except ValueError as error:
            self.problems.append(first_line(error))
        except BaseException as error:
            raise RefusedError(f"{call} raised {one_line(error)}") from error
        else:
            self._reward = reward

    def _check_symmetries(self, env: Env, seed: int) -> None:
        symmetries = self._task.symmetries
        parts = filter(None, (symmetries.mirror, *symmetries.translate))
        if self._layout.goal and any(part.positions and not part.goal for part in parts):
            self.remarks.append(
                "symmetries change positions and no entry of the goal: give `goal`, too, unless "
                "the goal is in other coordinates"
            )
        if not symmetries.kinds:
            return
        try:
            augmentation_of(
                symmetries, symmetries.kinds, self._layout, env, reward=self._reward, seed=seed
            )
        except ValueError as error:
            self.problems.append(first_line(error))

    # -- episodes -------------------------------------------------------------------------

    def _play(self, env: Env, seed: int, *, actions: int, steps: int | None = None) -> Played:
        """Play an episode of random actions, which `actions` seeds."""
        observation = self._reset(env, seed)
        recording = Recording(
            self._layout,
            name=f"after reset(seed={seed})",
            success=(self._task.success_key, False),
            goal_reward=self._reward,
            goal_end=self._end,
        )
        rng, end = np.random.default_rng(actions), time.monotonic() + EPISODE_SECONDS
        space = check_action_space(env.action_space)
        ended = terminated = truncated = False
        last = min(steps or self._layout.horizon, self._layout.horizon)
        try:
            recording.see(observation)
            self._values.see(observation)
            while recording.steps < last and not ended and time.monotonic() < end:
                action = rng.uniform(-1.0, 1.0, (1, self._layout.action)).astype(np.float32)
                result = self._step(env, to_bounds(action, space)[0])
                observation, reward, terminated, truncated, info = result
                self._keys.update(key for key in info if isinstance(key, str))
                recording.step(action[0], reward, info, observation)
                self._values.see(observation)
                self._values.reward(reward)
                ended = terminated or truncated
            self._steps += recording.steps
            self._terminates |= terminated
            episode = recording.finish(terminated=terminated)
        except BadNumberError as error:
            raise RefusedError(first_line(error)) from None
        self._values.end(episode.frames)
        return Played(episode, (terminated, truncated))

    def _differs(self, env: Env, played: Played, seed: int) -> int | None:
        """Play an episode again; the step from which on it differs."""
        first = played.episode
        again, ends = self._play(env, seed, actions=0, steps=min(REPEATED_STEPS, len(first)))
        steps = min(len(again), len(first))
        differs = (again.frames[: steps + 1] != first.frames[: steps + 1]).any(axis=1)
        differs[1:] |= again.rewards[:steps] != first.rewards[:steps]
        if again.successes is not None and first.successes is not None:
            differs[1:] |= again.successes[:steps] != first.successes[:steps]
        # It must end where the first one did. One that is cut after a time has not ended.
        differs[-1] |= ends != (played.ends if steps == len(first) else (False, False))
        return int(np.argmax(differs)) if differs.any() else None

    def _repeat(self, env: Env, first: Played, seed: int, name: str = "the second time it") -> bool:
        """Whether an episode is the same again; a remark otherwise."""
        if (at := self._differs(env, first, seed)) is None:
            return True
        self.remarks.append(
            f"reset(seed={seed}) must determine the episode; {name} differed from step {at} on. A "
            "resumed run will differ from an uninterrupted one, and runs with the same seed will "
            "differ from each other"
        )
        return False

    def _check_second(self, env: Env, first: Played, seed_range: tuple[int, int]) -> None:
        """Make a second environment in this process, as training does, and play both."""
        task, (smallest, largest) = self._task, seed_range
        try:
            second: Env = self._call("make", make_env, task.env_id, **task.env_kwargs)
        except RefusedError as error:
            rule = "training and evaluation need several environments in one process"
            raise RefusedError(f"{rule}: the second time, {error}") from error
        if self._repeat(second, first, largest, "a second environment's"):
            beside = Beside(env, second, smallest, generators=False)
            if (at := self._differs(beside, first, largest)) is None:
                beside = Beside(env, second, smallest, generators=True)
                self._repeat(beside, first, largest, "beside a second environment it")
            else:
                self.problems.append(
                    "environments in one process must not share state, as several are trained on: "
                    f"an episode beside that of a second environment differed from step {at} on"
                )
        second.close()

    def _play_more(self, env: Env) -> None:
        """Play until the success key and, with hindsight, enough goals and rewards were seen."""
        end, number = time.monotonic() + MOST_SECONDS, 2
        key = self._task.success_key
        while self._steps < MOST_STEPS and time.monotonic() < end:
            played = number - 2 >= FEWEST_EPISODES and self._values.rewards_differ
            enough = self._reward is None or played
            if enough and (key is None or key in self._keys or self._misspelled()):
                break
            seed = reset_seed(np.random.SeedSequence(number), self._task.seed_range)
            self._play(env, seed, actions=number)
            number += 1

    # -- findings -------------------------------------------------------------------------

    def _misspelled(self) -> str:
        """`closest` among the keys of every step, if one is nearly the success key."""
        always = [name for name, count in self._keys.items() if count == self._steps]
        return closest(self._task.success_key or "", always, _SIMILAR)

    def _add_remarks(self) -> None:
        """Name a missing success key, other types than declared, and unused parts."""
        key = self._task.success_key
        if key is not None and key not in self._keys:
            known = ", ".join(sorted(self._keys)) or "none"
            if hint := self._misspelled():
                self.problems.append(
                    f"success_key must be null or a key of info ({known}), got {key!r}{hint}"
                )
            else:
                self.remarks.append(
                    f"success_key {key!r} was not in info in {self._steps} random steps (keys: "
                    f"{known}){closest(key, self._keys)}; a step without it counts as not reached"
                )
        self.problems += self._values.problems(self._task.reward_range)
        self.remarks += self._values.remarks(hindsight=self._reward is not None)
        if self._terminates and self._reward is not None and self._end is None:
            self.remarks.append(END_AT_GOAL)
        if self._terminates and self._intrinsic:
            self.remarks.append(EARLY_END)
        if unused := self._unused - {*GOAL_KEYS}:
            self.remarks.append(
                f"the observation's {', '.join(sorted(unused))} is not used: the networks get "
                "observation and desired_goal"
            )


def _check_step(result: Any) -> tuple[Any, Any, bool, bool, Mapping[Any, Any]]:
    """The five values of a step; RefusedError for others."""
    rule = "step() must return (observation, reward, terminated, truncated, info)"
    if not isinstance(result, tuple) or len(result) != 5:
        number = f"{len(result)} values" if isinstance(result, tuple) else shown(result)
        old = ", as in gym before 0.26" if isinstance(result, tuple) and len(result) == 4 else ""
        raise RefusedError(f"{rule}, got {number}{old}")
    observation, reward, terminated, truncated, info = result
    if not isinstance(info, Mapping):
        raise RefusedError(f"{rule} with a dictionary info, got {shown(info)}")
    try:
        ends = flag_of(terminated, "step()'s terminated"), flag_of(truncated, "step()'s truncated")
    except ValueError as error:
        raise RefusedError(str(error)) from None
    return observation, reward, *ends, info
