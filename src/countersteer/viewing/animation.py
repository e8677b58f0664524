"""A run seen from above as an animation, GIF or MP4."""

import dataclasses
import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFont

from countersteer.car.car import wheel_positions
from countersteer.errors import InputError
from countersteer.runs.files import Table, drive_column
from countersteer.runs.run import Run, drawn_car
from countersteer.viewing import look, picture
from countersteer.viewing.style import INK, LINE, PAPER, SLIP_COLOURS, SOFT
from countersteer.viewing.view import motion_of
from countersteer.writing import whole

Array = NDArray[np.float64]

FINE = 3  # drawn pixels for each shown pixel, along each side
TRAIL_PERIOD = 0.02  # s between two points of the trail
FARTHEST, LONGEST = 1e6, 36_000.0  # m and rad of a pose, s of a run
OVERLAP = 25  # points of the old trail that are drawn again with a new piece
MARGIN = 0.35  # around the scene, in lengths of the car
FOLLOWED = 9.0  # width of a following camera's view, in lengths of the car
PANEL, HEAD, STRIP = 190, 44, 66  # px at a width of 640: side panel, its head, a strip below
TALLEST = 110  # px, largest height of a strip
GIF_COLOURS = 96
GIF_TICK = 0.01  # s, resolution of a frame's time in a GIF
PAINT = "#0a7fc2"  # of the car only


class Options(NamedTuple):
    """What to draw, and how."""

    width: int = 640  # px
    fps: float = 20.0
    speed: float = 1.0  # of playback, over that of the drive
    follow: bool = False  # the camera stays with the car
    begin: float = -math.inf  # s
    end: float = math.inf  # s


class Strip(NamedTuple):
    """One quantity over time."""

    name: str
    form: str  # format of a value
    time: Array
    values: Array
    colour: str


class Trail(NamedTuple):
    """The path, with pieces short enough to look smooth."""

    time: Array
    points: Array  # (n, 2), m
    colours: list[str]
    wheels: Array  # (4, n, 2) paths of the wheels, m
    marks: Array  # (4, n) darkness of each tyre's mark, 0 to 1


class Animation:
    """The frames of a run: `count`, at `moments` (s), of `size` pixels, for `duration` seconds."""

    def __init__(self, run: Run, options: Options) -> None:
        """Raises `InputError` if the run has no path, or none in the requested time."""
        if run.truth is None:
            raise InputError(f"{run.path}: has no truth.csv, so there is no path to draw")
        pose = np.column_stack([run.truth[name] for name in ("x_m", "y_m", "heading_rad")])
        known = np.all(np.abs(pose) <= FARTHEST, axis=1)  # false for NaN too
        truth = {
            name: np.where(np.abs(column[known]) <= FARTHEST, column[known], math.nan)
            for name, column in run.truth.items()
        }
        if np.sum(known) < 2:
            raise InputError(f"{run.path}/truth.csv: holds fewer than two poses")
        self._time, self._pose = truth["time_s"], pose[known]
        if self._time[-1] - self._time[0] > LONGEST:
            raise InputError(f"{run.path}: lasts over {LONGEST:g} s, too long to draw")
        self._pose[:, 2] = np.unwrap(self._pose[:, 2])
        begin = max(options.begin, float(self._time[0]))
        end = min(options.end, float(self._time[-1]))
        if not begin < end:
            raise InputError(
                f"{run.path}: nothing to draw between --from-s and --to-s: "
                f"the run goes from {self._time[0]:g} s to {self._time[-1]:g} s"
            )
        self.count = max(1, round((end - begin) / options.speed * options.fps))
        self.duration = self.count / options.fps
        self.options = options
        self.moments: Array = np.linspace(
            begin, begin + self.count * options.speed / options.fps, self.count, endpoint=False
        )
        self._car, self._walls = drawn_car(run.about), run.walls.reshape(-1, 2, 2)
        asked = run.commands
        self._steering = (
            truth["steering_rad"]
            if "steering_rad" in truth
            else held(self._time, asked["time_s"], asked["steering"])
        )
        # Motion capture tells poses alone: the velocities are their derivatives, as in the report.
        shown = motion_of(dataclasses.replace(run, truth=Table(truth)), self._car)
        strips = [
            Strip(name, form, shown["time_s"], shown[column], colour)
            for name, form, column, colour in (
                ("Speed", "{:.1f} m/s", "speed_mps", picture.SPEED),
                ("Sideslip", "{:.0f}°", "sideslip_deg", picture.SIDESLIP),
                ("Yaw rate", "{:.0f}°/s", "yaw_rate_degps", SOFT),
            )
            if column in shown
        ]
        slip = np.radians(shown["sideslip_deg"]) if "sideslip_deg" in shown else None
        if drive_column(asked) == "speed":
            name, unit, drive = "Commanded speed", "{:.1f} m/s", asked["speed"]
        else:
            name, unit, drive = "Throttle", "{:.0f} %", 100 * asked["throttle"]
        strips.append(Strip(name, unit, asked["time_s"], drive, SOFT))
        self._strips = strips
        self._trail = self._make_trail(truth, slip)
        self._place()
        self._font = {n: ImageFont.load_default(n * self._unit) for n in (12, 20)}

    def pixel(self, points: Array, pose: Array) -> Array:
        """The pixels of floor `points` (..., 2) in a frame in which the car is at `pose`."""
        centre = pose[:2] if self.options.follow else self._middle
        return np.array(self._floor) / 2 + (points - centre) * (1, -1) * self._scale

    def frames(self, moments: Array) -> Iterator[Image.Image]:
        """The frames at rising `moments` of the run (s), as RGB."""
        still, done = self._background(self._pose[0]), 1
        plain, drawn = self._panels()
        for moment in moments.tolist():
            pose = np.array([np.interp(moment, self._time, c) for c in self._pose.T])
            if self.options.follow:
                still, done = self._background(pose), 1
            now = int(np.searchsorted(self._trail.time, moment, side="right"))
            self._draw_trail(still, pose, done, now)
            done = max(done, now)
            floor = still.copy()
            self._draw_car(floor, pose, float(np.interp(moment, self._time, self._steering)))
            frame = Image.new("RGB", self.size, PAPER)
            frame.paste(floor.reduce(FINE), (0, 0))
            self._draw_panel(frame, plain, drawn, moment)
            yield frame

    # ---------------------------------------------------------------------------------------------
    # Content and layout
    # ---------------------------------------------------------------------------------------------

    def _make_trail(self, truth: dict[str, Array], slip: Array | None) -> Trail:
        """The path from the first moment to the last, coloured by `slip` (rad)."""
        time = np.arange(self.moments[0], self.moments[-1] + TRAIL_PERIOD, TRAIL_PERIOD)

        def at(column: Array) -> Array:
            return np.interp(time, self._time, np.nan_to_num(column))

        pose = np.column_stack([at(column) for column in self._pose.T])
        hubs = np.array(wheel_positions(self._car.body), float).T
        wheels = picture.placed(hubs, pose).swapaxes(0, 1)
        colours, marks = [SOFT] * len(time), np.zeros((4, len(time)))
        if slip is not None:
            end = max(math.radians(20), float(np.max(np.nan_to_num(np.abs(slip)))))
            colours = [ramp(part) for part in (np.abs(at(slip)) / end).tolist()]
        names = [f"wheel_{wheel}_radps" for wheel in ("fl", "fr", "rl", "rr")]
        if slip is not None and {"yaw_rate_radps", *names} <= set(truth):
            tires = (self._car.tires.front,) * 2 + (self._car.tires.rear,) * 2
            for k, (name, tire) in enumerate(zip(names, tires, strict=True)):
                vx = truth["vx_mps"] - truth["yaw_rate_radps"] * hubs[k, 1]
                vy = truth["vy_mps"] + truth["yaw_rate_radps"] * hubs[k, 0]
                angle = self._steering if k < 2 else 0.0 * vx
                along = np.cos(angle) * vx + np.sin(angle) * vy - truth[name] * float(tire.radius)
                sliding = np.hypot(along, np.cos(angle) * vy - np.sin(angle) * vx)
                full = look.SKID_FULL_MPS - look.SKID_FROM_MPS
                marks[k] = np.clip((at(sliding) - look.SKID_FROM_MPS) / full, 0, 1)
        return Trail(time, pose[:, :2], colours, wheels, marks)

    def _place(self) -> None:
        """Set sizes in pixels and the scale. The panel is beside the floor, or below a wide one."""
        length = float(self._car.body.length)
        corners = self._walls.reshape(-1, 2)
        seen = self._trail.points
        low = np.vstack([seen - length / 2, corners]).min(axis=0) - MARGIN * length
        high = np.vstack([seen + length / 2, corners]).max(axis=0) + MARGIN * length
        self._middle = (low + high) / 2
        extent = high - low
        if self.options.follow:
            extent = np.array([FOLLOWED, 0.75 * FOLLOWED]) * length
        width = 2 * (self.options.width // 2)
        self._unit = width / 640
        self._beside = bool(extent[0] < 1.8 * extent[1])
        across = width - round(PANEL * self._unit) if self._beside else width
        # Bounded, so that a tall picture fits on a page and a straight path has some height.
        high_px = round(across * float(np.clip(extent[1] / extent[0], 0.25, 1.3)))
        under = 0 if self._beside else round((HEAD + STRIP * len(self._strips)) * self._unit)
        self.size = (width, 2 * math.ceil((high_px + under) / 2))
        self._floor = (across, self.size[1] - under)
        self._scale = float(min(np.array(self._floor) / extent))

    def _boxes(self) -> list[tuple[int, int, int, int]]:
        """Left, top, right and bottom (px) of each strip's curve in the frame."""
        pad = round(14 * self._unit)
        left = self._floor[0] + pad if self._beside else pad
        top = (0 if self._beside else self._floor[1]) + round(HEAD * self._unit)
        pitch = min((self.size[1] - top) / len(self._strips), TALLEST * self._unit)
        text = round(20 * self._unit)
        return [
            (
                left,
                round(top + k * pitch) + text,
                self.size[0] - pad,
                round(top + (k + 1) * pitch) - pad,
            )
            for k in range(len(self._strips))
        ]

    # ---------------------------------------------------------------------------------------------
    # The floor
    # ---------------------------------------------------------------------------------------------

    def _background(self, pose: Array) -> Image.Image:
        """The floor with a grid of round lengths, and walls."""
        image = Image.new("RGB", (FINE * self._floor[0], FINE * self._floor[1]), picture.FLOOR)
        draw = ImageDraw.Draw(image)
        reach = np.array(self._floor) / 2 / self._scale
        centre = pose[:2] if self.options.follow else self._middle
        low, high = centre - reach, centre + reach
        step = picture.nice_step(float(max(high - low)) / 10)
        grid = mixed(picture.FLOOR, LINE, 0.55)
        for axis in (0, 1):
            for k in range(math.ceil(low[axis] / step), math.floor(high[axis] / step) + 1):
                ends = np.array([low, high])
                ends[:, axis] = k * step
                self._stroke(draw, self.pixel(ends, pose), grid, 1)
        width = max(2.0, 0.045 * self._scale)
        for wall in self.pixel(self._walls, pose):
            self._stroke(draw, wall, picture.WALL, width)
            for x, y in wall * FINE:
                radius = width * FINE / 2
                draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=picture.WALL)
        return image

    def _draw_trail(self, image: Image.Image, pose: Array, begin: int, end: int) -> None:
        """Draw the pieces of the trail that end at the points `begin` to `end`."""
        draw, trail = ImageDraw.Draw(image), self._trail
        wheels = self.pixel(trail.wheels, pose)
        points = self.pixel(trail.points, pose)
        tire = max(1.0, 0.8 * float(self._car.tires.rear.width) * self._scale)
        for track, marks in zip(wheels, trail.marks, strict=True):
            for k in range(begin, end):
                if marks[k] > 0:
                    dark = look.SKID_DARKEST * (0.25 + 0.75 * float(marks[k]))
                    colour = mixed(picture.FLOOR, INK, dark)
                    self._stroke(draw, track[k - 1 : k + 1], colour, tire)
        # Marks of the rear tyres cover earlier pieces of the path. So these are drawn again.
        width = max(1.5, 0.03 * self._scale)
        for k in range(max(1, begin - OVERLAP), end):
            self._stroke(draw, points[k - 1 : k + 1], trail.colours[k], width)

    @staticmethod
    def _stroke(draw: ImageDraw.ImageDraw, ends: Array, colour: str, width: float) -> None:
        points = [(float(x), float(y)) for x, y in ends * FINE]
        draw.line(points, fill=colour, width=max(1, round(width * FINE)))

    def _draw_car(self, image: Image.Image, pose: Array, steering: float) -> None:
        """Draw the body with its windows, and the wheels. The front ones turn by `steering`."""
        draw, body, tires = ImageDraw.Draw(image), self._car.body, self._car.tires

        def fill(outline: Array, colour: str) -> None:
            corners = self.pixel(picture.placed(outline, pose[None])[0], pose) * FINE
            draw.polygon([(float(x), float(y)) for x, y in corners], fill=colour)

        half = np.array([float(body.length), float(body.width)]) / 2
        centre = np.array([float(body.center), 0.0])
        fill(look.BODY * (half + 0.7 / self._scale) + centre, PAPER)
        fill(look.BODY * half + centre, PAINT)
        for window in (look.WINDSCREEN, look.REAR_WINDOW):
            fill(window * half + centre, picture.GLASS)
        tread = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
        sizes = (tires.front,) * 2 + (tires.rear,) * 2
        for k, (x, y, tire) in enumerate(zip(*wheel_positions(body), sizes, strict=True)):
            hub = np.array([[float(x), float(y), steering if k < 2 else 0.0]])
            size = (float(tire.radius), float(tire.width) / 2)
            fill(picture.placed(tread * size, hub)[0], INK)

    # ---------------------------------------------------------------------------------------------
    # The panel
    # ---------------------------------------------------------------------------------------------

    def _panels(self) -> tuple[Image.Image, Image.Image]:
        """The strips with faint curves, and with full ones."""
        made = []
        for strength in (0.22, 1.0):
            image = Image.new("RGB", (FINE * self.size[0], FINE * self.size[1]), PAPER)
            draw = ImageDraw.Draw(image)
            for strip, box in zip(self._strips, self._boxes(), strict=True):
                left, top, right, bottom = (FINE * n for n in box)
                ends = self.moments[0], max(self.moments[-1], self.moments[0] + 1e-3)
                time = np.linspace(*ends, 2 * (box[2] - box[0]))
                values = np.interp(time, strip.time, np.nan_to_num(strip.values))
                low, high = min(0.0, values.min()), max(0.0, values.max())
                span = max(high - low, 1e-3)
                x = left + (time - ends[0]) / (ends[1] - ends[0]) * (right - left)
                y = bottom - (values - low) / span * (bottom - top)
                zero = bottom + low / span * (bottom - top)
                colour = mixed(PAPER, strip.colour, strength)
                fill = mixed(PAPER, strip.colour, 0.16 * strength)
                curve = list(zip(x.tolist(), y.tolist(), strict=True))
                draw.polygon([(left, zero), *curve, (right, zero)], fill=fill)
                draw.line([(left, zero), (right, zero)], fill=LINE, width=FINE)
                draw.line(curve, fill=colour, width=round(1.6 * self._unit * FINE))
            made.append(image.reduce(FINE))
        return made[0], made[1]

    def _draw_panel(
        self, frame: Image.Image, plain: Image.Image, drawn: Image.Image, moment: float
    ) -> None:
        """Paste the strips, with full curves up to `moment`, and write the values at it."""
        draw = ImageDraw.Draw(frame)
        span = max(self.moments[-1] - self.moments[0], 1e-3)
        share = (moment - self.moments[0]) / span
        boxes, gap = self._boxes(), round(4 * self._unit)
        head = boxes[0][1] - round((HEAD + 8) * self._unit)
        draw.text((boxes[0][0], head), f"{moment:.2f} s", INK, self._font[20], anchor="la")
        for strip, (left, top, right, bottom) in zip(self._strips, boxes, strict=True):
            now = round(left + share * (right - left))
            region = (left, top - gap, right, bottom + gap)
            frame.paste(plain.crop(region), region[:2])
            region = (left, top - gap, now, bottom + gap)
            if now > left:
                frame.paste(drawn.crop(region), region[:2])
            draw.line([(now, top - gap), (now, bottom + gap)], fill=INK)
            value = float(np.interp(moment, strip.time, np.nan_to_num(strip.values)))
            shown = strip.form.format(value if abs(value) >= 0.5 else abs(value))
            draw.text((left, top - gap), strip.name, SOFT, self._font[12], anchor="ld")
            draw.text((right, top - gap), shown, INK, self._font[12], anchor="rd")


def held(time: Array, given: Array, values: Array) -> Array:
    """The last of `values` given by each time; before the first, the first."""
    return values[np.clip(np.searchsorted(given, time, side="right") - 1, 0, None)]


def mixed(one: str, other: str, part: float) -> str:
    """A colour between two, with `part` (0 to 1) of the other one."""
    pairs = zip(ImageColor.getrgb(one)[:3], ImageColor.getrgb(other)[:3], strict=True)
    return "#" + "".join(f"{round(a + (b - a) * part):02x}" for a, b in pairs)


def ramp(part: float) -> str:
    """The colour of a sideslip of `part` (0 to 1) of the largest, in 32 steps."""
    calm, middle, wild = SLIP_COLOURS
    place = round(32 * min(part, 1.0)) / 16
    return mixed(calm, middle, place) if place <= 1 else mixed(middle, wild, place - 1)


Told = Callable[[float, float], None]


def export(animation: Animation, path: Path, kind: str, told: Told) -> None:
    """Write all frames to `path` as `gif` or `mp4`. `told` receives the frames done, and in all.

    The file appears under its name when it is complete. Raises `InputError` if the library for MP4
    is missing, `OSError` if the file cannot be written.
    """
    with whole(path) as part:
        (write_gif if kind == "gif" else write_mp4)(animation, part, told)


def write_gif(animation: Animation, path: Path, told: Told) -> None:
    """Write a GIF that repeats. Frame times are whole hundredths of a second, exact on average."""
    ticks = np.round(np.arange(animation.count + 1) / animation.options.fps / GIF_TICK)
    times = (np.diff(ticks) * 1000 * GIF_TICK).astype(int).tolist()
    # One palette for all frames, from the last one, which has the whole trail.
    palette = next(animation.frames(animation.moments[-1:])).quantize(GIF_COLOURS)

    def mapped() -> Iterator[Image.Image]:
        for done, frame in enumerate(animation.frames(animation.moments), start=1):
            yield frame.quantize(palette=palette, dither=Image.Dither.NONE)
            told(done, animation.count)

    frames = mapped()
    first = next(frames)
    with path.open("wb") as file:
        first.save(file, "GIF", save_all=True, append_images=frames, duration=times, loop=0)


def write_mp4(animation: Animation, path: Path, told: Told) -> None:
    """Write an MP4 in H.264, with a colour format that every browser plays."""
    try:
        import av
    except ImportError:
        raise InputError(
            "--mp4 needs the library PyAV: pip install av (or take --gif, which needs nothing)"
        ) from None
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as file:
        rate = Fraction(animation.options.fps).limit_denominator(1000)
        stream = file.add_stream("libx264", rate=rate, options={"crf": "20", "preset": "fast"})
        stream.width, stream.height = animation.size
        stream.pix_fmt = "yuv420p"
        for done, frame in enumerate(animation.frames(animation.moments), start=1):
            file.mux(stream.encode(av.VideoFrame.from_image(frame)))
            told(done, animation.count)
        file.mux(stream.encode())
