"""Measures the page's layout: contrast, size of buttons, names for screen readers."""

from __future__ import annotations

from typing import Any

from playwright.async_api import Page

CONTRAST = """() => {
  const parse = (text) => {
    const [r, g, b, a = 1] = text.match(/[\\d.]+/g).map(Number);
    return { r, g, b, a };
  };
  const over = (top, under) => {
    const mix = (key) => top.a * top[key] + (1 - top.a) * under[key];
    return { r: mix("r"), g: mix("g"), b: mix("b"), a: 1 };
  };
  const ground = (element) => {
    const own = parse(getComputedStyle(element).backgroundColor);
    if (own.a === 1) return own;
    const parent = element.parentElement;
    return over(own, parent ? ground(parent) : { r: 255, g: 255, b: 255, a: 1 });
  };
  const luminance = ({ r, g, b }) => {
    const linear = [r, g, b].map((part) => {
      const share = part / 255;
      return share <= 0.04045 ? share / 12.92 : ((share + 0.055) / 1.055) ** 2.4;
    });
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2];
  };
  const ratio = (one, other) => {
    const [dark, light] = [luminance(one), luminance(other)].sort((a, b) => a - b);
    return (light + 0.05) / (dark + 0.05);
  };
  const found = [];
  const top = document.querySelector("dialog[open]") ?? document.body;
  const walker = document.createTreeWalker(top, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const element = walker.currentNode.parentElement;
    const text = walker.currentNode.textContent.trim();
    if (!text || !element.checkVisibility() || element.closest(".visually-hidden, script, noscript")) continue;
    const under = ground(element);
    found.push([ratio(over(parse(getComputedStyle(element).color), under), under), text]);
  }
  const root = getComputedStyle(document.documentElement);
  const pen = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
  const named = (name) => {
    pen.clearRect(0, 0, 1, 1);
    pen.fillStyle = root.getPropertyValue(name).trim();
    pen.fillRect(0, 0, 1, 1);
    const [r, g, b, a] = pen.getImageData(0, 0, 1, 1).data;
    return { r, g, b, a: a / 255 };
  };
  found.push([ratio(named("--soft"), named("--card")), "words in the charts"]);
  return found;
}"""
"""[contrast to its background, text] of every visible text (WCAG 2.2, 1.4.3)."""

SMALL = """(least) => [...document.querySelectorAll("button, a[href], label.checkbox, input[type=number]")]
  .filter((one) => one.checkVisibility() && !one.classList.contains("skip"))
  .map((one) => [one.getBoundingClientRect(), one.id || one.textContent.trim()])
  .filter(([box]) => box.height && (box.width < least || box.height < least))
  .map(([box, name]) => `${name}: ${box.width} x ${box.height}`)"""

WIDE = """() => [...document.querySelectorAll("body *")]
  .filter((one) => one.checkVisibility() && !one.closest(".visually-hidden, .skip"))
  .filter((one) => one.getBoundingClientRect().right > innerWidth + 0.5)
  .map((one) => one.id || one.className || one.tagName)"""

NAMED_ROLES = {"button", "checkbox", "spinbutton", "textbox", "link", "image", "dialog", "region"}


async def low_contrast_texts(page: Page, least_contrast: float = 4.5) -> list[str]:
    """Return texts with too little contrast."""
    return [f"contrast {ratio:.2f}: {text}" for ratio, text in await page.evaluate(CONTRAST) if ratio < least_contrast]


async def layout_problems(page: Page, least_px: float = 44.0) -> list[str]:
    """Return elements that are too small, or exceed the window."""
    small = [f"small: {one}" for one in await page.evaluate(SMALL, least_px)]
    wide = [f"beyond the edge: {one}" for one in await page.evaluate(WIDE)]
    return small + wide


async def unnamed_elements(page: Page) -> list[str]:
    """Return elements without a name in the browser's accessibility tree."""
    session = await page.context.new_cdp_session(page)
    tree: dict[str, Any] = await session.send("Accessibility.getFullAXTree")
    await session.detach()
    return [
        f"{node['role']['value']} {node.get('backendDOMNodeId')}"
        for node in tree["nodes"]
        if not node.get("ignored")
        and node["role"]["value"] in NAMED_ROLES
        and not node.get("name", {}).get("value", "").strip()
    ]
