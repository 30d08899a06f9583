"""The viewer's server: answers a browser on this machine, and nobody else unless told to.

Python's own ``http.server`` does all that is asked here: a few dozen small answers a second to one person. One design choice:
the server trusts no request. It answers only where the Host header names this server (a page elsewhere whose name was made to
point here has another), takes requests that change or compute something only as JSON from its own pages, and forbids its pages
to load anything from elsewhere (Content-Security-Policy). Names of artifacts, records and files are looked up, never joined to
a path unseen (``pages``). Files of artifacts, whose pages have no origin, lie behind a word that only the viewer's pages know.

Native libraries are called from two threads that live as long as the viewer, never from those of requests: one reads and
measures (OpenEXR, Embree, MeshLab), one renders (torch, Mitsuba), each one request after the other.
"""

from __future__ import annotations

import ipaddress
import json
import mimetypes
import re
import secrets
import socket
import sys
import threading
import traceback
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from pipeline.errors import Damaged, UserError, for_people
from pipeline.stage import System
from stages.graphics.panels import Context, general, pack, resolve
from stages.viewer.pages import Pages, views_of

FOLDER = Path(__file__).parent / "page"
MOST_BYTES = 1 << 20  # of a request
LOCAL = ("127.0.0.1", "localhost", "::1")
NOTEBOOKS = "http://localhost:* http://127.0.0.1:* https://localhost:* vscode-webview:"  # may show the viewer in a frame
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; media-src 'self'; "
    f"connect-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self' {NOTEBOOKS}"
)
# An artifact's own pages (a report, a site) run without an origin: they reach the files beside them, and nothing else here.
FILES_POLICY = (
    "default-src 'self' 'unsafe-inline' data: blob:; base-uri 'none'; form-action 'none'; "
    f"frame-ancestors 'self' {NOTEBOOKS}; sandbox allow-scripts"
)
RANGE = re.compile(r"bytes=(\d*)-(\d*)\Z")
CHUNK = 1 << 20
KEPT_PANELS = 4  # of artifacts and records


class Refused(Exception):
    """A request that is not answered. ``status``: of HTTP."""

    def __init__(self, status: int, message: str):
        super().__init__(message)
        self.status = status


class Viewer:
    """What the viewer shows: a store, or a file, and what systems make of it."""

    def __init__(self, context: Context, systems: Sequence[System], start: str = ""):
        self.context, self.systems, self.start = context, list(systems), start
        self.pages = Pages(context.store, systems) if context.store is not None else None
        self.word = secrets.token_urlsafe(16)
        self._shown: OrderedDict[tuple[str, str | None], list[Any]] = OrderedDict()  # panels whose values may be asked for
        self.busy = 0  # requests whose numerical work is under way
        self._reader = ThreadPoolExecutor(1, thread_name_prefix="reader")
        self._renderer = ThreadPoolExecutor(1, thread_name_prefix="renderer")

    def panels(self, artifact: str, record: str | None) -> list[Any]:
        """Panels of an artifact or record; without an artifact, of the file that the viewer was started with."""
        if not artifact:
            for system in self.systems:
                views = views_of(system)
                if views is not None and views.file is not None and self.context.path is not None:
                    return list(views.file(self.context))
            raise UserError("no file was given to the viewer: lightmill view FILE")
        shown = self._pages().shown(artifact, record)
        show = self.pages.views(shown.artifact)
        return list(show(shown) if show is not None else general.panels(shown))

    def _remembered(self, artifact: str, record: str | None, anew: bool = False) -> list[Any]:
        """The panels as they were last made: a page asks for what is Lazy in them one by one."""
        if anew:
            self._shown.pop((artifact, record), None)
        panels = self._shown.get((artifact, record))
        if panels is None:
            panels = self._shown[artifact, record] = self.panels(artifact, record)
            while len(self._shown) > KEPT_PANELS:
                self._shown.popitem(last=False)
        return panels

    def _pages(self) -> Pages:
        if self.pages is None:
            raise UserError("the viewer was started with a file, not with a store")
        return self.pages

    def answer(self, name: str, query: Mapping[str, str]) -> Any:
        """A plain or packed answer to a GET of ``/api/<name>``."""
        artifact, record = query.get("artifact", ""), query.get("record") or None
        start = int(query["start"]) if query.get("start", "0").isdecimal() and "start" in query else 0
        if name == "start":
            path = self.context.path
            facts = {"start": self.start, "file": None if path is None else path.name, "store": self.pages is not None}
            return {**facts, "word": self.word}
        if name == "panels":
            return self._reader.submit(lambda: pack(self._remembered(artifact, record, anew=True))).result()
        if name == "lazy":
            path = query.get("path", "")
            return self._reader.submit(lambda: pack(resolve(self._remembered(artifact, record), path))).result()
        pages = self._pages()
        if name == "store":
            return pages.overview()
        if name == "states":
            return pages.states()
        if name == "artifact":
            return pages.about(artifact)
        if name == "records":
            return pages.records(artifact, start, query.get("find", ""))
        if name == "record":
            return pages.beside(artifact, record or "")
        if name == "rejects":
            return pages.rejects(artifact, start, query.get("reason", ""))
        if name == "reject":
            return pages.reject(artifact, query.get("item", ""))
        if name == "runs":
            return [{"artifact": made.name, "file": file, "finished": made.manifest["finished"]} for made, file in pages.logs()]
        if name == "curves":
            made = pages.artifact(artifact)
            file = pages.file(artifact, query.get("file", ""))
            return {"artifact": made.name, "series": general.curves(file.read_text("utf-8", "replace"), file.name)}
        raise Refused(404, f"there is no /api/{name}")

    def act(self, system: str, name: str, arguments: Mapping[str, Any]) -> bytes:
        """A packed answer to a POST of ``/api/act/<system>/<name>``."""
        chosen = next((views for s in self.systems if s.name == system and (views := views_of(s)) is not None), None)
        if chosen is None or name not in chosen.actions:
            raise Refused(404, f"there is no action {name} of {system}")
        self.busy += 1
        try:
            return self._renderer.submit(lambda: pack(chosen.actions[name](self.context, arguments))).result()
        finally:
            self.busy -= 1


class Server(ThreadingHTTPServer):
    """Serves a viewer until it is closed."""

    daemon_threads = True
    request_queue_size = 64

    def __init__(self, viewer: Viewer, host: str = "127.0.0.1", port: int = 0):
        self.viewer, self.host = viewer, host
        if ":" in host:
            self.address_family = socket.AF_INET6
        try:
            super().__init__((host, port), _Handler)
        except OSError as error:
            hint = "give another with --port, or --port 0 for a free one" if port else "give another with --host"
            raise UserError(f"{host} port {port} cannot be used ({error.strerror}): {hint}") from None

    def server_bind(self) -> None:
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)  # without the parent's look-up of the host's full name, which may take seconds
        self.server_address = self.socket.getsockname()
        self.server_port = self.server_address[1]

    @property
    def address(self) -> str:
        """What a browser is given."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.server_port}/"

    def knows(self, host: str) -> bool:
        """Whether a Host header names this server: this machine's loopback, and what ``--host`` named.

        Where the server listens to all addresses, any address in digits is this server's; a name is only the machine's own.
        """
        name, _, port = host.rpartition(":") if re.search(r":\d+\Z", host) else (host, "", "")
        if (port or "80") != str(self.server_port):
            return False
        name = name.strip("[]").lower()
        if name in LOCAL or name == self.host.lower():
            return True
        if self.host in LOCAL:
            return False
        try:
            return bool(ipaddress.ip_address(name))
        except ValueError:
            return name == socket.gethostname().lower()

    def serve_in_background(self) -> None:
        threading.Thread(target=self.serve_forever, daemon=True, name="viewer").start()

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exc_info()[1], (ConnectionError, TimeoutError)):  # a browser that went away
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: Server
    server_version, sys_version = "lightmill", ""
    protocol_version = "HTTP/1.1"
    timeout = 60

    def do_GET(self) -> None:
        self._guarded(self._get)

    def do_HEAD(self) -> None:
        self._guarded(self._get)

    def do_POST(self) -> None:
        self._guarded(self._post)

    def _guarded(self, answer: Callable[[], None]) -> None:
        """Every trouble becomes an answer with words for a person."""
        try:
            self._check()
            answer()
        except Refused as error:
            self._error(error.status, str(error))
        except ConnectionError:
            self.close_connection = True
        except (ValueError, OSError) as error:
            if not for_people(error):
                traceback.print_exc()
            self._error(409 if isinstance(error, Damaged) else 400, str(error) or type(error).__name__)
        except Exception as error:
            traceback.print_exc()
            self._error(500, f"{type(error).__name__}: {error} (a bug: the terminal of `lightmill view` has the traceback)")

    def _check(self) -> None:
        """Refuse requests that another web site had a browser make."""
        if not self.server.knows(self.headers.get("Host", "")):
            raise Refused(421, "this server answers to its own address only")
        site, mode = self.headers.get("Sec-Fetch-Site", "none"), self.headers.get("Sec-Fetch-Mode", "navigate")
        if site not in ("none", "same-origin") and not (mode == "navigate" and self.command == "GET" and self.path == "/"):
            if self.path.startswith(f"/files/{self.server.viewer.word}/"):
                return  # a page of an artifact, which has no origin of its own, loads what lies beside it
            raise Refused(403, "this was asked by another web site")

    def _get(self) -> None:
        url = urlsplit(self.path)
        path = unquote(url.path)
        if path.startswith("/api/"):
            query = {name: values[-1] for name, values in parse_qs(url.query).items()}
            answer = self.server.viewer.answer(path.removeprefix("/api/"), query)
            if isinstance(answer, bytes):
                self._send(answer, "application/octet-stream")
            else:
                self._send(json.dumps(answer, default=str).encode(), "application/json")
        elif path.startswith("/member/"):
            self._member(path.removeprefix("/member/"))
        elif path.startswith("/files/"):
            self._file(path.removeprefix("/files/"))
        else:
            name = path.removeprefix("/") or "index.html"
            if name not in {file.name for file in FOLDER.iterdir() if file.is_file()}:
                raise Refused(404, f"there is no page {path}")
            self._send((FOLDER / name).read_bytes(), type_of(name), POLICY)

    def _member(self, path: str) -> None:
        """``/member/<artifact>/<record>/<member>``: a record's bytes."""
        rest, _, member = path.rpartition("/")
        artifact, _, record = rest.rpartition("/")
        shown = self.server.viewer._pages().shown(artifact, record)
        if member not in shown.members():
            raise Refused(404, f"record {record} of {artifact} has no member {member}")
        self._send(shown.record((member,)).members[member], type_of(member), FILES_POLICY)

    def _file(self, path: str) -> None:
        """``/files/<word>/<artifact>/..``: a file that the artifact's manifest lists."""
        match = re.match(r"([^/]+)/(.*?-[0-9a-f]{12})/(.+)\Z", path)
        if not match or not secrets.compare_digest(match[1], self.server.viewer.word):
            raise Refused(404, "there is no such file")
        file = self.server.viewer._pages().file(match[2], match[3])
        size = file.stat().st_size
        first, last, status = 0, size - 1, 200
        if (wanted := RANGE.match(self.headers.get("Range", ""))) and size and wanted.group(0) != "bytes=-":
            first = int(wanted[1]) if wanted[1] else max(0, size - int(wanted[2]))
            last = min(int(wanted[2]), size - 1) if wanted[1] and wanted[2] else size - 1
            if first > last:
                raise Refused(416, f"{path} has {size} bytes")
            status = 206
        self._head(status, type_of(file.name), last - first + 1, FILES_POLICY)
        self.send_header("Access-Control-Allow-Origin", "null")
        if status == 206:
            self.send_header("Content-Range", f"bytes {first}-{last}/{size}")
        self.send_header("Accept-Ranges", "bytes")
        self.end_headers()
        if self.command == "HEAD":
            return
        with open(file, "rb") as stream:
            stream.seek(first)
            left = last - first + 1
            while left and (data := stream.read(min(CHUNK, left))):
                self.wfile.write(data)
                left -= len(data)

    def _post(self) -> None:
        origin = self.headers.get("Origin")
        if origin is not None and not self.server.knows(urlsplit(origin).netloc):
            raise Refused(403, "this was asked by another web site")
        if self.headers.get("Content-Type", "").partition(";")[0] != "application/json":
            raise Refused(415, "requests are JSON")  # which another site cannot send without asking first
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > MOST_BYTES:
            raise Refused(413, f"a request has at most {MOST_BYTES:,} bytes")
        try:
            arguments = json.loads(self.rfile.read(int(length)))
        except ValueError:
            raise Refused(400, "the request is not JSON") from None
        match = re.match(r"/api/act/([a-z0-9_.]+)/([a-z_]+)\Z", self.path)
        if not match or not isinstance(arguments, dict):
            raise Refused(404, f"there is no {self.path}")
        self._send(self.server.viewer.act(match[1], match[2], arguments), "application/octet-stream")

    # -- sending

    def _head(self, status: int, kind: str, size: int, policy: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(size))
        self.send_header("Content-Security-Policy", policy)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        of_store = self.path.startswith(("/api/", "/member/"))
        self.send_header("Cross-Origin-Resource-Policy", "same-origin" if of_store else "cross-origin")
        self.send_header("Cache-Control", "no-store")

    def _send(self, data: bytes, kind: str, policy: str = "default-src 'none'", status: int = 200) -> None:
        self._head(status, kind, len(data), policy)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def _error(self, status: int, message: str) -> None:
        self.close_connection = True  # a body may not have been read
        self._send(json.dumps({"error": message}).encode(), "application/json", status=status)

    def log_message(self, *words: object) -> None:
        pass


def type_of(name: str) -> str:
    """Media type by the file's ending; text is UTF-8."""
    kind = {".js": "text/javascript", ".md": "text/plain", ".jsonl": "text/plain", ".glb": "model/gltf-binary"}.get(
        Path(name).suffix.lower(), mimetypes.guess_type(name)[0] or "application/octet-stream"
    )
    return f"{kind}; charset=utf-8" if kind.startswith("text/") or kind == "application/json" else kind
