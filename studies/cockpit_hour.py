"""An hour at the cockpit: how its memory goes. `python -m studies.cockpit_hour --minutes 60`.

A scripted page drives through the real server in real time: it hands over to the driver, takes
back, steers, resets, changes the car and the floor. The process is one of its own. Its memory is
that of Linux (`VmRSS`), read once a minute. `--json FILE` writes the figures.
"""

import argparse
import contextlib
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

EVERY = 60.0  # s between two readings


@contextlib.contextmanager
def cockpit(folder: Path) -> Iterator[tuple[str, int]]:
    """A cockpit in a process of its own: its address and its id."""
    command = [
        sys.executable,
        "-m",
        "countersteer",
        "cockpit",
        "--no-open",
        "--port",
        "0",
        "--json",
    ]
    process = subprocess.Popen(
        [*command, "--out", str(folder / "runs")], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        yield json.loads(process.stdout.readline())["address"].rstrip("/"), process.pid
    finally:
        process.terminate()
        process.wait(60)


@contextlib.contextmanager
def page(address: str) -> Iterator[ClientConnection]:
    """A page's socket, once it drives."""
    with connect(
        address.replace("http", "ws") + "/ws", origin=Origin(address), max_size=None
    ) as socket:
        socket.send(json.dumps({"kind": "hello"}))
        while json.loads(socket.recv())["kind"] != "world":
            pass
        yield socket


def memory(process: int) -> float:
    """Resident memory of a process (MB)."""
    text = Path(f"/proc/{process}/status").read_text()
    (line,) = (line for line in text.splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) / 1024


def orders(draw: random.Random) -> dict[str, Any]:
    """Something that a person may want."""
    return draw.choice(
        [
            {"kind": "hand_over", "to": "driver"},
            {"kind": "hand_over", "to": "person"},
            {"kind": "control", "action": "reset"},
            {"kind": "parameter", "path": "battery.wear", "value": draw.random()},
            {"kind": "gyro", "on": draw.random() < 0.7, "strength": 1.0},
            {"kind": "sensor", "name": "sonar", "state": draw.choice(["on", "failing"])},
            {"kind": "paint", "patches": [
                {"x_m": 3.0 * draw.random(), "y_m": 0.0, "radius_m": 0.5, "friction": 0.6}
            ]},
        ]
    )  # fmt: skip


def drive(seconds: float) -> dict[str, Any]:
    """Drive for a time on the wall clock. Gives the figures."""
    draw, readings, drives, worst, car = random.Random(0), [], 0, 0.0, 0.0
    with (
        tempfile.TemporaryDirectory() as folder,
        cockpit(Path(folder)) as (address, process),
        page(address) as socket,
    ):
        begin, seq, next_order, next_reading = time.monotonic(), 0, 0.0, 0.0
        while (now := time.monotonic() - begin) < seconds:
            if now >= next_reading:
                next_reading += EVERY
                readings.append(round(memory(process), 1))
                print(f"{now / 60:5.1f} min  {readings[-1]:.1f} MB", flush=True)
            if now >= next_order:
                next_order += 2 + 6 * draw.random()
                socket.send(json.dumps(orders(draw)))
            seq += 1
            keys = {"steer": draw.choice([-1, 0, 1]), "throttle": draw.choice([0, 1, 1])}
            socket.send(json.dumps({"kind": "input", "seq": seq, **keys}))
            said = json.loads(socket.recv())
            if said["kind"] == "ended":
                drives += 1
                socket.send(json.dumps({"kind": "control", "action": "reset"}))
            elif said["kind"] == "state":
                worst = max(worst, said["lag_s"])
                car += 0.02 if said["phase"] == "drives" else 0.0
    return {
        "minutes": seconds / 60, "memory_mb": readings, "drives_ended": drives,
        "driven_s": round(car), "worst_lag_s": round(worst, 3), "cores": os.cpu_count(),
    }  # fmt: skip


def main() -> int:
    """Print the figures."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--minutes", type=float, default=60.0)
    options.add_argument("--json", type=Path)
    given = options.parse_args()
    found = drive(60 * given.minutes)
    print(json.dumps(found))
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
