"""Runs the tests, each file in a process of its own: `python tests/run.py [FILE…] [OPTION…]`.

Hundreds of compiled programs in one process have crashed XLA 0.10.2. Two files run at a time. One
whose process dies by a signal is run once more, and that is said. Files that took longest last
time begin first.
"""

import json
import os
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent
TIMES = HERE.parent / ".pytest_cache" / "times.json"
AT_ONCE = 2
LONGEST = 1200.0  # s of a file
NO_TEST = 5  # pytest's status where a selection leaves none
COUNTS = ("passed", "failed", "skipped", "error")


class Result(NamedTuple):
    """What came of a file."""

    file: str
    status: int
    seconds: float
    output: str

    def count(self, what: str) -> int:
        """Tests of a kind, as pytest's last line has them."""
        found = re.findall(rf"(\d+) {what}", self.output.strip().rpartition("\n")[2])
        return int(found[0]) if found else 0


def run(file: Path, options: list[str]) -> Result:
    """Run a file; once more if its process dies."""
    command = [sys.executable, "-m", "pytest", str(file), *options]
    begin = time.monotonic()
    for last in (False, True):
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=LONGEST, check=False
            )
            status, output = done.returncode, done.stdout + done.stderr
        except subprocess.TimeoutExpired:
            status, output = 1, f"{file}: not over after {LONGEST:.0f} s\n1 failed"
        if status >= 0:
            break
        print(f"{file.name}: died by signal {-status}" + ("" if last else ", once more"))
    if status < 0:
        output += "\n1 failed"
    return Result(file.name, status, time.monotonic() - begin, output)


def main() -> int:
    """Exit status 1 if a test fails."""
    options = [word for word in sys.argv[1:] if word.startswith("-")]
    given = [Path(word) for word in sys.argv[1:] if not word.startswith("-")]
    try:
        times = json.loads(TIMES.read_text())
    except (OSError, ValueError):
        times = {}
    # Without a time of before, the size of a file is a guess.
    files = sorted(
        given or HERE.glob("test_*.py"),
        key=lambda file: -times.get(file.name, file.stat().st_size / 200),
    )
    results: list[Result] = []
    with ThreadPoolExecutor(AT_ONCE) as pool:
        for result in pool.map(lambda file: run(file, options), files):
            results.append(result)
            last = result.output.strip().rpartition("\n")[2]
            print(f"{result.file:32} {result.seconds:6.1f} s  {last}", flush=True)
            if result.status not in (0, NO_TEST):
                print(result.output, flush=True)
    TIMES.parent.mkdir(exist_ok=True)
    TIMES.write_text(json.dumps(times | {r.file: round(r.seconds, 1) for r in results}))
    counts = {what: sum(result.count(what) for result in results) for what in COUNTS}
    failed = counts["failed"] + counts["error"]
    bad = [r.file for r in results if r.status not in (0, NO_TEST)]
    if bad:
        print(f"failed in {', '.join(bad)}")
    print(f"{counts['passed']} passed, {max(failed, len(bad))} failed, {counts['skipped']} skipped")
    return 1 if bad else 0


if __name__ == "__main__":
    os.environ.setdefault("PYTHONFAULTHANDLER", "1")
    sys.exit(main())
