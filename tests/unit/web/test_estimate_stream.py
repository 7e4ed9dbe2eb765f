"""The stream of estimates: every one with its capture time, on demand, with bounded memory for a slow client."""

from __future__ import annotations

import asyncio
import itertools
from pathlib import Path

import pytest
from fake_daemon_api import FakeDaemonApi, served, served_on_tcp
from hosted_api import hosted
from starlette.websockets import WebSocketDisconnect

from slipguard.control.finger_fusion import fuse
from slipguard.daemon.api.client import Client, EstimateStream, TcpAddress
from slipguard.daemon.api.state import NewEstimates
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.errors import SlipguardError
from slipguard.perception.estimate import Estimate
from slipguard.web import streams


def message(number: int) -> bytes:
    at_s = 10.0 + number / 60
    left = Estimate(number, at_s - 0.01, at_s - 0.01, True, 900, "registration", 1.5 + number, 0.25)
    new = NewEstimates(number=number, at_s=at_s, rotation=fuse(left, None), fingers={"left": left})
    return new.model_dump_json().encode()


def publish(daemon: FakeDaemonApi, count: int, first: int = 0) -> None:
    for number in range(first, first + count):
        for subscriber in daemon.estimate_subscribers:
            subscriber(message(number))


async def subscribed(daemon: FakeDaemonApi, count: int = 1) -> None:
    while len(daemon.estimate_subscribers) != count:  # noqa: ASYNC110 - nothing reports it
        await asyncio.sleep(0.005)


def read(stream: EstimateStream, count: int) -> list[NewEstimates]:
    return list(itertools.islice(stream, count))


async def test_a_client_receives_every_estimate_through_the_web_process_and_none_is_sent_without_it(
    tmp_path: Path,
) -> None:
    daemon = FakeDaemonApi()
    async with hosted(daemon, tmp_path) as api:
        with api.client() as client:
            await asyncio.to_thread(client.state)
            assert daemon.estimate_subscribers == []
            with await asyncio.to_thread(client.estimates) as stream:
                await subscribed(daemon)
                publish(daemon, 100)
                got = await asyncio.to_thread(read, stream, 100)
        await subscribed(daemon, 0)
    assert [new.number for new in got] == list(range(100))
    assert got[60].at_s == pytest.approx(11.0)
    assert got[60].fingers["left"].captured_at_s == pytest.approx(10.99)
    rotation = got[60].rotation
    assert rotation is not None
    assert rotation.rotation_deg == 61.5


async def test_over_tcp_and_how_it_ends(tmp_path: Path) -> None:
    daemon = FakeDaemonApi()
    async with served_on_tcp(daemon, tmp_path) as (port, _):
        client = Client(TcpAddress(f"http://127.0.0.1:{port}"))
        closed, open_ = await asyncio.to_thread(client.estimates), await asyncio.to_thread(client.estimates)
        await subscribed(daemon)
        reading = asyncio.create_task(asyncio.to_thread(list, closed))
        await asyncio.sleep(0.02)
        await asyncio.to_thread(closed.close)  # from another thread
        assert await reading == []
        await subscribed(daemon)
    with pytest.raises(SlipguardError, match="ended the stream"):
        await asyncio.to_thread(list, open_)
    await asyncio.to_thread(open_.close)
    client.close()


class SlowClient:
    """A WebSocket that takes messages only while `reading` is set."""

    def __init__(self) -> None:
        self.got: list[int] = []
        self.reading, self.gone = asyncio.Event(), asyncio.Event()

    async def accept(self) -> None: ...

    async def send_text(self, text: str) -> None:
        await self.reading.wait()
        if self.gone.is_set():
            raise WebSocketDisconnect(1006)
        self.got.append(NewEstimates.model_validate_json(text).number)

    async def receive(self) -> dict[str, str]:
        await self.gone.wait()
        return {"type": "websocket.disconnect"}


def test_a_slow_client_loses_the_oldest_and_delays_no_other() -> None:
    async def scene() -> None:
        daemon, slow, quick = FakeDaemonApi(), SlowClient(), SlowClient()
        quick.reading.set()
        stream = streams.EstimateStream(daemon)
        serving = [asyncio.create_task(stream.serve(one)) for one in (slow, quick)]  # type: ignore[arg-type]
        await asyncio.sleep(0.01)
        for number in range(3 * streams.ESTIMATES_MAX):
            publish(daemon, 1, number)
            await asyncio.sleep(0.001)
        assert quick.got == list(range(3 * streams.ESTIMATES_MAX))
        slow.reading.set()
        await asyncio.sleep(0.01)
        newest = list(range(2 * streams.ESTIMATES_MAX, 3 * streams.ESTIMATES_MAX))
        assert slow.got[-len(newest) :] == newest
        assert len(slow.got) <= len(newest) + 1
        slow.gone.set()
        quick.gone.set()
        await asyncio.gather(*serving)
        assert daemon.estimate_subscribers == []

    run_virtual(scene())


async def test_a_client_that_stops_reading_does_not_fill_the_daemons_memory(tmp_path: Path) -> None:
    daemon = FakeDaemonApi()
    async with served(daemon, tmp_path / "s"):
        with Client(tmp_path / "s") as client, await asyncio.to_thread(client.estimates) as stream:
            await subscribed(daemon)
            publish(daemon, 5000)  # at once: more than the server may keep
            await asyncio.sleep(0.05)
            publish(daemon, 1, 5000)
            got = [new.number for new in await asyncio.to_thread(read, stream, streams.ESTIMATES_MAX)]
    assert got[0] > 0
    assert got == list(range(got[0], got[0] + len(got)))
