"""Text files that a person hands in."""

from pathlib import Path

from countersteer.errors import InputError

MOST = 256  # MB; an hour of commands at 1 kHz is 150


def read_text(path: Path, most: float = MOST) -> str:
    """The text of a file of at most so many MB, in UTF-8.

    Raises `InputError` where it is larger (a device has no end), no text, or cannot be read.
    """
    limit = int(most * 1e6)
    try:
        with path.open("rb") as file:
            content = file.read(limit + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    if len(content) > limit:
        raise InputError(f"{path}: cannot be read: it is larger than {most:g} MB")
    try:
        return content.decode()
    except UnicodeDecodeError:
        raise InputError(f"{path}: cannot be read: it is not text") from None
