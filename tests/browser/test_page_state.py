"""The page shows the present state: faults at once, no outdated value as new, also after a restart."""

from __future__ import annotations

import re

import pytest
from page_rig import DaemonProcess
from playwright.async_api import expect

pytestmark = [pytest.mark.browser, pytest.mark.asyncio(loop_scope="session")]
COUNT_SPOKEN = """() => {
  window.spoken = [];
  const note = (records) => window.spoken.push(...records.map((one) => one.target.textContent));
  const watched = document.querySelectorAll("[role=status], [role=alert], [aria-live]");
  for (const one of watched) {
    new MutationObserver(note).observe(one, { childList: true, characterData: true, subtree: true });
  }
}"""


async def test_a_fault_appears_with_what_to_do_and_is_cleared(running: DaemonProcess, open_page) -> None:  # type: ignore[no-untyped-def]
    running.held(again=False)
    page = await open_page()
    await page.evaluate(COUNT_SPOKEN)
    await page.wait_for_timeout(1000)
    assert await page.evaluate("window.spoken") == [], "nothing new happened, so nothing may be said"
    running.order("fail arm protective_stop")
    fault = page.get_by_role("alert").filter(has_text="What to do")
    await expect(fault).to_contain_text("protective stop")
    await expect(page.locator("#phase")).to_have_text("Fault: arm in protective stop")
    assert await page.title() == "Fault: arm in protective stop – slipguard"
    await expect(page.locator("#detail")).to_have_text(re.compile(r"the grip is kept: \d+ N"))
    await expect(page.locator("#events li.fault").first).to_contain_text("arm in protective stop")
    await expect(page.locator("#hint-lift")).to_have_text("clear the fault first")
    await expect(page.locator("#arm-motion")).to_have_text("protective stop")
    spoken = await page.evaluate("window.spoken")
    assert len(spoken) < 12, spoken
    running.order("mend")
    running.until(lambda state: not state["arm"]["protective_stop"])
    await page.click("#do-clear")
    await expect(page.locator("#dialog-text")).to_contain_text("The grip does not change")
    await page.click("#dialog-confirm")
    await expect(page.locator("#phase")).to_have_text("Holding")
    await expect(page.locator("#fault")).to_be_hidden()


async def test_a_disconnected_sensor_is_named_and_its_image_hidden(running: DaemonProcess, open_page) -> None:  # type: ignore[no-untyped-def]
    running.fresh()
    page = await open_page()
    running.order("fail left disconnect")
    await expect(page.locator("#phase")).to_have_text("Not ready")
    await expect(page.locator("#finger-left .missing")).to_contain_text("plug it in")
    await expect(page.locator("#finger-left canvas")).to_be_hidden()
    await expect(page.locator("#finger-right canvas")).to_be_visible()
    await expect(page.locator("#devices")).to_contain_text("slipguard doctor")
    await expect(page.locator("#hint-grasp")).to_have_text("not ready, see the devices")
    running.order("mend")
    await expect(page.locator("#phase")).to_have_text("Idle")
    await expect(page.locator("#finger-left canvas")).to_be_visible()
    running.order("fail left stall")
    await expect(page.locator("#finger-left .stale")).to_contain_text("no new frame for")


async def test_after_a_restart_the_page_reconnects_and_access_has_expired(running: DaemonProcess, open_page) -> None:  # type: ignore[no-untyped-def]
    running.held(again=False)
    page = await open_page(
        expected=("ERR_CONNECTION_REFUSED", "ERR_EMPTY_RESPONSE", "ERR_CONNECTION_RESET", "closed before")
    )
    lost = page.locator("#connection", has_text="offline since")
    running.order("again")
    await lost.wait_for(state="attached")
    await expect(page.locator("#connection")).to_have_text("live")
    await expect(page.locator("#login-title")).to_contain_text("Access has expired")
    await expect(page.locator("#login")).to_contain_text("slipguard ctl page")
    await expect(page.locator("#hint-release")).to_have_text("read only")
    await page.goto(running.client.page_link()["url"])
    await expect(page.locator("#access")).to_have_text("commands enabled")
    await expect(page.locator("#login")).to_be_hidden()
    await expect(page.locator("#phase")).to_have_text("Holding")
    await expect(page.locator("#force")).to_have_text("–")  # not known after a restart
    await expect(page.locator("#force-limit")).to_contain_text("target")


async def test_without_a_connection_no_value_is_shown_as_present(running: DaemonProcess, open_page) -> None:  # type: ignore[no-untyped-def]
    running.held()
    page = await open_page()
    await expect(page.locator("#force")).to_have_text(re.compile(r"^\d+ N$"))
    await expect(page.locator("#finger-left canvas")).to_be_visible()
    await page.click("#do-release")
    await page.check("#dialog-checkbox")
    with running.frozen():
        await expect(page.locator("#phase")).to_have_text("No connection")
        await expect(page.locator("#detail")).to_contain_text("last known: Holding")
        await expect(page.locator("#dialog-confirm")).to_be_disabled()
        await expect(page.locator("#dialog-state")).to_contain_text("no connection")
        await page.keyboard.press("Escape")
        for figure in ("rotation", "force", "height"):
            await expect(page.locator(f"#{figure}")).to_have_text("–")
        await expect(page.locator("#finger-left .stale")).to_have_text("last image, not live")
        await expect(page.locator("#hint-release")).to_have_text("no connection")
        await expect(page.locator("#devices .health").first).to_have_text("not known")
    await expect(page.locator("#connection")).to_have_text("live")


async def test_a_browser_without_login_is_read_only(running: DaemonProcess, open_page) -> None:  # type: ignore[no-untyped-def]
    running.well()
    page = await open_page(control=False)
    await expect(page.locator("#login-title")).to_have_text("This page is read-only")
    for button in await page.locator("#buttons button").all():
        await expect(button).to_have_attribute("aria-disabled", "true")
    await page.click("#do-release", force=True)
    await expect(page.locator("#dialog")).to_be_hidden()
    await expect(page.locator("#message")).to_have_text("Release is not possible: read only")
