"""`cockpit`: the live page on which a person drives."""

import argparse
import asyncio
import contextlib
import json
import secrets
import signal
import socket
import threading
from pathlib import Path

from countersteer.cli.options import DONE, Verbs, number
from countersteer.drivers import DRIVERS
from countersteer.errors import InputError


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    cockpit = verbs.verb("cockpit", "a live page: drive, watch and record in the browser", run)
    cockpit.option("--port", "N", number(0, 65535, int), 8420, "0: any that is free")
    meaning = "address to answer at; beyond this machine a token is needed, and printed"
    cockpit.option("--host", "H", str, "127.0.0.1", meaning)
    cockpit.option("--token", "T", str, None, "the token (default a random one, where needed)")
    cockpit.add_argument("--no-open", action="store_true", help="do not open the browser")
    cockpit.option("--course", "COURSE", str, "box", "library name, or a file as drive takes it")
    cockpit.option("--car", None, str, "rx7", "library name or .toml file")
    cockpit.option("--driver", None, str, "drift-turn", f"{', '.join(DRIVERS)}, or as drive takes")
    cockpit.seed()
    cockpit.option("--out", "DIR", Path, Path("runs"), "where drives are recorded")


def run(options: argparse.Namespace) -> int:
    """`cockpit`."""
    # JAX is loaded in a thread later: the page is there at once.
    from countersteer.cockpit import server
    from countersteer.cockpit.start import Start, cockpit, open_browser

    local = server.is_loopback(options.host)
    token = options.token or ("" if local else secrets.token_urlsafe(16))
    if not token.isascii() or not token.isprintable() or len(token) > 100:
        raise InputError("--token: give at most 100 printable ASCII characters")
    bound = bind(options.host, options.port)
    start = Start(
        options.course, options.car, options.driver, options.seed, options.out,
        options.out.parent / "courses",
    )  # fmt: skip
    address = address_of(bound, options.host, token)
    if options.json:
        print(json.dumps({"address": address}), flush=True)
    else:
        print(f"{address}  (Ctrl-C ends)", flush=True)
    if not options.no_open:
        threading.Thread(target=open_browser, args=(address,), daemon=True).start()
    made = cockpit(start, options.host, token)
    serving = server.server_of(made)

    async def watch() -> None:
        await made.hub.ready()
        serving.should_exit = serving.should_exit or made.hub.clock.failed is not None

    async def serve() -> None:
        loop = asyncio.get_running_loop()
        watching = loop.create_task(watch())
        for caught in (signal.SIGINT, signal.SIGTERM):
            with contextlib.suppress(NotImplementedError):  # on Windows
                loop.add_signal_handler(caught, setattr, serving, "should_exit", True)
        await serving.serve([bound])
        watching.cancel()

    asyncio.run(serve())
    if made.hub.clock.failed is not None:
        raise InputError(made.hub.clock.failed)
    return DONE


def bind(host: str, port: int) -> socket.socket:
    """A socket at an address. Raises `InputError` if it is taken or not this machine's."""
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family)
    except OSError as error:
        raise InputError(
            f"--host {host} --port {port}: {error.strerror or error}: give another one"
        ) from None


def address_of(bound: socket.socket, host: str, token: str) -> str:
    """The page's address, with the token."""
    name = socket.gethostname() if host in ("0.0.0.0", "::") else host
    name = f"[{name}]" if ":" in name else name
    return f"http://{name}:{bound.getsockname()[1]}/" + (f"?token={token}" if token else "")
