"""`more2 show --serve`: the page, its details and the exports of one living scene over HTTP, for this machine only."""

from __future__ import annotations

from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOOPBACK = "127.0.0.1"
PAGE = "report.html"
DETAILS = "report_details"  # what the page of a large scene reads
OF_THE_PAGE = {".html": "text/html; charset=utf-8", ".js": "text/javascript; charset=utf-8"}
TYPES = OF_THE_PAGE | {  # by what a name ends in: what `more2 export` writes, too
    ".json": "application/json",
    ".glb": "model/gltf-binary",
    ".usdc": "model/vnd.usd",
    ".usda": "model/vnd.usd",
    ".ply": "application/octet-stream",
}


def served_files(folder: Path) -> dict[str, Path]:
    """What may be asked for, by name: the page with its details, and exports beside or in the living scene's folder.

    Exports are known by their names, `<folder>.glb` and the like; links that lead elsewhere are left out.
    """
    exports = [p for d in (folder.parent, folder) for p in d.glob("*") if p.stem == folder.name]
    files = {p.name: p for p in exports if p.suffix in TYPES and p.suffix not in OF_THE_PAGE}
    details = folder / DETAILS
    if not details.is_symlink():
        files |= {f"{DETAILS}/{p.name}": p for p in details.glob("*.js")}
    files[PAGE] = folder / PAGE
    return {name: p for name, p in files.items() if p.is_file() and not p.is_symlink()}


class _Handler(BaseHTTPRequestHandler):
    """Answers with the files of one living scene, read anew each time: a scan added meanwhile shows on reload.

    A path is looked up among the names there are and never joined to a folder: nothing else can be reached.
    """

    def __init__(self, *args, folder: Path, **kwargs) -> None:
        self.folder = folder
        super().__init__(*args, **kwargs)

    def do_GET(self) -> None:
        self._answer(body=True)

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def _answer(self, body: bool) -> None:
        # A name that another site let point here is refused: its scripts could read the page.
        host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        if host not in (LOOPBACK, "localhost"):
            return self.send_error(HTTPStatus.FORBIDDEN)
        name = unquote(urlsplit(self.path).path).removeprefix("/") or PAGE
        path = served_files(self.folder).get(name)
        try:
            content = None if path is None else path.read_bytes()
        except OSError:
            content = None
        if path is None or content is None:
            return self.send_error(HTTPStatus.NOT_FOUND)
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", TYPES[path.suffix])
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        # Another site could run a detail as a script of its own, and so read it.
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.end_headers()
        if body:
            self.wfile.write(content)

    def log_message(self, format: str, *args) -> None:
        """Says nothing: the terminal shows the address only."""


def scene_server(folder: Path, port: int = 0) -> ThreadingHTTPServer:
    """A server of the living scene in `folder` at 127.0.0.1, not yet running; `port` 0 takes a free one.

    Raises ValueError for a port that cannot be had.
    """
    try:
        return ThreadingHTTPServer((LOOPBACK, port), partial(_Handler, folder=folder))
    except (OSError, OverflowError) as error:
        raise ValueError(f"port {port} of {LOOPBACK}: {error}; needed a free port, or 0 for any") from error


def address_of(server: ThreadingHTTPServer) -> str:
    """What to type into a browser."""
    return f"http://{LOOPBACK}:{server.server_address[1]}/"


def serve_until_interrupted(server: ThreadingHTTPServer) -> None:
    """Answers until ctrl-C, which ends it in good order."""
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        pass
    finally:
        server.server_close()
