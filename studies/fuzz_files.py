"""Read thousands of damaged files, and list what is neither read nor refused in one line.

    python -m studies.fuzz_files [--format F] [--seed N] [--count N] [--out DIR]

Each file is a valid one (`fuzz_inputs`) with mutations (`fuzz_mutations`). It is read in this
process by the functions of the verbs, with limits of time and memory. A finding is made smaller as
long as the same exception arises at the same place. It is written as a folder with the file and an
`EXPECTED.txt`. The exit status is 1 if anything was found.
"""

import argparse
import contextlib
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

from countersteer.errors import InputError
from studies.fuzz_inputs import Files, Format, formats
from studies.fuzz_mutations import mutated, place_node

LONGEST = 5.0  # s that a file may take
MEMORY = 3e9  # bytes that the process may grow by
MOST_MESSAGE = 400  # characters
TRIES = 150  # readings that make a finding smaller
NODE = 0.03  # part of the mutations that replace a file by a folder, a device, a pipe …


class Finding(NamedTuple):
    """What was neither read nor refused in one line."""

    what: str  # exception and place; equal for equal bugs
    message: str


class TooSlowError(BaseException):
    """The time is over. It is no `Exception`, so that no reader takes it for the file's fault."""


@contextlib.contextmanager
def limited(seconds: float = LONGEST) -> Iterator[None]:
    """A block that may take so long."""

    def over(*_: object) -> None:
        raise TooSlowError

    before = signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def limit_memory() -> None:
    """Let the process grow by `MEMORY` only."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = int(pages * resource.getpagesize() + MEMORY)
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))


def tried(one: Format, folder: Path) -> Finding | str:
    """Read the files in a folder: a finding, or `read` or `refused`."""
    try:
        with limited(), warnings.catch_warnings():
            warnings.simplefilter("error")
            one.read(folder)
    except InputError as error:
        return judged(error)
    except TooSlowError as error:
        return Finding(f"no end within {LONGEST:g} s at {place(error)}", "")
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        return Finding(f"{type(error).__name__} at {place(error)}", str(error)[:200])
    return "read"


def judged(error: InputError) -> Finding | str:
    """`refused`, or a finding if the message is not one short line that says what is wrong."""
    text = str(error)
    if not text.isprintable() or len(text) > MOST_MESSAGE:
        return Finding(f"a message of {len(text) // 100} hundred characters", text)
    if isinstance(error.__cause__, Exception) and re.search(r"cannot be read: \w+Error", text):
        return Finding(f"by the net alone: {type(error.__cause__).__name__} at "
                       f"{place(error.__cause__)}", text)  # fmt: skip
    return "refused"


def place(error: BaseException) -> str:
    """Where an exception arose, by the innermost line of the package."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "countersteer" in Path(frame.filename).parts]
    last = (own or frames)[-1]
    return f"{Path(last.filename).name}:{last.lineno} ({last.name})"


def write(folder: Path, files: Files) -> None:
    """Write files into a new folder."""
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)


def smaller(one: Format, files: Files, name: str, what: str, folder: Path) -> Files:
    """The files with as much of one removed, by lines and then by bytes, as keeps the finding."""
    left = TRIES
    for mark in (b"\n", b""):
        parts = [files[name][i : i + 1] for i in range(len(files[name]))]
        parts = files[name].splitlines(keepends=True) if mark else parts
        size = len(parts) // 2
        while size and left > 0:
            begin = 0
            while begin < len(parts) and left > 0:
                fewer = parts[:begin] + parts[begin + size :]
                candidate = files | {name: b"".join(fewer)}
                write(folder, candidate)
                left -= 1
                found = tried(one, folder)
                if isinstance(found, Finding) and found.what == what:
                    parts, files = fewer, candidate
                else:
                    begin += size
            size //= 2
    return files


def fuzz(
    chosen: list[Format], seed: int, count: int, out: Path | None
) -> tuple[Counter[tuple[str, str]], dict[str, str]]:
    """Try `count` mutations over the formats by turns: counts of results, and the findings."""
    counts: Counter[tuple[str, str]] = Counter()
    found: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "files"
        for number in range(count):
            one, random = chosen[number % len(chosen)], Random(f"{seed} {number}")
            name = random.choice(one.targets)
            files, node = dict(one.files), ""
            if random.random() < NODE:
                write(folder, files)
                node = place_node(random, folder / name)
            else:
                files[name] = mutated(random, name, files[name])
                write(folder, files)
            result = tried(one, folder)
            counts[one.name, result if isinstance(result, str) else "found"] += 1
            if isinstance(result, str) or f"{one.name}: {result.what}" in found:
                continue
            found[f"{one.name}: {result.what}"] = f"{result.message[:200]} (mutation {number})"
            if out is not None:
                if not node and "no end" not in result.what:
                    files = smaller(one, files, name, result.what, folder)
                case = out / f"{one.name}-{len(found):03d}"
                write(case, files)
                text = (
                    f"reader of {one.name}, file {name}{f', replaced by: {node}' if node else ''}\n"
                    f"got: {result.what} {result.message[:200]}\n"
                    "right: read, or exit 2 with one line naming file and key, no traceback.\n"
                )
                (case / "EXPECTED.txt").write_text(text)
    return counts, found


def main(arguments: list[str] | None = None) -> int:
    """Run from the command line."""
    known = formats()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--format", choices=[*known], help="one format (default all, by turns)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=10_000, help="mutations (default 10000)")
    parser.add_argument("--out", type=Path, help="folder of the cases that are found")
    options = parser.parse_args(arguments)
    chosen = [known[options.format]] if options.format else [*known.values()]
    limit_memory()
    begin = time.monotonic()
    counts, found = fuzz(chosen, options.seed, options.count, options.out)
    print(f"{'format':14}{'read':>8}{'refused':>9}{'found':>7}")
    for one in chosen:
        row: list[Any] = [counts[one.name, kind] for kind in ("read", "refused", "found")]
        print(f"{one.name:14}{row[0]:8}{row[1]:9}{row[2]:7}")
    print(f"{options.count} mutations in {time.monotonic() - begin:.0f} s, {len(found)} bugs")
    for what, message in sorted(found.items()):
        print(f"  {what}: {message!r}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
