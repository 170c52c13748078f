"""HTTP connections whose answer must begin in time.

A socket's timeout limits the silence between two packets: a server that sends its headers a byte at a time never
exceeds it.
"""

import http.client
import socket
import threading
import urllib.request
from contextlib import suppress
from typing import Any


class _Deadline:
    """For subclasses of HTTPConnection: `timeout` also limits the time until all headers have been received."""

    def getresponse(self: Any) -> http.client.HTTPResponse:
        expired, sock = threading.Event(), self.sock

        def end() -> None:
            expired.set()
            with suppress(OSError):  # the server has closed it
                sock.shutdown(socket.SHUT_RDWR)

        timer = threading.Timer(self.timeout, end)
        timer.daemon = True
        timer.start()
        try:
            return super().getresponse()
        except (OSError, http.client.HTTPException) as error:
            if expired.is_set():
                raise TimeoutError(f"no complete answer within {self.timeout:g} s") from error
            raise
        finally:
            timer.cancel()


class _HttpConnection(_Deadline, http.client.HTTPConnection):
    pass


class _HttpsConnection(_Deadline, http.client.HTTPSConnection):
    pass


class _HttpHandler(urllib.request.HTTPHandler):
    def http_open(self, request: urllib.request.Request) -> http.client.HTTPResponse:
        return self.do_open(_HttpConnection, request)


class _HttpsHandler(urllib.request.HTTPSHandler):
    def https_open(self, request: urllib.request.Request) -> http.client.HTTPResponse:
        return self.do_open(_HttpsConnection, request)


def open_url(request: urllib.request.Request, timeout: float) -> http.client.HTTPResponse:
    """As `urllib.request.urlopen`, but raises TimeoutError where the headers take longer than `timeout` seconds."""
    return urllib.request.build_opener(_HttpHandler, _HttpsHandler).open(request, timeout=timeout)
