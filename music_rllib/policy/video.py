"""Videos of a policy's episodes, rendered without a screen, as MP4 or GIF.

MuJoCo renders off-screen through EGL or OSMesa. Which of them works depends on the machine's
drivers, and a wrong choice can end the process, so each is tried in a process of its own.
"""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from music_rllib.envs.make import Env
from music_rllib.errors import BadInputError
from music_rllib.policy.policy import Policy, PolicyError
from music_rllib.policy.rollout import EpisodeResult, EpisodeStep, open_task, play

FORMATS = (".mp4", ".gif")
FRAMES_PER_SECOND = 20
SIZE = 320
"""Width and height of the picture in pixels, without the lines of text above and below."""
LINE = 26
HOLD = 12
"""Number of frames that repeat an episode's last picture."""

SUCCESS, NOT_YET, UNKNOWN = "#009E73", "#D55E00", "#666666"
"""Okabe and Ito's green and vermilion, and gray; a text repeats their meaning."""
DARK, LIGHT = "#1b1b1b", "#ffffff"

Frame = NDArray[np.uint8]


class VideoError(BadInputError, RuntimeError):
    """No video can be made; the message has the reason and a remedy."""


def film(
    policy: Policy, episodes: int, seed: int, title: str
) -> tuple[list[Frame], list[EpisodeResult]]:
    """Play and draw the episodes of `rollout.play` with this seed; `title` is written above.

    Returns:
        Pictures [height, width, 3], and the results of the episodes.

    Raises:
        VideoError: This machine or this environment can't draw.
        PolicyError: The environment can't be made.
    """
    frames: list[Frame] = []
    results: list[EpisodeResult] = []
    sizes = _sizes(policy)
    renderer, why_not = find_renderer(os.environ.get("MUJOCO_GL"))
    if renderer is not None:
        os.environ["MUJOCO_GL"] = renderer
    try:
        env = open_task(policy, render_mode="rgb_array", **sizes)
    except PolicyError:  # it may have a size of its own
        env = open_task(policy, render_mode="rgb_array")
    try:
        if why_not is not None and hasattr(env.unwrapped, "mujoco_renderer"):
            raise VideoError(why_not)

        def draw(step: EpisodeStep) -> None:
            heading = title if episodes == 1 else f"{title}  ·  episode {len(results) + 1}"
            frames.append(_draw(_picture(step.env), heading, step, policy.max_episode_steps))

        for result in play(policy, env, episodes, seed, draw):
            results.append(result)
            frames.extend([frames[-1]] * HOLD)
    finally:
        env.close()
    return frames, results


def _sizes(policy: Policy) -> dict[str, int]:
    """Size options if MuJoCo draws the environment, else none; a VideoError if nothing can."""
    env = open_task(policy)
    modes = env.metadata.get("render_modes") or []
    by_mujoco = hasattr(env.unwrapped, "mujoco_renderer")
    env.close()
    if "rgb_array" not in modes:
        raise VideoError(f"{policy.task.name} can't be drawn: it has no rgb_array rendering")
    return {"width": SIZE, "height": SIZE} if by_mujoco else {}


def _picture(env: Env) -> Image.Image:
    try:
        picture: Any = env.render()
    # Without a screen, drivers raise errors of any type.
    except Exception as error:
        raise VideoError(f"the scene can't be drawn: {error}") from error
    if picture is None:
        raise VideoError("the scene can't be drawn: the environment gives no picture")
    return Image.fromarray(np.asarray(picture, np.uint8)).convert("RGB")


def _draw(picture: Image.Image, title: str, step: EpisodeStep, limit: int) -> Frame:
    # MP4 stores colors for two by two pixels, so sizes must be even.
    width = (max(picture.width, SIZE) + 1) // 2 * 2
    height = (picture.height + 1) // 2 * 2
    sheet = Image.new("RGB", (width, height + 2 * LINE), DARK)
    sheet.paste(picture, ((width - picture.width) // 2, LINE))
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=13)
    pen.text((8, 5), title, fill=LIGHT, font=font)
    words, colour = {
        True: ("goal reached", SUCCESS),
        False: ("goal not reached", NOT_YET),
        None: ("", UNKNOWN),
    }[step.success]
    if step.step == 0 and step.distance is not None:
        words = "start"
    pen.rectangle((0, LINE + height, width, height + 2 * LINE), fill=colour)
    left = f"step {step.step} of {limit}"
    if step.distance is not None:
        left += f"  ·  goal {step.distance:.2f} away"
    pen.text((8, LINE + height + 5), left, fill=LIGHT, font=font)
    room = width - 8 - pen.textlength(words, font=font)
    pen.text((room, LINE + height + 5), words, fill=LIGHT, font=font)
    return np.asarray(sheet, np.uint8)


@functools.cache
def find_renderer(chosen: str | None = None) -> tuple[str | None, str | None]:
    """Try to render without a screen with `egl`, `osmesa`, or the user's own `MUJOCO_GL`.

    Returns the first name that works and None, or None and the reason why none works.
    """
    reasons = []
    for name in [chosen] if chosen else ["egl", "osmesa"]:
        environment = os.environ | {"MUJOCO_GL": name, "PYOPENGL_PLATFORM": name}
        try:
            done = subprocess.run(  # noqa: S603
                [sys.executable, "-c", _TRY],
                env=environment,
                capture_output=True,
                text=True,
                timeout=120,
                check=False,
            )
        except subprocess.TimeoutExpired:
            reasons.append(f"{name}: no answer")
            continue
        if done.returncode == 0:
            return name, None
        lines = done.stderr.strip().splitlines() or [f"ended with {done.returncode}"]
        reasons.append(f"{name}: {lines[-1]}")
    return None, (
        f"drawing without a screen does not work here ({'; '.join(reasons)}). Install EGL "
        "(Debian: apt-get install libegl1 libgl1-mesa-dri) or OSMesa (libosmesa6), or set MUJOCO_GL"
    )


_TRY = """
import mujoco
context = mujoco.GLContext(16, 16)
context.make_current()
model = mujoco.MjModel.from_xml_string("<mujoco/>")
mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value).free()
context.free()
"""


def check_video_file(path: Path) -> None:
    """Reject a file that can't be written, before minutes of episodes are played.

    Raises:
        BadInputError: The ending is not one of `FORMATS`, or the folder does not exist.
    """
    if path.suffix.lower() not in FORMATS:
        raise BadInputError(f"--video must end in {' or '.join(FORMATS)}, got {str(path)!r}")
    if not path.absolute().parent.is_dir():
        raise BadInputError(f"--video must be in a folder that exists, got {str(path)!r}")


def write_video(path: Path, frames: Sequence[Frame]) -> None:
    """Write `frames` in the format of the path's ending.

    Raises:
        VideoError: The ending is not one of `FORMATS`, there is no encoder, or the encoder fails.
    """
    if path.suffix.lower() == ".gif":
        _write_gif(path, frames)
    elif path.suffix.lower() == ".mp4":
        _write_mp4(path, frames)
    else:
        raise VideoError(f"a video must end in {' or '.join(FORMATS)}, got {path.name!r}")


def _write_gif(path: Path, frames: Sequence[Frame]) -> None:
    # One palette for all frames avoids flicker, and unchanged pixels take no space. It comes from
    # several frames, so that it has the colors of success and failure.
    samples = [frames[i] for i in np.linspace(0, len(frames) - 1, 6).astype(int)]
    palette = Image.fromarray(np.concatenate(samples)).quantize(160)
    pictures = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    ]
    pictures[0].save(
        path,
        format="GIF",
        save_all=True,
        append_images=pictures[1:],
        duration=1000 // FRAMES_PER_SECOND,
        loop=0,
    )


def _write_mp4(path: Path, frames: Sequence[Frame]) -> None:
    height, width, _ = frames[0].shape
    command = [_encoder(), "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]
    command += ["-s", f"{width}x{height}", "-r", str(FRAMES_PER_SECOND), "-i", "-", "-an"]
    command += ["-vcodec", "libx264", "-pix_fmt", "yuv420p", "-crf", "26"]
    command += ["-threads", "1", "-movflags", "+faststart", str(path)]
    data = b"".join(frame.tobytes() for frame in frames)
    done = subprocess.run(  # noqa: S603
        command, input=data, capture_output=True, check=False
    )
    if done.returncode:
        reason = done.stderr.decode(errors="replace").strip().splitlines()[-1:]
        raise VideoError(f"{path} could not be encoded: {' '.join(reason)}")


def _encoder() -> str:
    if system_ffmpeg := shutil.which("ffmpeg"):
        return system_ffmpeg
    try:
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        raise VideoError(
            "an .mp4 needs ffmpeg: install it, or pip install 'music_rllib[video]', or name a .gif"
        ) from None
