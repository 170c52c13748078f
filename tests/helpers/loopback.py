"""Folders served to a browser on this machine alone, for pages whose modules may not come from files."""

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar


class _Folders(SimpleHTTPRequestHandler):
    extensions_map: ClassVar[dict[str, str]] = {
        **SimpleHTTPRequestHandler.extensions_map, ".js": "text/javascript", ".wasm": "application/wasm",
    }  # fmt: skip

    def __init__(self, *arguments: Any, folders: Mapping[str, Path]):
        self._folders = folders
        super().__init__(*arguments)

    def translate_path(self, path: str) -> str:
        first, _, rest = path.partition("?")[0].lstrip("/").partition("/")
        return str(self._folders.get(first, Path("/nowhere")) / rest)

    def log_message(self, *_: Any) -> None:
        """Nothing is logged."""


@contextmanager
def served(folders: Mapping[str, Path]) -> Iterator[str]:
    """The address at which each folder is found below its name."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Folders, folders=folders)) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()
