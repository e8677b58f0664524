"""Progress on long work."""

import sys
from typing import Any


class Progress:
    """A progress bar, on a terminal or in a notebook only."""

    def __init__(self, quiet: bool = False) -> None:
        """If `quiet`, nothing is shown."""
        self._quiet = quiet or not (sys.stderr.isatty() or "ipykernel" in sys.modules)
        self._bar: Any = None

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def show(self, done: float, of: float) -> None:
        """Move the bar to `done` of `of`."""
        if self._quiet:
            return
        if self._bar is None:
            from tqdm import tqdm

            self._bar = tqdm(total=of, leave=False, bar_format="{l_bar}{bar}| {elapsed}")
        self._bar.n = min(done, of)
        self._bar.refresh()
