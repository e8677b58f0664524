"""CSV files of any kind, by a mapping.

A log is a file, or a folder of files with a clock in common. Then each entry of the mapping names
its file (`from`).
"""

from pathlib import Path
from typing import Any

from countersteer.errors import InputError
from countersteer.reading.values import shown
from countersteer.runs.importers.mapped import Find, import_mapped
from countersteer.runs.importers.mapping import read_mapping
from countersteer.runs.importers.tables import TextTable


def import_csv(log: Path, out: Path, mapping: Path | None) -> dict[str, Any]:
    """Write a CSV log as the run folder `out`/<name of the log>. Returns a report for JSON.

    Raises `InputError` without a mapping, and if it does not fit the log.
    """
    if mapping is None:
        raise InputError(
            f"{log}: which columns are what? Give --map MAP.toml; countersteer import csv --guess "
            "LOG writes a first one"
        )
    return import_mapped(log, out, "csv", read_mapping(mapping), text_tables(log))


def text_tables(log: Path) -> Find:
    """The tables of a log: the file itself, or the files of a folder by their names."""
    loaded: dict[str, TextTable] = {}

    def find(name: str) -> TextTable | None:
        if name not in loaded:
            if log.is_dir():
                if not name:
                    raise InputError(
                        f"{log}: is a folder: each entry of the mapping needs a 'from'"
                    )
                if Path(name).name != name:
                    raise InputError(f"{log}: from must be a file of the folder, not {shown(name)}")
            if name and (not log.is_dir() or not (log / name).exists()):
                return None
            loaded[name] = TextTable(log / name if name else log)
        return loaded[name]

    return find
