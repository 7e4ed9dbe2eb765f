"""Look up host names without asyncio's default executor.

A lookup on a dead name server blocks its thread for 5 to 30 s and cannot be cancelled. In the default executor a few of
them would keep frames from being decoded and state from being written. Here a name has one thread at most, which does
not delay the end of the program. A known address is used at once, and looked up again for the next time.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import socket
import threading


class HostLookup:
    """Lookups of any number of names, one thread for each at a time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: dict[str, list[tuple[asyncio.AbstractEventLoop, asyncio.Future[str]]]] = {}
        self._known: dict[str, str] = {}

    async def resolve(self, host: str) -> str:
        """Return the numeric address of a host. Raises OSError (`socket.gaierror`) for an unknown name.

        A known address is returned at once, because a stop has no time for a lookup; a newer one serves the next call.
        Waits as long as the lookup takes if no address is known yet, so call it with a time-out.
        """
        try:
            return str(ipaddress.ip_address(host))
        except ValueError:
            pass
        known, newest = self._known.get(host), self._look_up(host)
        if known is None:
            return await newest
        newest.cancel()  # only this answer: the lookup goes on
        return known

    def _look_up(self, host: str) -> asyncio.Future[str]:
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[str] = loop.create_future()
        with self._lock:
            under_way = host in self._waiting
            waiting = [one for one in self._waiting.get(host, []) if not one[1].done()]
            self._waiting[host] = [*waiting, (loop, answer)]
        if not under_way:
            try:
                threading.Thread(target=self._run, args=(host,), name=f"lookup of {host}", daemon=True).start()
            except RuntimeError as error:
                self._answer(host, OSError(f"cannot look up {host} ({error})"))
        return answer

    def _run(self, host: str) -> None:
        found: str | OSError
        try:
            addresses = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
            addresses.sort(key=lambda address: address[0] != socket.AF_INET)
            found = self._known[host] = str(addresses[0][4][0])
        except OSError as error:
            found = error
        except Exception as error:  # such as UnicodeError, or ValueError for a null character
            found = OSError(f"no valid host name ({error})")
        self._answer(host, found)

    def _answer(self, host: str, found: str | OSError) -> None:
        with self._lock:
            waiting = self._waiting.pop(host)
        for loop, answer in waiting:
            with contextlib.suppress(RuntimeError):  # that loop is closed
                loop.call_soon_threadsafe(_settle, answer, found)


def _settle(answer: asyncio.Future[str], found: str | OSError) -> None:
    if answer.done():
        return  # no longer waited for
    if isinstance(found, OSError):
        answer.set_exception(found)
    else:
        answer.set_result(found)


resolve_host = HostLookup().resolve
