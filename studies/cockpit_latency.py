"""From an input to the state that has felt it, on loopback: `python -m studies.cockpit_latency`.

A scripted page sends 60 inputs a second. The time of each is from its sending to the first state
that echoes its number. Beside it stand how late states come, and whether real time is kept.
"""

import json
import statistics
import sys
import tempfile
import threading
import time
from pathlib import Path

from websockets.sync.client import ClientConnection

from studies.cockpit_hour import cockpit, page

SECONDS, PER_SECOND = 20.0, 60


class Measured:
    """What a page has seen."""

    def __init__(self) -> None:
        """Before anything."""
        self.sent: dict[int, float] = {}
        self.felt: list[float] = []
        self.gaps: list[float] = []
        self.lags: list[float] = []
        self.kept = self.keeps = 0.0


def press(socket: ClientConnection, sent: dict[int, float], over: threading.Event) -> None:
    """Send inputs until it is over, and note when."""
    seq, begin = 0, time.monotonic()
    while not over.is_set():
        seq += 1
        sent[seq] = time.monotonic()
        keys = {"steer": [0, -1, 0, 1][seq // 40 % 4], "throttle": 1.0 if seq % 3 else 0.0}
        socket.send(json.dumps({"kind": "input", "seq": seq, **keys}))
        time.sleep(max(0.0, begin + seq / PER_SECOND - time.monotonic()))


def watch(socket: ClientConnection, found: Measured) -> None:
    """Take states for `SECONDS`."""
    last, before, first = 0, 0.0, None
    begin = time.monotonic()
    while time.monotonic() < begin + SECONDS:
        said = json.loads(socket.recv())
        now = time.monotonic()
        if said["kind"] != "state" or said["phase"] != "drives":
            before = 0.0
            continue
        first = first or (now, said["time_s"])
        if before:
            found.gaps.append(now - before)
        before = now
        found.lags.append(said["lag_s"])
        found.felt += [now - found.sent[seq] for seq in range(last + 1, said["seq"] + 1)]
        last = max(last, said["seq"])
        found.kept = (said["time_s"] - first[1]) / max(now - first[0], 1e-9)
        found.keeps = said["keeps"]


def main() -> int:
    """Print the figures."""
    found, over = Measured(), threading.Event()
    with (
        tempfile.TemporaryDirectory() as folder,
        cockpit(Path(folder)) as (address, _),
        page(address) as socket,
    ):
        presser = threading.Thread(target=press, args=(socket, found.sent, over))
        presser.start()
        watch(socket, found)
        over.set()
        presser.join()
    middle, late = statistics.median(found.felt), statistics.quantiles(found.felt, n=20)[-1]
    print(f"input to state: median {1e3 * middle:.1f} ms, 95 % within {1e3 * late:.1f} ms ", end="")
    print(f"({len(found.felt)} inputs)")
    print(f"between two states: median {1e3 * statistics.median(found.gaps):.1f} ms, ", end="")
    print(f"most {1e3 * max(found.gaps):.0f} ms")
    print(
        f"car time over wall time: {found.kept:.3f}; lag at most {max(found.lags):.3f} s; ", end=""
    )
    print(f"this machine could keep {found.keeps:.1f} times real time")
    return 0


if __name__ == "__main__":
    sys.exit(main())
