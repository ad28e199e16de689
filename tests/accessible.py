"""Checks of a page in a browser for people who see little or use no mouse: contrast, names, focus by the keyboard."""

from __future__ import annotations

from typing import Any

# Texts whose contrast with what is behind them is under that of WCAG 2.2 AA, and controls without a name. Text over a
# picture is left out: nobody can tell its contrast from styles.
FAULTS = """() => {
  const faults = [], seen = (one) => one.checkVisibility({ opacityProperty: true, visibilityProperty: true });
  const canvas = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
  const colour = (text) => {
    canvas.clearRect(0, 0, 1, 1);
    canvas.fillStyle = text;
    canvas.fillRect(0, 0, 1, 1);
    return [...canvas.getImageData(0, 0, 1, 1).data].map((value) => value / 255);
  };
  const over = (front, back) => [0, 1, 2].map((k) => front[k] * front[3] + back[k] * (1 - front[3]));
  const light = (rgb) => rgb.map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4))
    .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
  const behind = (one) => {
    if (!one) return colour("Canvas");
    if (one.parentElement?.querySelector(":scope > img, :scope > canvas, :scope > iframe")) return null;
    const own = colour(getComputedStyle(one).backgroundColor);
    if (own[3] === 1) return own;
    const further = behind(one.parentElement);
    return further && over(own, further);
  };
  for (const one of document.querySelectorAll("body *")) {
    const texts = [...one.childNodes].filter((node) => node.nodeType === 3 && node.data.trim());
    if (!texts.length || !seen(one) || one.closest("script, style, noscript, option, :disabled, .hidden")) continue;
    const back = behind(one), style = getComputedStyle(one), size = parseFloat(style.fontSize);
    if (!back) continue;
    const [a, b] = [light(over(colour(style.color), back)), light(back)].sort((x, y) => y - x);
    const needed = size >= 24 || (size >= 18.6 && style.fontWeight >= 700) ? 3 : 4.5;
    const contrast = (a + 0.05) / (b + 0.05);
    if (contrast < needed) faults.push(`contrast ${contrast.toFixed(2)}: ${texts[0].data.trim()}`);
  }
  for (const one of document.querySelectorAll("button, a[href], input, select, summary, canvas[tabindex], iframe")) {
    const labels = [...(one.labels ?? [])].map((label) => label.textContent).join("");
    const name = one.ariaLabel || one.title || labels || one.textContent;
    if (seen(one) && !name.trim()) faults.push(`no name: ${one.outerHTML.slice(0, 90)}`);
  }
  return faults;
}"""
FOCUSED = """() => {
  const one = document.activeElement, framed = (part) => part && getComputedStyle(part).outlineStyle !== "none";
  if (one === document.body || one.tagName === "IFRAME") return null;
  return [one.ariaLabel || one.textContent.trim() || one.name, framed(one) || framed(one.closest(".button, .pair"))];
}"""
MAX_STOPS = 40  # of the keyboard


def faults_of(page: Any) -> list[str]:
    """Faults of a page as it is: contrast, names, focus that nobody sees."""
    found = list(page.evaluate(FAULTS))
    for _ in range(MAX_STOPS):
        page.keyboard.press("Tab")
        if (stop := page.evaluate(FOCUSED)) is None:
            break
        if not stop[1]:
            found.append(f"focus is not seen: {stop[0]}")
    return found
