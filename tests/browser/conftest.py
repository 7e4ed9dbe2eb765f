"""A real browser shows the page of a real daemon: `apt-get install chromium`, then `pytest tests/browser`."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from pathlib import Path

import pytest
import pytest_asyncio
from playwright.async_api import Browser, ConsoleMessage, Page, async_playwright, expect

sys.path.append(str(Path(__file__).parent))

from page_rig import DaemonProcess, daemon

VARIABLE = "SLIPGUARD_CHROMIUM"
NAMES = ("chromium", "chromium-browser", "google-chrome")
QUIET = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--no-proxy-server",
)  # fmt: skip
TIMEOUT_MS = 45_000
Open = Callable[..., Awaitable[Page]]


def chromium() -> str:
    """Return the path of the browser, which SLIPGUARD_CHROMIUM may name."""
    found = os.environ.get(VARIABLE) or next((path for path in map(shutil.which, NAMES) if path), None)
    assert found, f"no Chromium here: apt-get install chromium, or name one in {VARIABLE}"
    return found


@pytest.fixture(scope="session")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DaemonProcess]:
    """Provide one daemon for all tests; each starts with `fresh` or `held`."""
    with daemon(tmp_path_factory.mktemp("page")) as made:
        yield made


@pytest_asyncio.fixture(scope="session", loop_scope="session")
async def browser() -> AsyncIterator[Browser]:
    """Start the browser once."""
    expect.set_options(timeout=TIMEOUT_MS)
    async with async_playwright() as playwright:
        started = await playwright.chromium.launch(executable_path=chromium(), args=QUIET)
        yield started
        await started.close()


@pytest_asyncio.fixture(loop_scope="session")
async def open_page(browser: Browser, running: DaemonProcess) -> AsyncIterator[Open]:
    """Open the page in a new window: `await open_page(control=False)`.

    At the end nothing may have gone wrong in it: no error in its console but `expected` ones, and nothing asked of any
    other host.
    """
    wrong: list[str] = []
    contexts = []

    async def opened(control: bool = True, expected: tuple[str, ...] = ()) -> Page:
        def on_console(message: ConsoleMessage) -> None:
            asked_for = message.location.get("url", "")
            no_image = "/image/" in asked_for and "status of 409" in message.text  # for a moment there may be none
            known = no_image or any(part in message.text for part in expected)
            if message.type in ("error", "warning") and not known:
                wrong.append(f"{message.type}: {message.text} ({asked_for})")

        context = await browser.new_context(viewport={"width": 1280, "height": 800})
        context.set_default_timeout(TIMEOUT_MS)
        contexts.append(context)
        page = await context.new_page()
        page.on("console", on_console)
        page.on("pageerror", lambda error: wrong.append(f"page: {error}"))
        page.on(
            "request",
            lambda request: request.url.startswith((running.url, "blob:")) or wrong.append(f"asked for {request.url}"),
        )
        await page.goto(running.client.page_link()["url"] if control else running.url)
        await page.locator("#connection.good").wait_for()
        await page.locator("#access", has_text="commands enabled" if control else "read only").wait_for()
        return page

    yield opened
    for context in contexts:
        await context.close()
    assert not wrong, "\n".join(wrong)
