"""Donkeycar's tubs of version 2.

A tub is a folder. Its `manifest.json` holds five lines of JSON: the inputs, their types, metadata,
the tub's own metadata, and the catalogs with the indexes of deleted records. A catalog is a file
with a record in each line. `_timestamp_ms` is Unix time. Angle and throttle are in -1 to 1; an
angle to the right is positive, so the sign is turned.

Source of these facts: https://docs.donkeycar.com, donkeycar/parts/datastore_v2.py.
"""

from pathlib import Path
from typing import Any

from countersteer.errors import InputError
from countersteer.reading import values
from countersteer.reading.content import read_text, reading
from countersteer.reading.documents import json_object
from countersteer.reading.values import shown
from countersteer.runs.importers.mapped import import_mapped
from countersteer.runs.importers.mapping import read_mapping
from countersteer.runs.importers.tables import RecordTable

MANIFEST = "manifest.json"
LINES = 5  # of a manifest
LARGEST = 10  # MB, of a manifest
MOST_RECORDS, MOST_CATALOGS = 1_000_000, 10_000
MOST_KEYS = 100  # of a record
INDEX, TIME = "_index", "_timestamp_ms"


def import_donkeycar(log: Path, out: Path, mapping: Path | None) -> dict[str, Any]:
    """Write a tub as a run folder. Keys of `mapping` replace those of `donkeycar.toml`."""
    recipe = read_mapping(mapping, "donkeycar")
    tub = log.parent if log.name == MANIFEST else log
    with reading(tub):
        table = _table(tub, recipe.columns | {INDEX, TIME})
    return import_mapped(tub, out, "donkeycar", recipe, lambda name: None if name else table)


def _table(tub: Path, wanted: set[str]) -> RecordTable:
    """The wanted values of all records but the deleted ones, in the order of time."""
    paths, deleted = _catalogs(tub)
    records: list[dict[str, Any]] = []
    names: dict[str, None] = {}
    for path in paths:
        for number, line in enumerate(read_text(tub / path).splitlines(), start=1):
            if not line.strip("\0 "):
                continue
            where = f"{tub / path}, line {number}"
            record = json_object(line, where)
            values.number(record.get(TIME), f"{where}: {TIME}", 0, 1e15)
            index = values.whole(record.get(INDEX), f"{where}: {INDEX}", 0, 10**12)
            names |= dict.fromkeys(record)
            if len(names) > MOST_KEYS:
                raise InputError(f"{where}: {len(names)} keys, over {MOST_KEYS}")
            if index not in deleted:
                records.append({key: record[key] for key in wanted & record.keys()})
            if len(records) > MOST_RECORDS:
                raise InputError(f"{tub}: over {MOST_RECORDS} records: cut it into pieces")
    if not records:
        raise InputError(f"{tub}: holds no records")
    records.sort(key=lambda record: record[TIME])
    return RecordTable(str(tub), records, names)


def _catalogs(tub: Path) -> tuple[list[str], set[int]]:
    """Names of the catalogs, and the indexes of deleted records."""
    manifest = tub / MANIFEST
    lines = read_text(manifest, LARGEST).splitlines()
    if len(lines) < LINES:
        raise InputError(f"{manifest}: not a tub of version 2: it has no {LINES} lines of JSON")
    where = f"{manifest}, line {LINES}"
    told = json_object(lines[LINES - 1], where)
    paths = told.get("paths")
    if not isinstance(paths, list) or not 0 < len(paths) <= MOST_CATALOGS:
        raise InputError(f"{where}: paths must be a list of catalogs, not {shown(paths)}")
    for path in paths:
        if not isinstance(path, str) or Path(path).name != path:
            raise InputError(f"{where}: paths must name files of the tub, not {shown(path)}")
    deleted = told.get("deleted_indexes", [])
    if not isinstance(deleted, list):
        raise InputError(f"{where}: deleted_indexes must be a list, not {shown(deleted)}")
    return paths, {values.whole(one, f"{where}: deleted_indexes", 0, 10**12) for one in deleted}
