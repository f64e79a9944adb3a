"""A live page in the browser: the page of `export_html`, and an object that may change while somebody looks."""

import json
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from sys import exc_info
from typing import Any
from urllib.parse import parse_qs, urlsplit

from .export.html import first_view, live_page, scene_of
from .model import ArticulatedObject

_HOST = "127.0.0.1"
_NAMES = (_HOST, "localhost")  # by which a browser on this machine, or at the end of a tunnel to it, asks for the page


class LivePage:
    """A page that shows the last object given to `show`, served to this machine until the end of the `with` block.

    The page asks for changes once a second.  While the object changes, joints keep their share of the way and the camera its
    place.

    Attributes:
        url: where it is.

    Raises:
        ValueError: the port cannot be had.
    """

    def __init__(self, title: str, *, port: int = 0) -> None:
        """Begins to serve.

        Args:
            title: above the picture.
            port: 0: any free one.
        """
        self._scenes = _Scenes()
        try:
            self._server = _Server(self._scenes, live_page(title=title), port)
        except (OSError, OverflowError) as error:
            why = getattr(error, "strerror", None) or "there is no such port"
            raise ValueError(f"port {port}: no page can be served there ({why}); choose another, or 0 for any.") from error
        self.url = f"http://{_HOST}:{self._server.server_address[1]}/"
        threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True).start()

    def show(self, obj: ArticulatedObject) -> None:
        """Shows an object from now on; it must not change any more.  Little is done before somebody asks for it."""
        self._scenes.put(obj)

    def close(self) -> None:
        """Stops serving; waits for nobody who is still reading."""
        self._server.shutdown()
        self._server.server_close()

    def __enter__(self) -> "LivePage":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def serve(obj: ArticulatedObject, *, title: str, port: int = 0, ready: Callable[[str], object]) -> None:
    """Serves a page that shows an object until somebody presses Ctrl-C.

    Args:
        obj: what is shown.
        title: above the picture.
        port: 0: any free one.
        ready: is called with the page's address once it can be opened.

    Raises:
        ValueError: the port cannot be had.
    """
    with LivePage(title, port=port) as page:
        page.show(obj)
        try:
            ready(page.url)
            threading.Event().wait()
        except KeyboardInterrupt:
            return


class _Scenes:
    """The object that is shown, its version, and its JSON once somebody has asked for that."""

    def __init__(self) -> None:
        self._shown: tuple[int, ArticulatedObject] | None = None
        self._view: dict[str, Any] | None = None
        self._text: tuple[int, bytes] = (0, b"")
        self._showing, self._writing = threading.Lock(), threading.Lock()

    def put(self, obj: ArticulatedObject) -> None:
        """Takes the place of what was shown before.

        The first object says where the page opens.  That takes a few renderings, made here: the renderer's kernels must not run
        in two threads at once, and those who ask are answered in threads of their own.
        """
        with self._showing:
            self._view = self._view or first_view(obj)
            self._shown = (self._shown[0] + 1 if self._shown else 1, obj)

    def newer(self, version: int) -> bytes | None:
        """The JSON of what is shown; None if that is the given version, or nothing yet."""
        with self._writing:
            shown = self._shown
            if shown is None or shown[0] == version:
                return None
            if self._text[0] != shown[0]:
                scene = scene_of(shown[1], view=self._view) | {"version": shown[0]}
                self._text = (shown[0], json.dumps(scene, separators=(",", ":")).encode())
            return self._text[1]


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, scenes: _Scenes, page: str, port: int) -> None:
        self.scenes, self.page = scenes, page.encode()
        super().__init__((_HOST, port), _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Says nothing of browsers that left before they were answered."""
        if not isinstance(exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: _Server

    def do_GET(self) -> None:
        """Answers with the page, or with the scene where it is newer than what the browser has."""
        # Pages of other sites could reach this server under a name of their own that leads to this machine.
        if urlsplit(f"//{self.headers.get('Host', '')}").hostname not in _NAMES:
            return self._answer(403)
        asked = urlsplit(self.path)
        if asked.path == "/":
            return self._answer(200, "text/html; charset=utf-8", self.server.page)
        if asked.path != "/scene":
            return self._answer(404)
        after = parse_qs(asked.query).get("after", ["0"])[0]
        scene = self.server.scenes.newer(int(after) if after.isdecimal() else 0)
        return self._answer(204) if scene is None else self._answer(200, "application/json", scene)

    def _answer(self, status: int, kind: str = "text/plain", content: bytes = b"") -> None:
        self.send_response(status)
        if status != 204:
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        """Keeps the terminal for the fit."""
