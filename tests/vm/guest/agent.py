"""Runs inside the test machine: takes the name of a scene and its arguments, plays it, answers with what it returns.

One line of JSON in, {"scene": "module:function", "arguments": {...}, "limit_s": 60}, one line out, {"returned": ...} or
{"failed": traceback}. Every scene is played in a process of its own, forked from this one, which has the slow imports
and the drawing behind it.
"""

from __future__ import annotations

import importlib
import inspect
import json
import os
import select
import signal
import sys
import traceback
from pathlib import Path
from typing import Any

PORT = Path("/dev/virtio-ports/slipguard")
sys.path.insert(0, str(Path(__file__).parent))


def main() -> None:
    """Serve until the port is closed for good or a power-off request comes."""
    import cv2
    import scenes

    cv2.setNumThreads(1)
    scenes.draw_images()
    with PORT.open("r+b", buffering=0) as port:
        say(port, {"ready": os.uname().release})
        pending = b""
        while True:
            piece = port.read(65536)
            if not piece:
                select.select([], [], [], 0.05)  # no program at the other end
                continue
            *lines, pending = (pending + piece).split(b"\n")
            for line in lines:
                order = json.loads(line)
                if order.get("scene") == "off":
                    return
                say(port, play(order))


def say(port: Any, answer: dict[str, object]) -> None:
    """Write one line, all of it."""
    data = json.dumps(answer).encode() + b"\n"
    while data:
        data = data[port.write(data) :]


def play(order: dict[str, Any]) -> dict[str, object]:
    """Fork, play the scene in the child, and wait for its answer for as long as the order allows."""
    out, into = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(out)
        os.setsid()
        with os.fdopen(into, "wb") as pipe:
            pipe.write(json.dumps(answered(order)).encode())
        os._exit(0)
    os.close(into)
    answer = b""
    with os.fdopen(out, "rb", buffering=0) as pipe:
        while select.select([pipe], [], [], order.get("limit_s", 60.0))[0]:
            if not (piece := pipe.read(65536)):
                break
            answer += piece
        else:
            os.killpg(child, signal.SIGKILL)
    for _ in range(100):
        if os.waitpid(child, os.WNOHANG)[0]:
            break
        select.select([], [], [], 0.05)
    else:
        return {"failed": f"the kernel holds on to {order.get('scene')}:\n{Path(f'/proc/{child}/stack').read_text()}"}
    return json.loads(answer) if answer else {"failed": f"no answer from {order.get('scene')}"}


def answered(order: dict[str, Any]) -> dict[str, object]:
    """Import the scene and play it."""
    try:
        module, _, name = order["scene"].partition(":")
        result = getattr(importlib.import_module(module), name)(**order.get("arguments", {}))
        if inspect.iscoroutine(result):
            import asyncio

            result = asyncio.run(result)
    except BaseException:
        return {"failed": traceback.format_exc()}
    return {"returned": result}


if __name__ == "__main__":
    main()
