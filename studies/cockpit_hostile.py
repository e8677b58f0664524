"""A cockpit that is sent nonsense: `python -m studies.cockpit_hostile [MESSAGES]`.

A page sends so many messages that are cut short, out of range, of another kind, out of order, too
long, random text or bytes, as fast as the server reads them, and then floods it as fast as it can.
Before and after, the driver drives a lap of `box`. It has to be the same lap to the last digit.
"""

import contextlib
import dataclasses
import json
import math
import random
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from countersteer.cockpit import messages as m
from countersteer.cockpit.server import LARGEST_FRAME, PER_SECOND
from studies.cockpit_hour import cockpit

MESSAGES = 10_000
FLOOD = 100 * PER_SECOND  # messages, in one go


def malformed(draw: random.Random) -> str:
    """A message that is cut short, out of range, of another kind, or random text."""
    kinds = [m.kind_of(cls) for cls in (*m.OF_PAGE, *m.OF_SERVER)]
    values: list[Any] = [
        None, True, -1, 2**70, 1e308, "x" * 200, "../../etc/passwd", [], [[[]]], {}, {"a": {}},
        math.inf, math.nan, "\u0000", [1] * 600, "box", 0.5,
    ]  # fmt: skip
    names = [f.name for cls in m.OF_PAGE for f in dataclasses.fields(cls)]
    found = {draw.choice(names): draw.choice(values) for _ in range(draw.randrange(5))}
    text = json.dumps({"kind": draw.choice(kinds), **found})
    shape = draw.randrange(4)
    if shape == 0:
        return text[: draw.randrange(len(text))]
    if shape == 1:
        return "".join(chr(draw.randrange(32, 1000)) for _ in range(draw.randrange(80)))
    return text


def hostile(draw: random.Random) -> str | bytes:
    """A message that no page sends: malformed, or too long, out of order, or bytes."""
    shape = draw.randrange(100)
    if shape == 0:
        return "[" * draw.randrange(1, 100_000)
    if shape == 1:
        return json.dumps({"kind": "parameter", "path": "x" * draw.randrange(100_000)})
    if shape < 5:
        return json.dumps({"kind": "input", "seq": draw.randrange(-5, 5), "steer": 9.0})
    if shape < 10:
        return draw.randbytes(draw.randrange(200))
    return malformed(draw)


class Page:
    """A page that holds the wheel."""

    def __init__(self, address: str, session: str) -> None:
        """Connect, and drive on where the page of this session was."""
        self._open = contextlib.ExitStack()
        self.socket: ClientConnection = self._open.enter_context(
            connect(address.replace("http", "ws") + "/ws", origin=Origin(address), max_size=None)
        )
        self.say(kind="hello", session=session)
        self.session = self.until("welcome", lambda w: w["role"] == "drives")["session"]

    def close(self) -> None:
        """Leave."""
        self._open.close()

    def say(self, **message: Any) -> None:
        """Send a message as the page does."""
        self.socket.send(json.dumps(message))

    def until(self, kind: str, holds: Any = lambda _: True) -> Any:
        """The first message of a kind that holds."""
        while True:
            said = json.loads(self.socket.recv(timeout=120))
            if said["kind"] == kind and holds(said):
                return said

    def lap(self) -> dict[float, tuple[float, ...]]:
        """The driver's lap of `box`: pose and speed by time."""
        self.say(kind="set_up", course="box", car="rx7", driver="drift-turn", seed=0, laps=1)
        self.say(kind="control", action="reset")
        self.until("state", lambda s: s["phase"] == "ready" and s["time_s"] == 0)
        self.say(kind="hand_over", to="driver")
        found: dict[float, tuple[float, ...]] = {}
        while True:
            said = json.loads(self.socket.recv(timeout=120))
            if said["kind"] == "state":
                names = ("x_m", "y_m", "heading_rad", "speed_mps")
                found[said["time_s"]] = tuple(said[name] for name in names)
                if said["phase"] == "ended":
                    self.say(kind="hand_over", to="person")
                    return found


def read(page: Page, answers: Counter[str]) -> None:
    """Take what the server has said so far."""
    with contextlib.suppress(TimeoutError):
        while True:
            said = json.loads(page.socket.recv(timeout=0))
            answers[said["kind"]] += 1


def main(count: int = MESSAGES) -> dict[str, Any]:
    """The figures."""
    draw, answers, reopened = random.Random(0), Counter[str](), 0
    with tempfile.TemporaryDirectory() as folder, cockpit(Path(folder)) as (address, process):
        page = Page(address, "")
        before = page.lap()
        begin = time.monotonic()
        for sent in range(count):
            try:
                if sent % 1000 == 500:
                    page.socket.send("x" * (LARGEST_FRAME + 1))
                page.socket.send(hostile(draw))
                read(page, answers)
            except ConnectionClosed:
                reopened += 1
                page = Page(address, page.session)
            time.sleep(max(0.0, begin + sent / (0.9 * PER_SECOND) - time.monotonic()))
        paced = time.monotonic() - begin
        begin = time.monotonic()
        try:
            for _ in range(FLOOD):
                page.socket.send("{" * 20)
            read(page, answers)
        except ConnectionClosed:
            reopened += 1
        flood = time.monotonic() - begin
        with contextlib.suppress(ConnectionClosed):
            page.close()
        after = Page(address, page.session).lap()
        alive = Path(f"/proc/{process}").exists()
    both = before.keys() & after.keys()
    return {
        "messages": count, "seconds": round(paced), "answers": dict(answers),
        "sockets_closed": reopened, "flood_messages": FLOOD, "flood_s": round(flood, 1),
        "alive": alive, "states_compared": len(both),
        "states_that_differ": sum(before[t] != after[t] for t in both),
    }  # fmt: skip


if __name__ == "__main__":
    print(json.dumps(main(*map(int, sys.argv[1:])), indent=1))
