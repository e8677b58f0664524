"""Bags of ROS: each is written here by another library than the one that reads it."""

import bz2
import math
import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from countersteer.errors import InputError
from countersteer.runs.importers import importer
from countersteer.runs.run import Run, read_run

pytest.importorskip("rosbags", reason="the library rosbags is not here (make bags)")
ros2 = pytest.importorskip("mcap_ros2.writer", reason="mcap-ros2-support is not here")

BEGIN, PERIOD = 1_700_000_000_000_000_000, 50_000_000  # ns
COUNT = 20
SEPARATOR = "=" * 80
HEADER = f"{SEPARATOR}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
TIME = f"{SEPARATOR}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
VECTOR = f"{SEPARATOR}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
QUATERNION = (
    f"{SEPARATOR}\nMSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
)
DEFINITIONS = {
    "ackermann_msgs/msg/AckermannDriveStamped": (
        "std_msgs/Header header\nAckermannDrive drive\n"
        f"{SEPARATOR}\nMSG: ackermann_msgs/AckermannDrive\nfloat32 steering_angle\n"
        "float32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\nfloat32 jerk\n"
    )
    + HEADER
    + TIME,
    "sensor_msgs/msg/Imu": (
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\n"
        "float64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\n"
        "float64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\n"
        "float64[9] linear_acceleration_covariance\n"
    )
    + HEADER
    + TIME
    + VECTOR
    + QUATERNION,
    "sensor_msgs/msg/Joy": "std_msgs/Header header\nfloat32[] axes\nint32[] buttons\n"
    + HEADER
    + TIME,
    "mine_msgs/msg/Wheels": "bool valid\nfloat32[2] rpm\nstring note\nint64 count\n",
}
TOPICS = {
    "/drive": "ackermann_msgs/msg/AckermannDriveStamped",
    "/imu": "sensor_msgs/msg/Imu",
    "/joy": "sensor_msgs/msg/Joy",
    "/wheels": "mine_msgs/msg/Wheels",
}
MAPPING = """
wheel_radius_m = 0.05
gear_ratio = 1
wheel_speed = { from = "/wheels", columns = ["rpm.0", "rpm.1"], unit = "rpm" }
"""


def messages() -> Iterator[tuple[str, int, dict[str, Any]]]:
    """A car that is asked for more and more speed, and turns left."""
    for i in range(COUNT):
        time = BEGIN + PERIOD * i
        head = {
            "stamp": {"sec": time // 10**9, "nanosec": time % 10**9},
            "frame_id": "base" + "x" * i,
        }
        drive = {"steering_angle": 0.1, "steering_angle_velocity": 0.0, "speed": 0.1 * i}
        yield "/drive", time, {"header": head, "drive": drive | {"acceleration": 0.0, "jerk": 0.0}}
        none = {"x": 0.0, "y": 0.0, "z": 0.0}
        imu = {
            "header": head,
            "orientation": none | {"w": 1.0},
            "angular_velocity": none | {"z": 0.5},
        }
        imu |= {f"{name}_covariance": [0.0] * 9 for name in ("orientation", "angular_velocity")}
        imu |= {"linear_acceleration": none, "linear_acceleration_covariance": [0.0] * 9}
        yield "/imu", time + 1000, imu
        yield "/joy", time, {"header": head, "axes": [0.0, 0.25, -0.5], "buttons": [1, 0]}
        wheels = {"valid": True, "rpm": [300.0, 330.0], "note": "ok" * i, "count": i}
        yield "/wheels", time, wheels


def encoded() -> Iterator[tuple[str, int, bytes]]:
    """The messages as ROS 2 writes them."""
    from mcap_ros2._dynamic import serialize_dynamic

    encoders = {kind: serialize_dynamic(kind, text)[kind] for kind, text in DEFINITIONS.items()}
    for topic, time, message in messages():
        yield topic, time, encoders[TOPICS[topic]](message)


def write_mcap(path: Path, compression: str = "ZSTD") -> None:
    from mcap.writer import CompressionType

    with path.open("wb") as file:
        writer = ros2.Writer(file, compression=getattr(CompressionType, compression))
        schemas = {kind: writer.register_msgdef(kind, text) for kind, text in DEFINITIONS.items()}
        for topic, time, message in messages():
            writer.write_message(topic, schemas[TOPICS[topic]], message, time, time)
        writer.finish()


def write_sqlite(path: Path, skip: tuple[str, ...] = ("/wheels",)) -> None:
    """As ROS 2 did until Humble: without definitions, so a topic of an own type cannot be read."""
    with sqlite3.connect(path) as base:
        base.execute(
            "CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
            "serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)"
        )
        base.execute(
            "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, "
            "timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
        )
        numbers = {topic: i for i, topic in enumerate(TOPICS, start=1) if topic not in skip}
        for topic, i in numbers.items():
            base.execute(
                "INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", (i, topic, TOPICS[topic])
            )
        for topic, time, data in encoded():
            if topic in numbers:
                row = (numbers[topic], time, data)
                base.execute(
                    "INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", row
                )
    base.close()


def ros1_record(head: dict[str, bytes], data: bytes = b"") -> bytes:
    fields = b"".join(
        struct.pack("<I", len(name) + 1 + len(value)) + name.encode() + b"=" + value
        for name, value in head.items()
    )
    return struct.pack("<I", len(fields)) + fields + struct.pack("<I", len(data)) + data


def ros1_drive(i: int) -> bytes:
    """An AckermannDriveStamped of ROS 1: its header counts, and nothing is aligned."""
    frame = b"base" + b"x" * i
    head = struct.pack("<IIII", i, 1, 2, len(frame)) + frame
    return head + struct.pack("<5f", 0.1, 0, 0.1 * i, 0, 0)


def write_ros1(path: Path, unpacked: bytes | None = None, kind: str | None = None) -> None:
    """A bag of version 2.0 with one packed chunk, its index, and one connection."""

    def number(size: str, *values: int) -> bytes:
        return struct.pack(f"<{size}", *values)

    kind = kind or "ackermann_msgs/AckermannDriveStamped"
    text = (
        "Header header\nAckermannDrive drive\n"
        f"{SEPARATOR}\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
        f"{SEPARATOR}\nMSG: ackermann_msgs/AckermannDrive\nfloat32 steering_angle\n"
        "float32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\nfloat32 jerk\n"
    )
    about = {"topic": b"/drive", "type": kind.encode(), "md5sum": b"*"}
    about |= {"message_definition": text.encode()}
    fields = ros1_record(about)[4:-4]
    connection = ros1_record({"op": b"\x07", "conn": number("I", 0), "topic": b"/drive"}, fields)
    chunk, index = connection, b""
    times = [divmod(BEGIN + PERIOD * i, 10**9) for i in range(COUNT)]
    for i, time in enumerate(times):
        index += number("III", *time, len(chunk))
        head = {"op": b"\x02", "conn": number("I", 0), "time": number("II", *time)}
        chunk += ros1_record(head, ros1_drive(i))
    packed = bz2.compress(chunk if unpacked is None else unpacked)
    start = 13 + 4096 + 8
    head = {"op": b"\x05", "compression": b"bz2", "size": number("I", len(chunk))}
    body = ros1_record(head, packed)
    head = {
        "op": b"\x04",
        "ver": number("I", 1),
        "conn": number("I", 0),
        "count": number("I", COUNT),
    }
    body += ros1_record(head, index)
    end = start + len(body)
    head = {"op": b"\x06", "ver": number("I", 1), "chunk_pos": number("Q", start)}
    head |= {"start_time": number("II", *times[0]), "end_time": number("II", *times[-1])}
    head |= {"count": number("I", 1)}
    tail = connection + ros1_record(head, number("II", 0, COUNT))
    first = {"op": b"\x03", "index_pos": number("Q", end), "conn_count": number("I", 1)}
    first |= {"chunk_count": number("I", 1)}
    filled = ros1_record(first)[:-4]
    filled += number("I", 4096 + 8 - len(filled) - 4)
    path.write_bytes(b"#ROSBAG V2.0\n" + filled.ljust(4096 + 8) + body + tail)


def imported(log: Path, mapping: str | None = None) -> Run:
    path = None
    if mapping is not None:
        path = log.parent / "map.toml"
        path.write_text(mapping)
    return read_run(Path(importer("rosbag", path)(log, log.parent / "runs")["run"]))


def check(run: Run) -> None:
    np.testing.assert_allclose(run.commands["time_s"], 0.05 * np.arange(COUNT), atol=1e-5)
    np.testing.assert_allclose(run.commands["speed"], 0.1 * np.arange(COUNT), atol=1e-6)
    np.testing.assert_allclose(run.commands["steering"], 0.1, atol=1e-6)


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_mcap_with_a_type_of_its_own(tmp_path, compression):
    write_mcap(tmp_path / "log.mcap", compression)
    run = imported(tmp_path / "log.mcap", MAPPING)
    check(run)
    speed = run.telemetry["wheel_speed_mps"]
    np.testing.assert_allclose(speed[np.isfinite(speed)], 2 * math.pi * 0.05 * 5.25, rtol=1e-6)
    assert np.nanmax(run.telemetry["gyro_radps"]) == 0.5


def test_a_joystick_is_a_throttle_by_a_mapping(tmp_path):
    write_mcap(tmp_path / "log.mcap")
    mapping = 'throttle = { from = "/joy", column = "axes.1", unit = "1" }\n'
    run = imported(tmp_path / "log.mcap", mapping)
    np.testing.assert_allclose(run.commands["throttle"], 0.25)


def test_sqlite_without_definitions_in_a_folder_and_as_a_file(tmp_path):
    folder = tmp_path / "log"
    folder.mkdir()
    write_sqlite(folder / "log_0.db3")
    check(imported(folder / "log_0.db3"))
    topics = "".join(
        f"  - topic_metadata: {{name: {topic}, type: {kind}, serialization_format: cdr, "
        f"offered_qos_profiles: ''}}\n    message_count: {COUNT}\n"
        for topic, kind in TOPICS.items()
        if topic != "/wheels"
    )
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 4\n  storage_identifier: sqlite3\n"
        "  relative_file_paths: [log_0.db3]\n  duration: {nanoseconds: 1000000000}\n"
        f"  starting_time: {{nanoseconds_since_epoch: {BEGIN}}}\n  message_count: {3 * COUNT}\n"
        "  compression_format: ''\n  compression_mode: ''\n"
        f"  topics_with_message_count:\n{topics}"
    )
    check(imported(folder))


def test_a_type_without_a_definition_is_named(tmp_path):
    write_sqlite(tmp_path / "log.db3", skip=())
    with pytest.raises(InputError, match="no definition of mine_msgs/msg/Wheels"):
        imported(tmp_path / "log.db3", MAPPING)


def test_a_bag_of_ros_1(tmp_path):
    write_ros1(tmp_path / "log.bag")
    mapping = 'wheel_speed = { from = "/drive", column = "drive.speed", unit = "m/s" }\n'
    run = imported(tmp_path / "log.bag", mapping)
    check(run)
    np.testing.assert_allclose(run.telemetry["wheel_speed_mps"], 0.1 * np.arange(COUNT), atol=1e-6)


@pytest.mark.parametrize(
    ("mapping", "says"),
    [
        ('speed = { from = "/nothing", column = "x", unit = "m/s" }', "has no '/nothing'"),
        ('speed = { from = "/imu", column = "speed", unit = "m/s" }', "no column 'speed'"),
        ('speed = { from = "/joy", column = "axes.7", unit = "m/s" }', "no column 'axes.7'"),
    ],
)
def test_a_topic_or_a_field_that_is_not_there_is_named(tmp_path, mapping, says):
    write_mcap(tmp_path / "log.mcap")
    with pytest.raises(InputError) as caught:
        imported(tmp_path / "log.mcap", mapping)
    assert says in str(caught.value)


def refusal(log: Path) -> str:
    with pytest.raises(InputError) as caught:
        imported(log)
    assert str(log) in str(caught.value)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 600
    return str(caught.value)


@pytest.mark.parametrize("suffix", [".bag", ".db3", ".mcap", ".txt"])
@pytest.mark.parametrize("content", [b"", b"\0" * 5000, b"#ROSBAG V2.0\n" + b"\xff" * 100])
def test_what_is_no_bag_is_refused(tmp_path, suffix, content):
    (tmp_path / f"log{suffix}").write_bytes(content)
    refusal(tmp_path / f"log{suffix}")


@pytest.mark.parametrize("name", ["log.bag", "log.db3", "log.mcap"])
def test_a_damaged_bag_is_read_or_refused(tmp_path, name):
    log = tmp_path / name
    {".bag": write_ros1, ".db3": write_sqlite, ".mcap": write_mcap}[log.suffix](log)
    whole = log.read_bytes()
    random = np.random.default_rng(1)
    refused = 0  # what the library raises is told as one line too
    for _ in range(30):
        length = random.integers(len(whole)) if random.random() < 0.5 else len(whole)
        content = bytearray(whole[:length])
        for place in random.integers(max(len(content), 1), size=min(8, len(content))):
            content[place] = random.integers(256)
        log.write_bytes(content)
        try:
            imported(log)
        except InputError:
            refused += 1
    assert refused > 10


def test_a_small_chunk_that_unpacks_to_a_huge_one_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("countersteer.runs.importers.rosbag.LARGEST_CHUNK", 1_000_000)
    write_ros1(tmp_path / "log.bag", bytes(20_000_000))
    assert "unpacks to over 1 MB" in refusal(tmp_path / "log.bag")


@pytest.mark.parametrize("kind", ["a/msg/b\nimport os", "os.system('x')/Y", "../x/Y"])
def test_the_name_of_a_type_is_a_name(tmp_path, kind):
    write_ros1(tmp_path / "log.bag", kind=kind)
    mapping = 'speed = { from = "/drive", column = "drive.speed", unit = "m/s" }\n'
    with pytest.raises(InputError, match="is no type of messages"):
        imported(tmp_path / "log.bag", mapping)
