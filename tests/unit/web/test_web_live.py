"""The live stream: history, then states and events; a slow client does not delay the others."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest
import structlog
from fake_daemon_api import FakeDaemonApi, served_on_tcp
from starlette.websockets import WebSocketDisconnect
from structlog.testing import capture_logs
from websockets.asyncio.client import connect

from slipguard.daemon.loop.event_log import KEPT, Event
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.errors import SlipguardError
from slipguard.web import streams
from slipguard.web.daemon_proxy import DaemonInternalError
from slipguard.web.live import HISTORY_SAMPLES, LiveStream


class Client:
    """A WebSocket that takes messages as fast as it is let."""

    def __init__(self) -> None:
        self.got: list[dict[str, Any]] = []
        self.taking = asyncio.Event()
        self.taking.set()
        self.gone = asyncio.Event()

    async def accept(self) -> None: ...

    async def send_text(self, text: str) -> None:
        await self.taking.wait()
        if self.gone.is_set():
            raise WebSocketDisconnect(1006)
        self.got.append(json.loads(text))

    async def receive(self) -> dict[str, str]:
        await self.gone.wait()
        return {"type": "websocket.disconnect"}

    def received(self, kind: str) -> list[dict[str, Any]]:
        return [message for message in self.got if message["type"] == kind]


def played(daemon: FakeDaemonApi, scene: Any) -> None:
    """Run a scene with the stream on, on a virtual clock."""

    async def main() -> None:
        live = LiveStream(daemon.state)
        daemon.subscribe(live.publish_event)
        running = asyncio.create_task(live.run())
        try:
            await scene(live)
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)

    run_virtual(main())


def test_history_then_events_then_states_at_ten_a_second() -> None:
    daemon = FakeDaemonApi()
    client = Client()

    async def scene(live: LiveStream) -> None:
        await asyncio.sleep(90.05)
        serving = asyncio.create_task(live.serve(client))  # type: ignore[arg-type]
        await asyncio.sleep(1.0)
        live.publish_event(Event(5.0, "fault", "object lost", "clear it", "object lost"))
        await asyncio.sleep(0.01)
        client.gone.set()
        await serving

    played(daemon, scene)
    assert [message["type"] for message in client.got[:3]] == ["history", "event", "state"]
    samples = client.got[0]["samples"]
    assert len(samples) == HISTORY_SAMPLES == 600
    known = {
        "t_s": 12.5, "rotation_deg": 1.5, "sigma_deg": 0.25, "force_n": 40.25, "target_n": 40.0, "phase": "holding",
        "slipping": False,
    }  # fmt: skip
    assert samples[0] == known
    assert len(client.received("state")) == 10
    assert client.received("state")[0]["state"] == daemon.snapshot()
    assert client.received("state")[0]["sample"] == known
    assert client.got[-1]["event"]["what_to_do"] == "clear it"
    assert [message["event"]["text"] for message in client.received("event")] == ["gripped", "object lost"]


def test_a_slow_client_misses_messages_and_delays_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    slow, quick = Client(), Client()
    monkeypatch.setattr(streams, "SEND_TIMEOUT_S", 60.0)

    async def scene(live: LiveStream) -> None:
        serving = [asyncio.create_task(live.serve(one)) for one in (slow, quick)]  # type: ignore[arg-type]
        await asyncio.sleep(0.05)
        slow.taking.clear()
        for number in range(3 * KEPT):
            live.publish_event(Event(float(number), "info", f"event {number}"))
            await asyncio.sleep(0.1)
        slow.taking.set()
        await asyncio.sleep(0.05)
        for one in (slow, quick):
            one.gone.set()
        await asyncio.gather(*serving)

    played(FakeDaemonApi(), scene)
    assert len(quick.received("state")) == 3 * KEPT
    assert len(quick.received("event")) == 1 + 3 * KEPT
    assert len(slow.received("state")) <= 3
    texts = [message["event"]["text"] for message in slow.received("event")]
    assert texts[-1] == f"event {3 * KEPT - 1}"
    assert len(texts) <= KEPT + 2


def test_a_client_that_receives_nothing_is_disconnected() -> None:
    stuck = Client()

    async def scene(live: LiveStream) -> None:
        stuck.taking.clear()
        await live.serve(stuck)  # type: ignore[arg-type]
        assert not live._outboxes

    played(FakeDaemonApi(), scene)
    assert stuck.got == []


def test_the_daemon_is_called_once_for_all_clients_and_may_fail() -> None:
    daemon = FakeDaemonApi()
    clients = [Client() for _ in range(20)]
    requested: list[int] = []

    async def scene(live: LiveStream) -> None:
        serving = [asyncio.create_task(live.serve(one)) for one in clients]  # type: ignore[arg-type]
        await asyncio.sleep(1.05)
        requested.append(daemon.state_calls)
        for one in clients:
            one.gone.set()
        await asyncio.gather(*serving)

    played(daemon, scene)
    assert requested == [10]
    assert all(len(one.received("state")) == 10 for one in clients)

    class Silent(FakeDaemonApi):
        async def state(self) -> bytes:
            self.state_calls += 1
            if self.state_calls < 5:
                raise SlipguardError("the daemon did not answer")
            return json.dumps(self.snapshot()).encode()

    patient = Client()

    async def silence(live: LiveStream) -> None:
        serving = asyncio.create_task(live.serve(patient))  # type: ignore[arg-type]
        await asyncio.sleep(1.05)
        patient.gone.set()
        await serving

    played(Silent(), silence)
    assert len(patient.received("state")) == 6


def test_an_invalid_state_is_logged_once_and_survived() -> None:
    class Mistaken(FakeDaemonApi):
        async def state(self) -> bytes:
            self.state_calls += 1
            if self.state_calls < 3:
                raise DaemonInternalError("KeyError in the daemon")
            return b"[]" if self.state_calls == 3 else json.dumps(self.snapshot()).encode()

    client = Client()

    async def scene(live: LiveStream) -> None:
        serving = asyncio.create_task(live.serve(client))  # type: ignore[arg-type]
        await asyncio.sleep(1.05)
        client.gone.set()
        await serving

    structlog.reset_defaults()
    with capture_logs() as output:
        played(Mistaken(), scene)
    assert len(client.received("state")) == 7
    assert [line["event"] for line in output] == 2 * ["the live stream has missed a state"]


async def test_over_a_real_socket_messages_of_clients_are_ignored(tmp_path: Path) -> None:
    daemon = FakeDaemonApi()
    async with served_on_tcp(daemon, tmp_path) as (port, _), connect(f"ws://127.0.0.1:{port}/live") as socket:
        kinds = [json.loads(await socket.recv())["type"] for _ in range(4)]
        assert kinds == ["history", "event", "state", "state"]
        await socket.send('{"release": true}')
        for hear in daemon.subscribers:
            hear(Event(2.0, "warning", "a line"))
        while (message := json.loads(await socket.recv()))["type"] != "event":
            pass
        assert message["event"] == {
            "at_s": 2.0,
            "level": "warning",
            "text": "a line",
            "what_to_do": None,
            "code": None,
            "kind": "system",
        }
    assert daemon.requests == []
    assert daemon.subscribers == []
