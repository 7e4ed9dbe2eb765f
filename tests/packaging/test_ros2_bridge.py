"""The README's ROS 2 bridge is sound Python, and says the right things to the API; ROS itself is stood in for."""

from __future__ import annotations

import json
import re
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

BRIDGE = next(
    block for block in re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S) if "rclpy" in block
)


class Node:
    """What the bridge needs of a node: it keeps what it is given."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.services: dict[str, Any] = {}
        self.published: dict[str, list[str]] = {}

    def declare_parameter(self, name: str, default: str) -> SimpleNamespace:
        return SimpleNamespace(value=PARAMETERS.get(name, default))

    def create_publisher(self, kind: object, topic: str, depth: int) -> SimpleNamespace:
        told = self.published.setdefault(topic, [])
        return SimpleNamespace(publish=lambda message: told.append(message.data))

    def create_timer(self, period_s: float, call: object) -> None: ...

    def create_service(self, kind: object, name: str, call: object) -> None:
        self.services[name] = call


PARAMETERS: dict[str, str] = {}
ANSWERS = {
    ("GET", "/state"): {"phase": "holding", "fault": {"code": "arm silent"}},
    ("POST", "/guard"): {"said": "guarding"},
    ("POST", "/release"): {"said": "releasing, as asked"},
    ("POST", "/lift"): {"error": "nothing is held"},
}


@pytest.fixture
def asked(tmp_path: Path) -> Iterator[list[tuple[str, str, Any]]]:
    """An API at a Unix socket; what it was asked."""
    heard: list[tuple[str, str, Any]] = []

    class Handler(BaseHTTPRequestHandler):
        def answer(self) -> None:
            body = json.loads(self.rfile.read(int(self.headers.get("Content-Length", 0))) or b"null")
            heard.append((self.command, self.path, body))
            text = json.dumps(ANSWERS[self.command, self.path]).encode()
            self.send_response(200)
            self.send_header("Content-Length", str(len(text)))
            self.end_headers()
            self.wfile.write(text)

        do_GET = do_POST = answer

        def log_message(self, *words: object) -> None: ...

    path = tmp_path / "slipguard.sock"
    server = socketserver.UnixStreamServer(str(path), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    PARAMETERS["socket"] = str(path)
    yield heard
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
    exec(compile(BRIDGE, "README.md", "exec"), space)
    return space["Bridge"]()


def called(bridge: Any, name: str, **asked: object) -> SimpleNamespace:
    answer: SimpleNamespace = bridge.services[f"~/{name}"](SimpleNamespace(**asked), SimpleNamespace())
    return answer


def test_services_become_commands(asked: list[tuple[str, str, Any]], bridge: Any) -> None:
    assert called(bridge, "guard", data=True) == SimpleNamespace(success=True, message="guarding")
    assert called(bridge, "release").success
    assert called(bridge, "lift") == SimpleNamespace(success=False, message="nothing is held")
    assert asked == [("POST", "/guard", {"on": True}), ("POST", "/release", {"confirm": True}), ("POST", "/lift", {})]


def test_state_is_published_always_and_a_fault_once(asked: list[tuple[str, str, Any]], bridge: Any) -> None:
    bridge.publish()
    bridge.publish()
    assert [json.loads(text)["phase"] for text in bridge.published["~/state"]] == ["holding"] * 2
    assert [json.loads(text)["code"] for text in bridge.published["~/fault"]] == ["arm silent"]


def test_without_a_daemon_it_says_so(tmp_path: Path, bridge: Any) -> None:
    bridge.socket_path = str(tmp_path / "none.sock")
    assert "no slipguard at" in called(bridge, "clear").message
    bridge.publish()
    assert "no slipguard at" in bridge.published["~/fault"][0]
