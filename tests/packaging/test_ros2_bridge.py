"""drivers/ros2_bridge.py sends the right requests to the API. Stand-ins replace the ROS modules."""

from __future__ import annotations

import json
import socketserver
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from sandbox import ROOT

BRIDGE = ROOT / "drivers" / "ros2_bridge.py"


class Node:
    """Stand-in for rclpy.node.Node: keeps services and published messages."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.services: dict[str, Any] = {}
        self.published: dict[str, list[str]] = {}

    def declare_parameter(self, name: str, default: str) -> SimpleNamespace:
        return SimpleNamespace(value=PARAMETERS.get(name, default))

    def create_publisher(self, kind: object, topic: str, depth: int) -> SimpleNamespace:
        messages = self.published.setdefault(topic, [])
        return SimpleNamespace(publish=lambda message: messages.append(message.data))

    def create_timer(self, period_s: float, call: object) -> None: ...

    def create_service(self, kind: object, name: str, call: object) -> None:
        self.services[name] = call


PARAMETERS: dict[str, str] = {}
RESPONSES = {
    ("GET", "/state"): {"phase": "holding", "fault": {"code": "arm silent"}},
    ("POST", "/guard"): {"message": "guarding"},
    ("POST", "/release"): {"message": "releasing, as requested"},
    ("POST", "/lift"): {"error": "nothing is held"},
}


@pytest.fixture
def requests(tmp_path: Path) -> Iterator[list[tuple[str, str, Any]]]:
    """Serve the API on a Unix socket; yield the requests it received."""
    received: list[tuple[str, str, Any]] = []

    class Handler(BaseHTTPRequestHandler):
        def respond(self) -> None:
            body = json.loads(self.rfile.read(int(self.headers.get("Content-Length", 0))) or b"null")
            received.append((self.command, self.path, body))
            text = json.dumps(RESPONSES[self.command, self.path]).encode()
            self.send_response(200)
            self.send_header("Content-Length", str(len(text)))
            self.end_headers()
            self.wfile.write(text)

        do_GET = do_POST = respond

        def log_message(self, *words: object) -> None: ...

    path = tmp_path / "slipguard.sock"
    server = socketserver.UnixStreamServer(str(path), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    PARAMETERS["socket"] = str(path)
    yield received
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def bridge(monkeypatch: pytest.MonkeyPatch) -> Any:
    for name, content in {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "std_msgs": {},
        "std_msgs.msg": {"String": SimpleNamespace},
        "std_srvs": {},
        "std_srvs.srv": {"SetBool": object, "Trigger": object},
    }.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    space: dict[str, Any] = {"__name__": "bridge"}
    exec(compile(BRIDGE.read_text(encoding="utf-8"), str(BRIDGE), "exec"), space)
    return space["Bridge"]()


def call(bridge: Any, name: str, **fields: object) -> SimpleNamespace:
    reply: SimpleNamespace = bridge.services[f"~/{name}"](SimpleNamespace(**fields), SimpleNamespace())
    return reply


def test_services_become_requests(requests: list[tuple[str, str, Any]], bridge: Any) -> None:
    assert call(bridge, "guard", data=True) == SimpleNamespace(success=True, message="guarding")
    assert call(bridge, "release").success
    assert call(bridge, "lift") == SimpleNamespace(success=False, message="nothing is held")
    assert requests == [
        ("POST", "/guard", {"on": True}),
        ("POST", "/release", {"confirm": True}),
        ("POST", "/lift", {}),
    ]


def test_state_is_published_always_and_a_fault_once(requests: list[tuple[str, str, Any]], bridge: Any) -> None:
    bridge.publish()
    bridge.publish()
    assert [json.loads(text)["phase"] for text in bridge.published["~/state"]] == ["holding"] * 2
    assert [json.loads(text)["code"] for text in bridge.published["~/fault"]] == ["arm silent"]


def test_without_a_daemon_the_reply_names_the_socket(tmp_path: Path, bridge: Any) -> None:
    bridge.socket_path = str(tmp_path / "none.sock")
    assert "no slipguard daemon at" in call(bridge, "clear").message
    bridge.publish()
    assert "no slipguard daemon at" in bridge.published["~/fault"][0]
