"""Bags of ROS 1 and ROS 2 (sqlite3 and MCAP), by a mapping.

A table of the mapping (`from`) is a topic, or a type of messages that one topic has. A column is a
path in the message, such as `drive.speed` or `axes.1`; `bag_time` (ns) is when the recorder got it.
The reader is the library `rosbags`, an optional extra. Its limits are set here: see `docs/
decisions/rosbags.md`.
"""

import bz2
import contextlib
import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from countersteer.errors import InputError
from countersteer.reading.content import read_text, reading
from countersteer.reading.documents import LARGEST_YAML, yaml_mapping
from countersteer.reading.values import short, shown
from countersteer.runs.importers.imported import write_run
from countersteer.runs.importers.mapped import Find, converted
from countersteer.runs.importers.mapping import Recipe, read_mapping
from countersteer.runs.importers.messages import Types, WrongMessageError, bounded, numbers_of
from countersteer.runs.importers.tables import RecordTable

BAG_TIME = "bag_time"
LARGEST = 100e9  # bytes of a bag
LARGEST_CHUNK = 256_000_000  # bytes, unpacked; recorders write pieces of about 1 MB
MOST_MESSAGES = 2_000_000  # of a topic
LONGEST_DEFINITION = 100_000  # characters
SUFFIXES = (".bag", ".db3", ".mcap")
TYPE = re.compile(r"[A-Za-z]\w*/(msg/)?[A-Za-z]\w*")
# Bags of older releases of ROS 2 tell no definitions. These are of packages that race cars use;
# those of ROS itself come with the library.
DRIVE = ("steering_angle", "steering_angle_velocity", "speed", "acceleration", "jerk")
STATE = (
    *("float64 temp_fet", "float64 temp_motor", "float64 current_motor", "float64 current_input"),
    *("float64 avg_id", "float64 avg_iq", "float64 duty_cycle", "float64 speed"),
    *("float64 voltage_input", "float64 charge_drawn", "float64 charge_regen"),
    *("float64 energy_drawn", "float64 energy_regen", "int32 displacement"),
    *("int32 distance_traveled", "int32 fault_code", "float64 pid_pos_now", "int32 controller_id"),
    *("float64 ntc_temp_mos1", "float64 ntc_temp_mos2", "float64 ntc_temp_mos3"),
    *("float64 avg_vd", "float64 avg_vq"),
)
DEFINITIONS = {
    "ackermann_msgs/msg/AckermannDrive": "\n".join(f"float32 {name}" for name in DRIVE),
    "ackermann_msgs/msg/AckermannDriveStamped": "std_msgs/Header header\nAckermannDrive drive",
    "vesc_msgs/msg/VescState": "\n".join(STATE),
    "vesc_msgs/msg/VescStateStamped": "std_msgs/Header header\nVescState state",
}


def import_rosbag(log: Path, out: Path, mapping: Path | None) -> dict[str, Any]:
    """Write a bag as the run folder `out`/<name of the bag>. Returns a report for JSON.

    Keys of `mapping` replace those of `rosbag.toml`, which goes by the types of messages. Raises
    `InputError` if the library is missing, or if the file is no bag or is damaged.
    """
    try:
        from rosbags import highlevel  # noqa: F401  # only whether it is there
    except ModuleNotFoundError:
        raise InputError(
            f"{log}: bags need the library rosbags: pip install 'countersteer[bags]'"
        ) from None
    recipe = read_mapping(mapping, "rosbag")
    with reading(log):
        check_files(log)
        with opened(log) as bag:
            found = converted(log, "rosbag", recipe, tables_of(bag, log, recipe))
    return write_run(log, out, found)


def check_files(log: Path) -> None:
    """Raise `InputError` if a bag, or a file of its folder, is not a regular file to read."""
    files = [log]
    if log.is_dir():
        about = log / "metadata.yaml"
        told = yaml_mapping(read_text(about, LARGEST_YAML), str(about))
        found = told.get("rosbag2_bagfile_information")
        if not isinstance(found, dict):
            raise InputError(f"{about}: not a bag: it has no rosbag2_bagfile_information")
        if found.get("compression_mode") not in (None, "", "none", "NONE"):
            raise InputError(f"{log}: is packed: unpack it first (ros2 bag convert)")
        files = [path for path in sorted(log.iterdir()) if path.suffix in SUFFIXES]
    for path in files:
        known = os.stat(path)
        if not stat.S_ISREG(known.st_mode):
            raise InputError(f"{path}: cannot be read: it is no regular file")
        if known.st_size > LARGEST:
            raise InputError(f"{path}: cannot be read: it is larger than {LARGEST / 1e9:g} GB")
        if path.suffix not in SUFFIXES:
            raise InputError(f"{path}: not a bag: give a folder, or one of {', '.join(SUFFIXES)}")


@contextlib.contextmanager
def opened(log: Path) -> Iterator[Any]:
    """The open bag. What it unpacks is bounded."""
    import lz4.frame
    from rosbags import rosbag1, rosbag2
    from rosbags.rosbag1 import reader
    from rosbags.rosbag2 import storage_mcap

    from_lz4 = bounded(lz4.frame.LZ4FrameDecompressor, LARGEST_CHUNK)
    from_bz2 = bounded(bz2.BZ2Decompressor, LARGEST_CHUNK)
    from_zstd = bounded(storage_mcap.zstd.ZstdDecompressor, LARGEST_CHUNK)
    reader.decompressors.update(bz2=from_bz2, lz4=from_lz4)
    storage_mcap.DECOMPRESSORS.update(lz4=from_lz4, zstd=from_zstd)
    made: Any = rosbag1.Reader(log) if log.suffix == ".bag" else rosbag2.Reader(log)
    with made as bag:
        yield bag


def tables_of(bag: Any, log: Path, recipe: Recipe) -> Find:
    """The tables of a bag: the messages of a topic, as far as the mapping names their columns."""
    tables: dict[str, RecordTable | None] = {}

    def find(name: str) -> RecordTable | None:
        if name not in tables:
            connections = [c for c in bag.connections if name in (c.topic, *_names(c.msgtype))]
            topics = {c.topic for c in connections}
            if len(topics) > 1:
                known = short(", ".join(sorted(topics)))
                raise InputError(
                    f"{log}: {len(topics)} topics are {shown(name)}: name one in a mapping's "
                    f"'from': {known}"
                )
            tables[name] = _table(bag, log, connections, recipe.columns) if connections else None
        return tables[name]

    return find


def _names(kind: str) -> tuple[str, str]:
    """A type's names in ROS 2 and in ROS 1."""
    return kind, kind.replace("/msg/", "/")


def _table(bag: Any, log: Path, connections: list[Any], wanted: set[str]) -> RecordTable:
    """The messages of one topic."""
    topic, kind = connections[0].topic, connections[0].msgtype
    types = _types(log, connections[0])
    records: list[dict[str, Any]] = []
    names: dict[str, None] = {}
    for _, time, data in bag.messages(connections=connections):
        try:
            found = numbers_of(types, kind, bytes(data), log.suffix != ".bag")
        except WrongMessageError as error:
            raise InputError(f"{log}: {short(topic)}: {short(str(error))}") from None
        names |= dict.fromkeys(found)
        records.append({BAG_TIME: time} | {n: v for n, v in found.items() if n in wanted})
        if len(records) > MOST_MESSAGES:
            raise InputError(f"{log}: {short(topic)}: over {MOST_MESSAGES} messages: cut the bag")
    if not records:
        raise InputError(f"{log}: {short(topic)}: holds no messages")
    return RecordTable(f"{log}, {short(topic)}", records, (BAG_TIME, *names))


def _types(log: Path, connection: Any) -> Types:
    """The definitions for a topic: those that the bag tells, else the known ones."""
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    kind, told = connection.msgtype, connection.msgdef
    if not TYPE.fullmatch(kind):
        raise InputError(f"{log}: {shown(kind)} is no type of messages")
    if len(told.data) > LONGEST_DEFINITION:
        raise InputError(f"{log}: the definition of {short(kind)} is too long")
    found: dict[str, Any] = dict(get_typestore(Stores.EMPTY).fielddefs)  # times
    if told.format.name == "MSG":
        return found | get_types_from_msg(told.data, kind)
    if told.format.name == "IDL":
        for text in re.split(r"={80}\n", told.data):
            head, _, rest = text.partition("\n")
            found |= get_types_from_idl(rest if head.startswith("IDL: ") else text) if text else {}
        return found
    known: dict[str, Any] = dict(get_typestore(Stores.LATEST).fielddefs)
    for name, text in DEFINITIONS.items():
        known |= get_types_from_msg(text, name)
    if kind not in known:
        raise InputError(f"{log}: tells no definition of {short(kind)}, and it is not a known one")
    return known
