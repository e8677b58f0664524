"""A run as one MCAP file, which Foxglove draws without set-up.

| topic | schema | content |
| --- | --- | --- |
| `/commands`, `/telemetry`, `/truth` | JSON | a message for each row of the table of that name |
| `/estimate`, `/rollouts` | JSON | the same, where they are recorded |
| `/motion` | JSON | speed, sideslip and yaw rate in display units, from the truth |
| `/tf` | foxglove.FrameTransforms | `world` → `car` → four wheels, one frame for each sonar |
| `/pose`, `/path` | foxglove.PoseInFrame, PosesInFrame | the car's pose, and its path so far |
| `/course`, `/car` | foxglove.SceneUpdate | once: walls as lines; the car, fixed to its frames |
| `/sonar/<mount>` | foxglove.LaserScan | each reading of a sonar as an arc over its cone |
| `/lidar` | foxglove.LaserScan | each reading of a lidar, its beams evenly over its field |

A message of a table has the table's columns, with the same digits as the CSV file. A column with an
empty cell is left out. JSON has no infinity. So a missing echo is the number 1e999, which reads as
infinity where numbers are doubles.

Log times are nanoseconds since time 0 of the run. Time 0 is the start of 1970.

Schemas: https://docs.foxglove.dev/docs/visualization/message-schemas/introduction
"""

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import foxglove
from foxglove import channels, messages
from foxglove.mcap import MCAPWriteOptions

from countersteer.car.car import Car, wheel_positions
from countersteer.runs.run import drawn_car

POSE_PERIOD = 0.01  # s between two poses, at least
PATH_PERIOD = 0.5  # s between two messages of the whole path, at least
MOST_PATH = 500  # poses in such a message
BEAMS = 9  # of the arc that shows a sonar's reading
POSE = ("time_s", "x_m", "y_m", "heading_rad")
VELOCITY = ("vx_mps", "vy_mps", "yaw_rate_radps")
MOTION = ("time_s", "speed_mps", "sideslip_deg", "yaw_rate_degps")
WORDS = ("direction",)  # columns that are not numbers

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
WALL, BODY, CABIN, TIRE = (
    messages.Color(r=r, g=g, b=b, a=1.0)
    for r, g, b in ((0.55, 0.6, 0.65), (0.89, 0.6, 0.17), (0.19, 0.23, 0.26), (0.11, 0.13, 0.16))
)
LEVEL = messages.Quaternion(w=1.0)

Cells = Sequence[Sequence[str]]  # rows of a table, as in its CSV file


class McapWriter:
    """Writes `run.mcap` piece by piece. The file is readable up to the last whole piece."""

    def __init__(
        self, path: Path, about: Mapping[str, Any], text: str, tables: Mapping[str, Sequence[str]]
    ) -> None:
        """Create or overwrite the file. `text` is that of `run.toml`, and is attached to the file.

        `about` is its content. `tables` gives the headers by name. This method and all later ones
        raise `OSError` if the file cannot be written.
        """
        self._path = path
        self._file = _File(path)
        self._context = context = foxglove.Context()  # channels close with it
        self._writer = foxglove.open_mcap(
            self._file,
            context=context,
            # Without seeking, a chunk is written whole. No length is filled in later.
            writer_options=MCAPWriteOptions(disable_seeking=True, compression_threads=0),
        )
        self._writer.attach(
            log_time=0,
            create_time=0,
            name="run.toml",
            media_type="application/toml",
            data=text.encode(),
        )
        self._tables = {
            name: _TableChannel(name, header, context) for name, header in tables.items()
        }
        self._scene: _Scene | None = None
        if {"x_m", "y_m", "heading_rad"} <= set(tables.get("truth", ())):
            self._scene = _Scene(about, tables, context)
        self._flush()

    def write(self, tables: Mapping[str, Cells]) -> None:
        """Append rows by table. No row may be earlier than those of the calls before."""
        what = [
            message
            for name, rows in tables.items()
            for message in self._tables[name].messages(rows)
        ]
        if self._scene is not None:
            what += self._scene.messages(tables)
        for time, log, message in sorted(what, key=lambda one: one[0]):
            log(message, log_time=time)
        self._flush()

    def close(self, summary: Mapping[str, Any] | None = None) -> None:
        """End the file with its index, and with the summary if there is one."""
        if summary is not None:
            self._writer.write_metadata("summary", {"summary.json": json.dumps(summary)})
        self._writer.close()
        self._file.close()
        self._check()

    def _flush(self) -> None:
        """End the chunk and pass it to the operating system."""
        self._writer.flush()
        self._check()

    def _check(self) -> None:
        if (error := self._file.error) is not None:
            raise OSError(error.errno, error.strerror, str(self._path)) from None


class _File:
    """An append-only file that keeps its first error, since the library would only print it."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._position = 0
        self.error: OSError | None = None

    def write(self, data: bytes | bytearray) -> int:
        self._try(lambda: self._file.write(data))
        self._position += len(data)
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        """The position of the end. The library asks for no other position."""
        del offset, whence
        return self._position

    def flush(self) -> None:
        self._try(self._file.flush)

    def close(self) -> None:
        self._try(self._file.close)

    def _try(self, step: Callable[[], Any]) -> None:
        try:
            step()
        except OSError as error:
            self.error = self.error or error


Timed = tuple[int, Callable[..., None], Any]  # log time, how to log it, message


class _TableChannel:
    """The topic of a table."""

    def __init__(self, name: str, header: Sequence[str], context: foxglove.Context) -> None:
        schema = {
            "title": f"countersteer.{name.title()}",
            "type": "object",
            "properties": {
                column: {"type": "string" if column in WORDS else "number"} for column in header
            },
            "required": ["time_s"],
        }
        self._log = foxglove.Channel(f"/{name}", schema=schema, context=context).log
        self._fields = [
            f'"{column}":"%s"' if column in WORDS else f'"{column}":%s' for column in header
        ]
        self._time = list(header).index("time_s")

    def messages(self, rows: Cells) -> Iterable[Timed]:
        for row in rows:
            fields = [f % cell for f, cell in zip(self._fields, row, strict=True) if cell]
            text = "{" + ",".join(fields) + "}"
            if "inf" in text:
                text = text.replace(":inf", ":1e999").replace(":-inf", ":-1e999")
            yield nanoseconds(float(row[self._time])), self._log, text


class _Scene:
    """The messages for the 3D panel, made from the rows of the tables."""

    def __init__(
        self,
        about: Mapping[str, Any],
        tables: Mapping[str, Sequence[str]],
        context: foxglove.Context,
    ) -> None:
        car = drawn_car(about)
        truth, telemetry = list(tables["truth"]), list(tables.get("telemetry", ()))
        self._pose = [truth.index(name) for name in POSE]
        self._steering = truth.index("steering_rad") if "steering_rad" in truth else None
        self._velocity = [truth.index(name) for name in VELOCITY if name in truth]
        self._motion = _TableChannel("motion", MOTION, context)
        self._next_pose = self._next_path = -math.inf
        self._poses: list[messages.Pose] = []
        self._frames = channels.FrameTransformsChannel("/tf", context=context).log
        self._here = channels.PoseInFrameChannel("/pose", context=context).log
        self._path = channels.PosesInFrameChannel("/path", context=context).log
        self._hubs = list(zip(WHEELS, *wheel_positions(car.body), strict=True))
        self._radii = (car.tires.front.radius,) * 2 + (car.tires.rear.radius,) * 2
        sonar = car.sensors.sonar
        self._mounts = [
            ("car", f"sonar_{name}", mount.x, mount.y, 0.0, mount.angle)
            for name, mount in zip(sonar.mount_names, sonar.mounts, strict=True)
        ]
        self._half_angle = float(sonar.half_angle)
        self._sonars = [
            (
                telemetry.index(f"sonar_{name}_m"),
                f"sonar_{name}",
                channels.LaserScanChannel(f"/sonar/{name}", context=context).log,
            )
            for name in sonar.mount_names
            if f"sonar_{name}_m" in telemetry
        ]
        lidar = car.sensors.lidar
        beams = [i for i, name in enumerate(telemetry) if name.startswith("lidar_")]
        self._beams: list[int] = beams if 0 < len(beams) == lidar.beams else []
        if self._beams:
            self._mounts.append(("car", "lidar", lidar.x, lidar.y, 0.0, lidar.angle))
            self._half_field = float(lidar.field) / 2 * (1 - 1 / lidar.beams)
            self._lidar = channels.LaserScanChannel("/lidar", context=context).log
        walls = about.get("course", {}).get("walls_m", [])
        if walls:
            scene = messages.SceneUpdate(entities=[_course(walls)])
            channels.SceneUpdateChannel("/course", context=context).log(scene, log_time=0)
        scene = messages.SceneUpdate(entities=_car(car))
        channels.SceneUpdateChannel("/car", context=context).log(scene, log_time=0)

    def messages(self, tables: Mapping[str, Cells]) -> Iterable[Timed]:
        for row in tables["truth"]:
            cells = [row[i] for i in self._pose]
            if all(cells) and (time := float(cells[0])) >= self._next_pose:
                self._next_pose = time + POSE_PERIOD - 1e-9
                steering = row[self._steering] if self._steering is not None else ""
                x, y, heading = map(float, cells[1:])
                yield from self._moved(time, x, y, heading, float(steering or 0))
                velocity = [row[i] for i in self._velocity]
                if len(velocity) == len(VELOCITY) and all(velocity):
                    vx, vy, yaw_rate = map(float, velocity)
                    slip, yaw_rate = math.degrees(math.atan2(vy, vx)), math.degrees(yaw_rate)
                    shown = (cells[0], *map(repr, (math.hypot(vx, vy), slip, yaw_rate)))
                    yield from self._motion.messages([shown])
        for row in tables.get("telemetry", ()):
            for column, frame, log in self._sonars:
                if row[column]:
                    ranges = [float(row[column])] * BEAMS
                    yield _scan(float(row[0]), frame, log, ranges, self._half_angle)
            if self._beams and row[self._beams[0]]:
                ranges = [float(row[i]) for i in self._beams]
                yield _scan(float(row[0]), "lidar", self._lidar, ranges, self._half_field)

    def _moved(
        self, time: float, x: float, y: float, heading: float, steering: float
    ) -> Iterable[Timed]:
        at, stamp = nanoseconds(time), timestamp(time)
        wheels = [
            ("car", frame, float(wx), float(wy), float(radius), turned)
            for (frame, wx, wy), radius, turned in zip(
                self._hubs, self._radii, (steering, steering, 0.0, 0.0), strict=True
            )
        ]
        # All frames each time, so that a viewer can begin anywhere in the run.
        frames = [
            messages.FrameTransform(
                timestamp=stamp,
                parent_frame_id=parent,
                child_frame_id=child,
                translation=messages.Vector3(x=float(fx), y=float(fy), z=float(fz)),
                rotation=turned_by(float(angle)),
            )
            for parent, child, fx, fy, fz, angle in (
                ("world", "car", x, y, 0.0, heading),
                *wheels,
                *self._mounts,
            )
        ]
        yield at, self._frames, messages.FrameTransforms(transforms=frames)
        pose = messages.Pose(position=messages.Vector3(x=x, y=y), orientation=turned_by(heading))
        self._poses.append(pose)
        yield at, self._here, messages.PoseInFrame(timestamp=stamp, frame_id="world", pose=pose)
        if time >= self._next_path:
            self._next_path = time + PATH_PERIOD - 1e-9
            thinned = self._poses[:: 1 + len(self._poses) // MOST_PATH]
            path = messages.PosesInFrame(timestamp=stamp, frame_id="world", poses=thinned)
            yield at, self._path, path


def _scan(
    time: float, frame: str, log: Callable[..., None], ranges: list[float], half: float
) -> Timed:
    """A scan of `ranges` (m), evenly from `half` (rad) right of a frame's x axis to `half` left."""
    scan = messages.LaserScan(
        timestamp=timestamp(time),
        frame_id=frame,
        pose=messages.Pose(position=messages.Vector3(), orientation=LEVEL),
        start_angle=-half,
        end_angle=half,
        ranges=ranges,
        intensities=[1.0] * len(ranges),
    )
    return nanoseconds(time), log, scan


def _course(walls: Sequence[Sequence[float]]) -> messages.SceneEntity:
    """The walls (x, y, x, y of their ends) as lines on the floor."""
    points = [
        messages.Point3(x=float(x), y=float(y)) for wall in walls for x, y in (wall[:2], wall[2:])
    ]
    lines = messages.LinePrimitive(
        type=messages.LinePrimitiveLineType.LineList,
        pose=messages.Pose(position=messages.Vector3(), orientation=LEVEL),
        thickness=0.03,
        points=points,
        color=WALL,
    )
    return messages.SceneEntity(timestamp=timestamp(0), frame_id="world", id="walls", lines=[lines])


def _car(car: Car) -> list[messages.SceneEntity]:
    """The car as cubes: body and cabin in its own frame, each wheel in that of its hub."""
    body, radius = car.body, float(car.tires.front.radius)
    length, width, center = float(body.length), float(body.width), float(body.center)

    def cube(
        x: float, z: float, size: tuple[float, float, float], color: messages.Color
    ) -> messages.CubePrimitive:
        return messages.CubePrimitive(
            pose=messages.Pose(position=messages.Vector3(x=x, z=z), orientation=LEVEL),
            size=messages.Vector3(x=size[0], y=size[1], z=size[2]),
            color=color,
        )

    def entity(name: str, cubes: list[messages.CubePrimitive]) -> messages.SceneEntity:
        return messages.SceneEntity(
            timestamp=timestamp(0), frame_id=name, id=name, frame_locked=True, cubes=cubes
        )

    inside = max(float(body.track) - float(car.tires.front.width), 0.5 * width)
    chassis = cube(center, 1.2 * radius, (length, min(width, inside), radius), BODY)
    cabin = cube(center - 0.08 * length, 2.1 * radius, (0.4 * length, 0.7 * inside, radius), CABIN)
    tires = (car.tires.front,) * 2 + (car.tires.rear,) * 2
    wheels = [
        entity(
            name,
            [cube(0, 0, (2 * float(t.radius), float(t.width), 2 * float(t.radius)), TIRE)],
        )
        for name, t in zip(WHEELS, tires, strict=True)
    ]
    return [entity("car", [chassis, cabin]), *wheels]


def nanoseconds(time: float) -> int:
    """The log time of a time of the run (s)."""
    return round(time * 1e9)


def timestamp(time: float) -> messages.Timestamp:
    """The log time in the form that messages need."""
    return messages.Timestamp(*divmod(nanoseconds(time), 10**9))


def turned_by(angle: float) -> messages.Quaternion:
    """A rotation about the vertical by `angle` (rad)."""
    return messages.Quaternion(z=math.sin(angle / 2), w=math.cos(angle / 2))
