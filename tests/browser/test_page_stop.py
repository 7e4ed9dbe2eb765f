"""Stop on the page: the button and the space bar send it at once, without a dialog, whatever has the focus."""

from __future__ import annotations

import pytest
from page_rig import DaemonProcess
from playwright.async_api import Page, Route, expect

pytestmark = [pytest.mark.browser, pytest.mark.asyncio(loop_scope="session")]


def posts(page: Page) -> list[str]:
    """Return the paths of the requests that the page sends from now on."""
    sent: list[str] = []
    page.on("request", lambda request: request.method == "POST" and sent.append("/" + request.url.split("/")[-1]))
    return sent


async def lift(running: DaemonProcess, page: Page) -> None:
    """Hold the object at its first place, and begin a lift that takes four seconds."""
    running.held()
    await page.click("#do-lift")
    await page.fill("#field-height_mm", "400")
    await page.locator("#dialog-confirm").click()
    await expect(page.locator("#phase")).to_have_text("Lifting")


async def check_stopped(running: DaemonProcess, page: Page) -> None:
    await expect(page.locator("#message")).to_contain_text("stopped by request")
    await expect(page.locator("#phase")).to_have_text("Holding")
    await expect(page.locator("#detail")).to_contain_text("stopped by request; guarding")
    state = running.until(lambda state: not state["arm"]["moving"])
    stopped_mm = state["arm"]["height_mm"]
    assert state["lifted_mm"] < 350.0
    await page.wait_for_timeout(500)
    assert running.state()["arm"]["height_mm"] == pytest.approx(stopped_mm, abs=0.1)


@pytest.mark.parametrize("how", ["button", "space bar", "space bar on a button", "in a dialog", "button in a dialog"])
async def test_a_lift_is_stopped(running: DaemonProcess, open_page, how: str) -> None:  # type: ignore[no-untyped-def]
    page = await open_page()
    sent = posts(page)
    await lift(running, page)
    if "dialog" in how:
        await page.click("#do-release")
        await expect(page.locator("#dialog-cancel")).to_be_focused()
    elif how == "space bar on a button":
        await page.focus("#do-release")
    if how == "button":
        await page.click("#do-stop")
    elif how == "button in a dialog":
        await page.click("#dialog .stop")
    else:
        await page.keyboard.press("Space")
    await expect(page.locator("#dialog")).to_be_hidden()
    await check_stopped(running, page)
    assert sent == ["/lift", "/stop"]


async def test_it_does_not_wait_for_another_request(running: DaemonProcess, open_page) -> None:  # type: ignore[no-untyped-def]
    page = await open_page()
    await lift(running, page)
    held_back: list[Route] = []
    await page.route("**/guard", lambda route: held_back.append(route))
    await page.click("#do-guard")
    await page.locator("#dialog-confirm").click()
    await expect(page.locator("#hint-guard")).to_have_text("sending …")
    await page.keyboard.press("Space")
    await check_stopped(running, page)
    await held_back[0].continue_()
    await page.unroute("**/guard")


async def test_a_key_held_down_is_one_request_and_a_checkbox_is_no_stop(running: DaemonProcess, open_page) -> None:  # type: ignore[no-untyped-def]
    running.held(again=False)
    page = await open_page()
    sent = posts(page)
    await page.focus("#overlay")
    await page.keyboard.press("Space")
    await expect(page.locator("#overlay")).not_to_be_checked()
    await page.focus("#do-grasp")
    for _ in range(5):
        await page.keyboard.down("Space")
    await page.keyboard.up("Space")
    await expect(page.locator("#message")).to_contain_text("stopped by request")
    assert sent == ["/stop"]


async def test_a_read_only_page_stops_nothing(running: DaemonProcess, open_page) -> None:  # type: ignore[no-untyped-def]
    running.held(again=False)
    page = await open_page(control=False)
    sent = posts(page)
    await expect(page.locator("#do-stop")).to_have_attribute("aria-disabled", "true")
    await expect(page.locator("#hint-stop")).to_have_text("read only")
    await page.click("#do-stop", force=True)
    await expect(page.locator("#message")).to_have_text("Stop is not possible: read only")
    await page.keyboard.press("Space")
    await page.wait_for_timeout(200)
    assert sent == []
