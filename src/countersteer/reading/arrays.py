"""Arrays of numbers in `.npz` files: every claim of a header is checked before it is believed."""

import io
import math
import warnings
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from countersteer.errors import InputError
from countersteer.reading.content import MOST, read_bytes

LARGEST_LIST = 100_000  # bytes of the list of members; a hundred of them take some ten thousand
END, LONGEST_END = b"PK\x05\x06", 22 + 0xFFFF  # signature and bytes of the record at a zip's end
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
NUMBERS = "fiu"  # kinds of NumPy's types


class _WrongError(Exception):
    """A member is not what it must be."""


def read_arrays(path: Path, names: Sequence[str], kind: str) -> dict[str, np.ndarray]:
    """The arrays of these names as floats. An array of another type is returned without its data.

    `kind` is what the file should be, for messages. Nothing in the file is executed. Raises
    `InputError` if an array is missing or damaged, or if the members are over `MOST` MB unpacked.
    """
    content = read_bytes(path)
    try:
        with warnings.catch_warnings(), zipfile.ZipFile(io.BytesIO(_listed(content))) as packed:
            warnings.simplefilter("ignore")  # of old headers, and of members that are there twice
            members = _members(packed)
            if sum(member.file_size for member in members.values()) > MOST * 1e6:
                raise InputError(f"{path}: cannot be read: it holds more than {MOST} MB")
            missing = [name for name in names if name not in members]
            if missing:
                raise InputError(f"{path}: not {kind}: array '{missing[0]}' is missing")
            return {name: _array(packed, members[name]) for name in names}
    except InputError:
        raise
    except _WrongError as error:
        raise InputError(f"{path}: not {kind}: {error}") from None
    except Exception as error:  # zip, deflate and NumPy's header have no common class of errors
        raise InputError(f"{path}: not {kind}: it is no .npz file of numbers") from error


def _listed(content: bytes) -> bytes:
    """The content, if its list of members is of a size to read."""
    end = content.rfind(END, max(0, len(content) - LONGEST_END))
    if end < 0:
        raise _WrongError("it is no .npz file of numbers")
    if int.from_bytes(content[end + 12 : end + 16], "little") > LARGEST_LIST:
        raise _WrongError("it holds too many members")
    return content


def _members(packed: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """The members by the name of their array."""
    found: dict[str, zipfile.ZipInfo] = {}
    for member in packed.infolist():
        name = member.filename.removesuffix(".npy")
        if name in found:
            raise _WrongError("it holds an array twice")
        if member.flag_bits & 1:
            raise _WrongError("it is encrypted")
        if member.compress_type not in METHODS:
            raise _WrongError("it is compressed by another method than deflate")
        found[name] = member
    return found


def _array(packed: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """An array as floats; one of another type is empty and keeps its type."""
    with packed.open(member) as file:
        header: Any = HEADERS.get(np.lib.format.read_magic(file))
        if header is None:
            raise _WrongError("it is no .npz file of numbers")
        shape, by_columns, dtype = header(file)
        if dtype.hasobject:
            raise _WrongError("it is no .npz file of numbers")
        if dtype.kind not in NUMBERS:
            return np.zeros(0, dtype)
        size = math.prod(shape) * dtype.itemsize
        if min(shape, default=0) < 0 or size != member.file_size - file.tell():
            raise _WrongError("the shape of an array is not that of its data")
        data = file.read(size)
        if len(data) != size:
            raise _WrongError("it is cut off")
        file.read(1)  # the end: only now the checksum is compared
    flat = np.frombuffer(data, dtype)
    with np.errstate(all="ignore"):  # a long double may be beyond the floats
        return flat.reshape(shape, order="F" if by_columns else "C").astype(float)
