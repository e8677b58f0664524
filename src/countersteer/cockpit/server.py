"""The server of the cockpit: the page, its modules, the socket and the runs.

It answers this machine only, unless it is told otherwise, and then whoever has the token. Names of
hosts and the origin of a socket are checked before anything else: so no page of another site, and
no name that was pointed here, reaches it. Files are reached through lists by name only.
"""

import asyncio
import contextlib
import ipaddress
import secrets
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.requests import HTTPConnection, Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from countersteer import __version__
from countersteer.cockpit import messages as m
from countersteer.cockpit.courses import CourseShelf
from countersteer.cockpit.realtime import Finished, RealTime
from countersteer.cockpit.recordings import LARGEST_UPLOAD, RunShelf
from countersteer.errors import InputError
from countersteer.viewing import viewer
from countersteer.viewing.page import FOLDER
from countersteer.viewing.style import palette_css

PAGE = Path(__file__).with_name("page")
RESUMES = 5.0  # s in which a page that was reloaded drives on
GREETED = 5.0  # s for the first message
PER_SECOND, AT_ONCE = 240, 480  # messages of a page; it needs 60 and some
LARGEST_FRAME = 2**20  # bytes of a message, beyond which the socket is closed
QUEUED = 200  # messages that a slow page may lag
SAID_AGAIN = 2.0  # s between two complaints about a flood
GHOST = ("time_s", "x_m", "y_m", "heading_rad", "sideslip_deg")  # columns
KINDS = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; connect-src "
        "'self'; img-src 'self' data: blob:; font-src 'self'; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}
# A report stands alone: its script and styles are in the page.
REPORT_HEADERS = HEADERS | {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: "
        "blob:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'; sandbox "
        "allow-scripts allow-downloads"
    )
}


class Page:
    """A page that is connected."""

    def __init__(self) -> None:
        """Before its first message."""
        self.session = secrets.token_urlsafe(16)
        self.seq = -1
        self._out: deque[str] = deque()
        self._state: str | None = None
        self._due = asyncio.Event()
        self.closed = False
        self._left, self._refilled = float(AT_ONCE), time.monotonic()
        self._dropped, self._complained = 0, 0.0

    def send(self, text: str) -> None:
        """Have a message sent. A page that does not read is given up."""
        self._out.append(text)
        self.closed = self.closed or len(self._out) > QUEUED
        self._due.set()

    def complain(self, text: str) -> None:
        """Have an error sent in a line, unless many are waiting: whoever floods reads none."""
        if len(self._out) < QUEUED // 4:
            self.send(m.encode(m.Error(text=text[:300])))

    def show(self, state: str) -> None:
        """Have a state sent. The latest wins."""
        self._state = state
        self._due.set()

    async def pump(self, ws: WebSocket) -> None:
        """Send what there is, until the page is closed."""
        while not self.closed:
            await self._due.wait()
            self._due.clear()
            while self._out:
                await ws.send_text(self._out.popleft())
            state, self._state = self._state, None
            if state is not None:
                await ws.send_text(state)

    def is_flood(self) -> bool:
        """Whether a message is one too many. It is said from time to time."""
        now = time.monotonic()
        self._left = min(AT_ONCE, self._left + (now - self._refilled) * PER_SECOND)
        self._refilled = now
        if self._left >= 1:
            self._left -= 1
            return False
        self._dropped += 1
        if now - self._complained > SAID_AGAIN:
            self._complained = now
            text = f"too many messages: over {PER_SECOND} a second are dropped"
            self.send(m.encode(m.Error(text=f"{text} ({self._dropped} so far)")))
        return True


class Hub:
    """All pages, and which of them drives. It runs in the server's loop."""

    def __init__(
        self, clock: Callable[["Hub"], RealTime], shelf: RunShelf, courses: CourseShelf
    ) -> None:
        """`clock` makes the session's clock; it is started with the server."""
        self.shelf, self.courses = shelf, courses
        self.pages: list[Page] = []
        self.driver: Page | None = None
        self._kept: dict[str, str] = {}  # what a page that comes later is told first, by kind
        self._reserved = ""  # the session key of a page that drove and is gone
        self._tasks: set[asyncio.Task[None]] = set()
        self._timer: asyncio.TimerHandle | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self.clock = clock(self)

    def start(self) -> None:
        """Within the server's loop."""
        self._loop = asyncio.get_running_loop()
        self._begin(self.tell_runs())
        self.clock.start()

    def say(self, message: Any) -> None:
        """Send a message to all pages. It may be called from any thread."""
        if isinstance(message, Finished):
            self._soon(self._finished, message.run)
        else:
            self._soon(self._spread, type(message), m.encode(message))

    def _soon(self, call: Callable[..., None], *arguments: Any) -> None:
        """Have a function called in the server's loop, if that still runs."""
        loop = self._loop
        if loop is not None and not loop.is_closed():
            with contextlib.suppress(RuntimeError):  # it ends just now
                loop.call_soon_threadsafe(call, *arguments)

    def _finished(self, run: str) -> None:
        """A drive has been recorded: tell all pages."""
        self._begin(self.tell_runs(run))

    def _begin(self, work: Coroutine[Any, Any, None]) -> None:
        """Have something done beside all else. The loop itself keeps no task alive."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def ready(self) -> None:
        """Wait until the session is there, so that JAX is set up."""
        while not self.clock.made.is_set():
            await asyncio.sleep(0.1)

    async def tell_runs(self, new: str = "") -> None:
        """Send the list of runs to all pages; `new` is one that has just come."""
        found = await asyncio.to_thread(self.shelf.items)
        self._spread(m.Runs, m.encode(m.Runs(runs=found, new=new)))

    def _spread(self, kind: type, text: str) -> None:
        if kind is m.State:
            for page in self.pages:
                page.show(text)
            return
        if kind in (m.World, m.Runs, m.Busy, m.Ghost):
            self._kept[kind.__name__] = text
        for page in self.pages:
            page.send(text)

    def enter(self, page: Page, hello: m.Hello) -> None:
        """A page has come. It drives if nobody does, or if it did before a reload."""
        self.pages.append(page)
        known = hello.session
        resumes = bool(known) and (
            known == self._reserved or (self.driver is not None and known == self.driver.session)
        )
        if resumes:
            page.session = known
            if self.driver is not None:
                self.driver.session = secrets.token_urlsafe(16)
        if resumes or (self.driver is None and not self._reserved):
            before, self.driver, self._reserved = self.driver, page, ""
            self.clock.release()
            if before is not None:
                self._welcome(before)
        self._welcome(page)
        for kind in ("Busy", "World", "Runs", "Ghost"):
            if kind in self._kept:
                page.send(self._kept[kind])

    def leave(self, page: Page) -> None:
        """A page has gone. Its place is kept for a while, if it drove."""
        page.closed = True
        if page in self.pages:
            self.pages.remove(page)
        if page is self.driver:
            self.driver, self._reserved = None, page.session
            self.clock.release()
            if self._timer is not None:
                self._timer.cancel()
            loop = asyncio.get_running_loop()
            self._timer = loop.call_later(RESUMES, self._pass_on, page.session)

    def _pass_on(self, session: str) -> None:
        """The page with that key has not come back: another one drives, or nobody."""
        if self._reserved != session:
            return
        self._reserved = ""
        if self.pages:
            self.driver = self.pages[0]
            self._welcome(self.driver)
        else:
            self.clock.order(m.Control(action="pause"), lambda _: None)

    def _welcome(self, page: Page) -> None:
        role = m.DRIVES if page is self.driver else m.WATCHES
        watching = len(self.pages) - (self.driver is not None)
        page.send(
            m.encode(
                m.Welcome(role=role, session=page.session, version=__version__, watching=watching)
            )
        )

    def hear(self, page: Page, message: Any) -> None:
        """A message of a page that is known."""
        if isinstance(message, m.Hello):
            raise InputError("hello: this page has said it already")
        if page is not self.driver:
            raise InputError("this page watches: another one drives")
        if isinstance(message, m.Input):
            if message.seq > page.seq:
                page.seq = message.seq
                self.clock.hear(message)
            return
        answer = self.answer(page)
        if isinstance(message, m.Mark | m.Trim | m.AskGhost | m.DrawCourse):
            self._begin(self._aside(message, answer))
        else:
            self.clock.order(message, answer)

    async def _aside(self, message: Any, answer: Callable[[Any], None]) -> None:
        """Carry out an order that has to do with files, beside the drive."""
        try:
            if isinstance(message, m.Mark):
                await asyncio.to_thread(self.shelf.mark, message.run, message.mark)
                await self.tell_runs()
            elif isinstance(message, m.Trim):
                new = await asyncio.to_thread(self.shelf.trim, message.run, message.turn)
                await self.tell_runs(new)
            elif isinstance(message, m.AskGhost):
                await self._ghost(message, answer)
            else:
                await self._draw(message, answer)
        except (InputError, OSError) as error:
            answer(m.Error(text=" ".join(str(error).split())[:300]))

    async def _ghost(self, message: m.AskGhost, answer: Callable[[Any], None]) -> None:
        if message.of == "driver":
            self.clock.order(message, answer)
        elif message.of == "run":
            self.say(await asyncio.to_thread(self.shelf.ghost, message.run))
        else:
            empty: dict[str, Any] = {name: [] for name in GHOST}
            self.say(m.Ghost(name="", **empty))

    async def _draw(self, message: m.DrawCourse, answer: Callable[[Any], None]) -> None:
        if message.action == "sketch":
            answer(await asyncio.to_thread(self.courses.sketch, message))
            return
        name = await asyncio.to_thread(self.courses.save, message)
        answer(m.Event(what="note", text=f"Saved as {self.courses.folder.name}/{name}.toml."))
        course = name if message.action == "drive" else ""
        self.clock.order(m.SetUp(course=course), answer)

    def answer(self, page: Page) -> Callable[[Any], None]:
        """Sends a message to one page, from any thread."""
        return lambda message: self._soon(page.send, m.encode(message))


class Gate:
    """Middleware: the host's name is one of ours, and every answer has its headers."""

    def __init__(self, app: ASGIApp, names: frozenset[str], anywhere: bool) -> None:
        """`names` of hosts are let in; `anywhere`, addresses in digits are as well."""
        self.app, self.names, self.anywhere = app, names, anywhere

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or refuse."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        asked = HTTPConnection(scope)
        host = asked.headers.get("host", "")
        wrong = not self.lets(host)
        origin = asked.headers.get("origin")
        if scope["type"] == "websocket" or scope.get("method") != "GET":
            wrong = wrong or origin is None or urlsplit(origin).netloc != host
        if not wrong:
            await self.app(scope, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": "another origin"})
        else:
            refusal = PlainTextResponse("This address is not answered here.\n", 403, HEADERS)
            await refusal(scope, receive, send)

    def lets(self, host: str) -> bool:
        """Whether a request for this host is meant for us."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        if name in self.names:
            return True
        with contextlib.suppress(ValueError):
            return self.anywhere and bool(ipaddress.ip_address(name))
        return False


def is_loopback(host: str) -> bool:
    """Whether a server at this address is reached from this machine only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Cockpit:
    """The application. `token`: what a page has to know; empty: nothing."""

    def __init__(
        self,
        clock: Callable[[Hub], RealTime],
        shelf: RunShelf,
        courses: CourseShelf,
        host: str = "127.0.0.1",
        token: str = "",
    ) -> None:
        """For a server at an address."""
        self.hub, self.token = Hub(clock, shelf, courses), token
        names = {"127.0.0.1", "localhost", "::1"}
        local = is_loopback(host)
        if not local:
            names |= {host, socket.gethostname().lower()}
        routes = [
            Route("/", self.page),
            Route("/page/{name}", self.page),
            Route("/viewer/{name}", self.module),
            Route("/run/{name}.json", self.run),
            Route("/report/{name}", self.report),
            Route("/report", self.report),
            Route("/download/{name}", self.download),
            Route("/upload", self.upload, methods=["POST"]),
            WebSocketRoute("/ws", self.talk),
        ]
        self.app = Gate(
            Starlette(routes=routes, lifespan=self._lifespan), frozenset(names), not local
        )

    @contextlib.asynccontextmanager
    async def _lifespan(self, _: Starlette) -> Any:
        self.hub.start()
        yield
        await asyncio.to_thread(self.hub.clock.close)

    async def page(self, request: Request) -> Response:
        """The page, or a file of it. Only names of the folder are known."""
        name = request.path_params.get("name", "index.html")
        if name == "shared.css":
            text = palette_css() + (FOLDER / "page.css").read_text(encoding="utf-8")
            text += (viewer.FOLDER / "viewer.css").read_text(encoding="utf-8")
            return Response(text, media_type="text/css", headers=HEADERS)
        files = {path.name: path for path in PAGE.iterdir() if path.suffix in KINDS}
        if name not in files:
            return PlainTextResponse("There is no such file.\n", 404, HEADERS)
        file = files[name]
        return Response(file.read_bytes(), media_type=KINDS[file.suffix], headers=HEADERS)

    async def module(self, request: Request) -> Response:
        """A module of the viewer."""
        name = request.path_params["name"]
        known = {path.name for path in viewer.FOLDER.iterdir() if path.name.endswith(".js")}
        if name not in known | {"look.js"}:
            return PlainTextResponse("There is no such module.\n", 404, HEADERS)
        return Response(viewer.module(name), media_type="text/javascript", headers=HEADERS)

    async def run(self, request: Request) -> Response:
        """A run's view as JSON."""
        return await self._of_runs(request, self.hub.shelf.data, "application/json", HEADERS)

    async def report(self, request: Request) -> Response:
        """The page of a run, or of those that `runs` names."""
        name = request.path_params.get("name")
        names = [name] if name else request.query_params.get("runs", "").split(",")

        def page(_: str) -> str:
            return self.hub.shelf.report(names)

        return await self._of_runs(request, page, "text/html", REPORT_HEADERS)

    async def download(self, request: Request) -> Response:
        """A run's folder as a ZIP file."""
        name = request.path_params["name"]
        save = {"Content-Disposition": f'attachment; filename="{quote(name)}.zip"'}
        packed = self.hub.shelf.packed
        return await self._of_runs(request, packed, "application/zip", HEADERS | save)

    async def _of_runs(
        self, request: Request, get: Callable[[str], str | bytes], kind: str, headers: Any
    ) -> Response:
        """An answer about runs, for a page that has the token."""
        if not self.is_token(request.query_params.get("token", "")):
            return PlainTextResponse("The token is wrong.\n", 403, HEADERS)
        try:
            await self.hub.ready()
            found = await asyncio.to_thread(get, request.path_params.get("name", ""))
        except (InputError, OSError) as error:
            return PlainTextResponse(f"{str(error)[:300]}\n", 404, HEADERS)
        return Response(found, media_type=kind, headers=headers)

    async def upload(self, request: Request) -> Response:
        """Take in a dropped run or log."""
        if not self.is_token(request.query_params.get("token", "")):
            return PlainTextResponse("The token is wrong.\n", 403, HEADERS)
        content = bytearray()
        async for chunk in request.stream():
            content += chunk
            if len(content) > LARGEST_UPLOAD:
                words = f"It is over {LARGEST_UPLOAD // 2**20} MB.\n"
                return PlainTextResponse(words, 413, HEADERS)
        try:
            await self.hub.ready()
            name = request.query_params.get("name", "")[:200]
            new, remarks = await asyncio.to_thread(self.hub.shelf.take, name, bytes(content))
        except (InputError, OSError) as error:
            return PlainTextResponse(" ".join(str(error).split())[:300], 400, HEADERS)
        await self.hub.tell_runs(new)
        return PlainTextResponse(remarks[:300], 200, HEADERS)

    async def talk(self, ws: WebSocket) -> None:
        """The socket of a page, from its greeting on."""
        await ws.accept()
        page = Page()
        pump = asyncio.create_task(page.pump(ws))
        try:
            try:
                async with asyncio.timeout(GREETED):
                    hello = m.parse(await ws.receive_text())
            except TimeoutError:
                raise InputError("hello: it did not come") from None
            if not isinstance(hello, m.Hello):
                raise InputError("the first message must be hello")
            if not self.is_token(hello.token):
                raise InputError("hello: the token is wrong: use the address that was printed")
            self.hub.enter(page, hello)
            while not page.closed:
                await self._hear(ws, page)
        except InputError as error:  # of the greeting
            with contextlib.suppress(RuntimeError, WebSocketDisconnect):
                await ws.send_text(m.encode(m.Error(text=str(error)[:300])))
                await ws.close(1008)
        except (WebSocketDisconnect, KeyError, RuntimeError):  # gone, or greeted with bytes
            pass
        finally:
            self.hub.leave(page)
            pump.cancel()
            with contextlib.suppress(asyncio.CancelledError, Exception):
                await pump
            with contextlib.suppress(RuntimeError, WebSocketDisconnect):  # it is closed
                await ws.close()

    async def _hear(self, ws: WebSocket, page: Page) -> None:
        """Take the next message of a page, and answer a wrong one."""
        try:
            text = await ws.receive_text()
        except KeyError:
            page.complain("message: send text, not bytes")
            return
        if page.is_flood():
            await asyncio.sleep(0)
            return
        try:
            self.hub.hear(page, m.parse(text))
        except InputError as error:
            page.complain(str(error))

    def is_token(self, given: str) -> bool:
        """Whether a token opens this server."""
        return not self.token or secrets.compare_digest(given.encode(), self.token.encode())


class Quiet(uvicorn.Server):
    """A server that leaves signals to its owner."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture none."""
        yield


def server_of(cockpit: Cockpit) -> Quiet:
    """The server of an application, for a socket that is bound already."""
    config = uvicorn.Config(
        cockpit.app,
        log_level="error",
        access_log=False,
        server_header=False,
        ws="websockets-sansio",
        ws_max_size=LARGEST_FRAME,
        ws_ping_interval=5.0,
        timeout_graceful_shutdown=1,
        lifespan="on",
    )
    return Quiet(config)


@contextlib.contextmanager
def running(cockpit: Cockpit, port: int = 0) -> Iterator[str]:
    """Serve in a thread while the block runs. Gives the address, such as `http://127.0.0.1:4711`."""
    with socket.create_server(("127.0.0.1", port)) as bound:
        server = server_of(cockpit)
        thread = threading.Thread(target=lambda: asyncio.run(server.serve([bound])), daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{bound.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join(20)
