"""Tables in the text files of other programs: any separator, columns read when they are asked for.

Our own tables are read strictly, by `runs.files`.
"""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from countersteer.errors import InputError
from countersteer.reading.content import read_text, reading
from countersteer.reading.values import as_float, short, shown
from countersteer.runs.files import MOST_COLUMNS

SEPARATORS = ",;\t|"
NOTHING = ("", "nan", "NaN", "null", "None", "-", "--")  # cells without a value
MOST_CELLS = 10_000_000  # an hour at 200 Hz is 720,000 rows


class TextTable:
    """The columns of a text file with a header."""

    def __init__(self, path: Path) -> None:
        """Read it. Raises `InputError` if it has no rows, or its rows differ in length."""
        self.path = path
        with reading(path):
            content = read_text(path)
            if content.count("\n") > MOST_CELLS:
                raise InputError(f"{path}: over {MOST_CELLS} lines: cut the log into pieces")
            lines = [line for line in content.splitlines() if line.strip()]
            if not lines:
                raise InputError(f"{path}: is empty")
            # The header is the first line that is no comment, or a comment before numbers.
            self.first = next((i for i, x in enumerate(lines) if not x.startswith("#")), 0)
            separator = max(SEPARATORS, key=lines[self.first].count)
            if self.first and _numeric(lines[self.first].split(separator)):
                self.first -= 1
            header = lines[self.first].lstrip("# ")
            self.names = [name.strip() for name in next(csv.reader([header], delimiter=separator))]
            if len(self.names) > 1 and not self.names[-1]:
                self.names.pop()
            if len(self.names) > MOST_COLUMNS:
                raise InputError(f"{path}: {len(self.names)} columns, over {MOST_COLUMNS}")
            if len(self.names) * len(lines) > MOST_CELLS:
                raise InputError(f"{path}: over {MOST_CELLS} cells: cut the log into pieces")
            self.comma = separator != ","  # decimals may be written so
            self.rows = self._rows(lines[self.first + 1 :], separator)
        if not self.rows:
            raise InputError(f"{path}: holds no rows")

    def _rows(self, lines: Sequence[str], separator: str) -> list[list[str]]:
        width = len(self.names)
        rows: list[list[str]] = []
        try:
            for row in csv.reader(lines, delimiter=separator):
                if len(row) == width + 1 and not row[-1].strip():
                    row.pop()  # a separator at the end of each line
                rows.append(row)
        except csv.Error as error:
            raise InputError(f"{self.path}: it is no CSV file: {short(str(error))}") from None
        if len(rows) > 1 and len(rows[-1]) < width:
            rows.pop()  # cut off in the middle
        for number, row in enumerate(rows):
            if len(row) != width:
                raise InputError(f"{self.place(number)}: {len(row)} cells, not {width}")
        return rows

    def place(self, row: int) -> str:
        """Where a row stands, for messages; blank lines do not count."""
        return f"{self.path}, line {self.first + row + 2}"

    def text(self, name: str) -> list[str]:
        """The cells of a column. Of columns with one name, the first counts."""
        at = self.names.index(name)
        return [row[at].strip() for row in self.rows]

    def numbers(self, name: str) -> np.ndarray:
        """The numbers of a column; NaN where a cell is empty. Raises `InputError` with the line."""
        found = []
        for number, cell in enumerate(self.text(name)):
            try:
                found.append(math.nan if cell in NOTHING else float(self._plain(cell)))
            except ValueError:
                raise InputError(
                    f"{self.place(number)}: {short(name)} must be a number, not {shown(cell)}"
                ) from None
        return np.array(found, float)

    def _plain(self, cell: str) -> str:
        return cell.replace(",", ".") if self.comma else cell

    def times(self, names: Sequence[str]) -> np.ndarray:
        """Dates and times (s) in ISO 8601, in one column or in two. Without a zone they are UTC."""
        found = []
        for number, cells in enumerate(zip(*map(self.text, names), strict=True)):
            try:
                moment = datetime.fromisoformat(" ".join(cells))
            except ValueError:
                words = shown(" ".join(cells))
                raise InputError(
                    f"{self.place(number)}: must be a date and time such as "
                    f"2026-05-01 12:30:00.250, not {words}"
                ) from None
            zoned = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
            found.append(zoned.timestamp())
        return np.array(found, float)


class RecordTable:
    """The columns of records that were read one by one, such as messages."""

    def __init__(
        self, where: str, records: Sequence[Mapping[str, Any]], names: Iterable[str]
    ) -> None:
        """`where` names the table in messages. `names` has all columns that the log holds.

        The records hold those that are asked for.
        """
        self.where, self.records, self.names = where, records, list(names)

    def place(self, row: int) -> str:
        """Where a row stands, for messages."""
        return f"{self.where}, record {row + 1}"

    def text(self, name: str) -> list[str]:
        """The values of a column as text."""
        return [str(record.get(name)) for record in self.records]

    def numbers(self, name: str) -> np.ndarray:
        """The numbers of a column; NaN where a record has none. Raises `InputError`."""
        found = []
        for row, record in enumerate(self.records):
            value = record.get(name)
            if not isinstance(value, int | float | None):
                raise InputError(
                    f"{self.place(row)}: {short(name)} must be a number, not {shown(value)}"
                )
            found.append(math.nan if value is None else as_float(value))
        return np.array(found, float)

    def times(self, names: Sequence[str]) -> np.ndarray:
        """Records have no dates."""
        raise InputError(
            f"{self.where}: {short(', '.join(names))}: has no dates: give another unit"
        )


def _numeric(cells: Sequence[str]) -> bool:
    """Whether all cells are numbers, so that they are a row and no header."""
    try:
        [float(cell) for cell in cells]
    except ValueError:
        return False
    return True
