"""Writes a video, an animation and a strip of frames of episodes; started by ``dmprl record``.

``python -m dmprl.film PLAN``: PLAN is a JSON file that ``deploy/sweep/src/record`` writes. Progress
is reported on standard output, in the format of ``dmprl_shared::supervision``.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from typing import TypedDict

import numpy as np
from PIL import Image, ImageDraw, ImageFont

HEIGHT = 480
"""Height of a scene [pixels]; the width follows from its aspect ratio."""
BAR = 44
"""Height of the lines of text above and below a scene [pixels]."""
RETURN_AT = 100
"""Position of the return, to the right of the time [pixels]."""
GAP = 8
MARGIN = 12
GIF_HEIGHT = 360
GIF_COLOURS = 128
GIF_RATE_MAX = 25.0
"""Maximum frames per second of the animation, which would otherwise be larger than the video."""
STRIP_FRAMES = 6
STRIP_HEIGHT = 240
PAPER, INK, SOFT = "#ffffff", "#1a1a1a", "#5a5a5a"
GOOD, BAD = "#00704d", "#b04a00"
"""Distinguishable with colour blindness; the captions also contain the outcome as text."""


class Side(TypedDict):
    """One run's episode."""

    title: str
    success: str
    """Outcome of the episode; empty if the task does not report success."""
    goal: str
    """Appearance of the goal in the scene; empty if unknown."""
    frames: list[str]
    """Files of the pictures."""
    steps: list[int]
    """Number of steps executed before each frame."""
    rewards: list[float]
    success_by_step: list[bool | None]


class Plan(TypedDict):
    """The files to write, and the episodes in them."""

    episodes: list[list[Side]]
    """Episodes in order, each with one or two sides."""
    control_dt_s: float
    """Duration of a step [s]; 0 if the environment does not report it."""
    rate: float
    """Frames per second."""
    mp4: str
    gif: str
    strip: str


def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Returns Pillow's built-in font."""
    return ImageFont.load_default(size)


class Scenes:
    """The frames of one side."""

    def __init__(self, side: Side, dt: float) -> None:
        self.side = side
        self._dt = dt
        self._returns = np.concatenate([[0.0], np.cumsum(side["rewards"])])

    def __len__(self) -> int:
        return len(self.side["frames"])

    def scene(self, frame: int, height: int) -> Image.Image:
        """Returns the frame without text."""
        with Image.open(self.side["frames"][frame]) as picture:
            width = max(2, round(picture.width * height / picture.height))
            return picture.convert("RGB").resize((width, height), Image.Resampling.LANCZOS)

    def when(self, frame: int) -> str:
        """Formats the time, or the step if the duration of a step is unknown."""
        step = self.side["steps"][frame]
        return f"{step * self._dt:.2f} s" if self._dt > 0 else f"step {step}"

    def return_so_far(self, frame: int) -> str:
        """Formats the sum of the rewards up to this frame."""
        return f"return {self._returns[self.side['steps'][frame]]:.2f}"

    def succeeded(self, frame: int) -> bool | None:
        """Returns whether the last step up to this frame reported success."""
        step, flags = self.side["steps"][frame], self.side["success_by_step"]
        # Nothing is reported before the first step.
        return flags[step - 1] if flags and step > 0 else None

    def picture(self, frame: int) -> Image.Image:
        """Draws a frame with its title and captions; past the end, the last frame."""
        frame = min(frame, len(self) - 1)
        scene = self.scene(frame, HEIGHT)
        picture = Image.new("RGB", (scene.width, HEIGHT + 2 * BAR), PAPER)
        picture.paste(scene, (0, BAR))
        draw = ImageDraw.Draw(picture)
        middle = BAR // 2
        fitted(draw, (MARGIN, middle), self.side["title"], scene.width - 2 * MARGIN)
        below = HEIGHT + BAR + middle
        draw.text((MARGIN, below), self.when(frame), INK, font(18), anchor="lm")
        draw.text((RETURN_AT, below), self.return_so_far(frame), INK, font(18), anchor="lm")
        words, colour = self.goal(frame)
        draw.text((scene.width - MARGIN, below), words, colour, font(15), anchor="rm")
        return picture

    def goal(self, frame: int) -> tuple[str, str]:
        """Returns the caption about the goal at this frame, and its colour."""
        success, looks = self.succeeded(frame), self.side["goal"]
        if success is None:
            return (f"goal: {looks}" if looks else ""), SOFT
        words, colour = ("at the goal", GOOD) if success else ("not at the goal", BAD)
        return (f"{words} ({looks})" if looks else words), colour


def fitted(draw: ImageDraw.ImageDraw, at: tuple[int, int], text: str, width: int) -> None:
    """Writes text in the largest size that fits."""
    for size in (18, 16, 14, 12, 10):
        if draw.textlength(text, font(size)) <= width:
            break
    draw.text(at, text, INK, font(size), anchor="lm")


def beside(pictures: list[Image.Image]) -> Image.Image:
    """Joins pictures side by side, with even width and height as video requires."""
    width = sum(picture.width for picture in pictures) + GAP * (len(pictures) - 1)
    height = max(picture.height for picture in pictures)
    whole = Image.new("RGB", (width + width % 2, height + height % 2), PAPER)
    at = 0
    for picture in pictures:
        whole.paste(picture, (at, 0))
        at += picture.width + GAP
    return whole


def pictures(episodes: list[list[Scenes]]) -> Iterator[Image.Image]:
    """Yields every picture of the video; a side that has ended shows its last frame."""
    for sides in episodes:
        for frame in range(max(len(side) for side in sides)):
            yield beside([side.picture(frame) for side in sides])


def padded(picture: Image.Image, size: tuple[int, int]) -> Image.Image:
    """Pads a picture to the size of the first, because all frames of a video have one size."""
    if picture.size == size:
        return picture
    whole = Image.new("RGB", size, PAPER)
    whole.paste(picture, (0, 0))
    return whole


class Film:
    """A video and an animation in progress."""

    def __init__(self, plan: Plan, size: tuple[int, int]) -> None:
        import av  # may not be installed; the strip does not need it

        self._av = av
        self._size = size
        self._container = av.open(plan["mp4"], "w", options={"movflags": "+faststart"})
        rate = self._fraction(plan["rate"])
        self._stream = self._container.add_stream("libx264", rate=rate)
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"crf": "18", "preset": "medium"}
        self._every = max(1, round(plan["rate"] / GIF_RATE_MAX))
        self._duration_ms = 1000.0 * self._every / plan["rate"]
        self._animation: list[Image.Image] = []
        self._count = 0

    @staticmethod
    def _fraction(rate: float) -> object:
        from fractions import Fraction

        return Fraction(rate).limit_denominator(1000)

    def add(self, picture: Image.Image) -> None:
        """Adds one frame."""
        picture = padded(picture, self._size)
        frame = self._av.VideoFrame.from_ndarray(np.asarray(picture), format="rgb24")
        self._container.mux(self._stream.encode(frame))
        if self._count % self._every == 0:
            width = round(picture.width * GIF_HEIGHT / picture.height)
            small = picture.resize((width, GIF_HEIGHT), Image.Resampling.LANCZOS)
            self._animation.append(small.quantize(GIF_COLOURS, dither=Image.Dither.NONE))
        self._count += 1

    def close(self, gif: str) -> None:
        """Finishes the video and writes the animation."""
        self._container.mux(self._stream.encode(None))
        self._container.close()
        first, *others = self._animation
        first.save(
            gif,
            save_all=True,
            append_images=others,
            duration=self._duration_ms,
            loop=0,
            optimize=True,
        )


def strip(episodes: list[list[Scenes]]) -> Image.Image:
    """Draws some frames of each episode in a row, each with its time."""
    rows = [row(side) for sides in episodes for side in sides]
    width = max(row.width for row in rows)
    height = sum(row.height for row in rows)
    whole = Image.new("RGB", (width, height), PAPER)
    at = 0
    for picture in rows:
        whole.paste(picture, (0, at))
        at += picture.height
    return whole


def row(scenes: Scenes) -> Image.Image:
    """Draws an episode's row of the strip."""
    count = min(STRIP_FRAMES, len(scenes))
    frames = np.linspace(0, len(scenes) - 1, count).round().astype(int).tolist()
    shown = [scenes.scene(frame, STRIP_HEIGHT) for frame in frames]
    width = sum(scene.width for scene in shown) + GAP * (count - 1)
    whole = Image.new("RGB", (width, STRIP_HEIGHT + 2 * BAR), PAPER)
    draw = ImageDraw.Draw(whole)
    ended = scenes.return_so_far(len(scenes) - 1)
    if scenes.side["success"]:
        ended += f", {scenes.side['success']}"
    if scenes.side["goal"]:
        ended += f"    goal: {scenes.side['goal']}"
    draw.text((MARGIN, BAR // 2), scenes.side["title"], INK, font(18), anchor="lm")
    draw.text((width - MARGIN, BAR // 2), ended, INK, font(18), anchor="rm")
    at = 0
    for frame, scene in zip(frames, shown, strict=True):
        whole.paste(scene, (at, BAR))
        middle = (at + scene.width // 2, BAR + STRIP_HEIGHT + BAR // 2)
        draw.text(middle, scenes.when(frame), INK, font(16), anchor="mm")
        at += scene.width + GAP
    return whole


def main() -> None:
    """Writes the files of the plan."""
    with open(sys.argv[1], encoding="utf-8") as file:
        plan: Plan = json.load(file)
    episodes = [
        [Scenes(side, plan["control_dt_s"]) for side in sides] for sides in plan["episodes"]
    ]
    strip(episodes).save(plan["strip"], optimize=True)
    total = sum(max(len(side) for side in sides) for sides in episodes)
    film = None
    for done, picture in enumerate(pictures(episodes), start=1):
        if film is None:
            film = Film(plan, picture.size)
        film.add(picture)
        print(json.dumps({"filmed": {"done": done - (done == total), "of": total}}), flush=True)
    assert film is not None, "a plan has at least one episode, with at least one frame"
    film.close(plan["gif"])
    print(json.dumps({"filmed": {"done": total, "of": total}}), flush=True)


if __name__ == "__main__":
    main()
