"""A person's mark on a run, in its folder: good or bad."""

from pathlib import Path

from countersteer.errors import InputError
from countersteer.reading.values import shown
from countersteer.text import tables_of, toml_of
from countersteer.writing import write_whole

GOOD, BAD, NONE = "good", "bad", "none"
FILE = "mark.toml"


def read_mark(folder: Path) -> str:
    """The mark of a run; `none` without one. Raises `InputError` if the file is wrong."""
    file = folder / FILE
    if not file.exists():
        return NONE
    found = tables_of(file.read_text(encoding="utf-8", errors="replace")[:1000], str(file))
    mark = found.get("mark")
    if mark not in (GOOD, BAD):
        raise InputError(f"{file}: mark must be {GOOD} or {BAD}, not {shown(mark)}")
    return str(mark)


def write_mark(folder: Path, mark: str) -> None:
    """Mark a run; `none` takes the mark away."""
    if mark == NONE:
        (folder / FILE).unlink(missing_ok=True)
    else:
        write_whole(folder / FILE, toml_of({"mark": mark}))
