"""Progress on long work, and on the wait before it."""

import contextlib
import json
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from countersteer.errors import InputError
from countersteer.writing import write_whole

STEP = 0.5  # s between two updates of the wait
SHORTEST = 1.0  # s; a shorter wait is not remembered


class Progress:
    """A progress bar, shown on a terminal or in a notebook only."""

    def __init__(self, quiet: bool = False) -> None:
        """If `quiet`, nothing is shown anywhere."""
        self._quiet = quiet or not (sys.stderr.isatty() or "ipykernel" in sys.modules)
        self._bar: Any = None

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def show(self, done: float, of: float) -> None:
        """Set the bar to `done` out of `of`."""
        if self._quiet:
            return
        if self._bar is None:
            from tqdm import tqdm

            self._bar = tqdm(total=of, leave=False, bar_format="{l_bar}{bar}| {elapsed}")
        self._bar.n = min(done, of)
        self._bar.refresh()


@contextlib.contextmanager
def waiting(what: str, memory: Path) -> Iterator[None]:
    """On a terminal: says at once what is started, and how long it takes to get ready.

    The line goes away with the first output of the work. How long that took is kept in the file
    `memory`, by `what`, for the next time.
    """
    if not sys.stderr.isatty():
        yield
        return
    streams = sys.stdout, sys.stderr
    shared = _Shared(_Wait(what, memory, sys.stderr))
    sys.stdout, sys.stderr = (_First(stream, shared) for stream in streams)
    try:
        yield
    finally:
        shared.wait.end(remember=False)
        sys.stdout, sys.stderr = streams


def clock(what: str) -> None:
    """Where `waiting` shows a line: one more, until the next output, for a wait in mid-work."""
    if isinstance(sys.stderr, _First):
        shared = sys.stderr.shared
        shared.wait.end()
        shared.wait = _Wait(what, shared.wait.memory, sys.stderr.stream)


class _Wait:
    """The line, in a thread of its own: imports and compilers do not stop it."""

    def __init__(self, what: str, memory: Path, out: Any) -> None:
        self._what, self.memory, self._out = what, memory, out
        self._begin, self._over = time.monotonic(), threading.Event()
        last = _read(memory).get(what)
        self._last = f", {last:.0f} s last time" if isinstance(last, int | float) else ""
        self._say("starting")
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _say(self, words: str) -> None:
        self._out.write(f"\r\033[K{self._what}: {words}")
        self._out.flush()

    def _run(self) -> None:
        while not self._over.wait(STEP):
            spent = time.monotonic() - self._begin
            self._say(f"loading and compiling, {spent:.0f} s{self._last}")

    def end(self, remember: bool = True) -> None:
        """Takes the line away."""
        if self._over.is_set():
            return
        self._over.set()
        self._thread.join()
        self._out.write("\r\033[K")
        self._out.flush()
        spent = time.monotonic() - self._begin
        if remember and spent > SHORTEST:
            with contextlib.suppress(OSError, InputError):
                self.memory.parent.mkdir(parents=True, exist_ok=True)
                text = json.dumps(_read(self.memory) | {self._what: round(spent, 1)})
                write_whole(self.memory, text)


class _Shared:
    """The wait of now, for both streams."""

    def __init__(self, wait: _Wait) -> None:
        self.wait = wait


class _First:
    """A stream whose next output ends the wait."""

    def __init__(self, stream: Any, shared: _Shared) -> None:
        self.stream, self.shared = stream, shared

    def write(self, text: str) -> int:
        """Writes; the wait is over."""
        self.shared.wait.end()
        written: int = self.stream.write(text)
        return written

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def _read(file: Path) -> dict[str, Any]:
    """The times of before; none where they cannot be read."""
    try:
        found = json.loads(file.read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
