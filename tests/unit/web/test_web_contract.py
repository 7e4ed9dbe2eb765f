"""The API matches its OpenAPI document: generated valid and invalid requests, on a real port with the token.

`pytest tests/unit/web/test_web_contract.py --api-examples 500` tries more requests.
"""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

import pytest
from fake_daemon_api import TOKEN, FakeDaemonApi, served_on_tcp


@pytest.mark.campaign
async def test_every_route_matches_its_description(tmp_path: Path, pytestconfig: pytest.Config) -> None:
    """No server error; statuses, types, headers and bodies as described; invalid requests refused; token required."""
    daemon = FakeDaemonApi()
    async with served_on_tcp(daemon, tmp_path) as (port, _):
        trial = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "schemathesis.cli", "run", f"http://127.0.0.1:{port}/openapi.json"),
            *("--header", f"Authorization: Bearer {TOKEN}", "--checks", "all", "--seed", "1", "--no-color"),
            *("--max-examples", str(pytestconfig.getoption("--api-examples")), "--suppress-health-check", "all"),
            cwd=tmp_path,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        output, _ = await trial.communicate()
    assert trial.returncode == 0, output.decode()
    assert {request.kind for request in daemon.requests} >= {
        "grasp",
        "lift",
        "lower",
        "stop",
        "guard",
        "gripper",
        "release",
        "clear",
    }
