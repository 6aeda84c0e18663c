# SPDX-License-Identifier: Apache-2.0
"""The report in a real browser: telephone, desk and paper, light and dark."""

import io
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import CHROMIUM, DRAWN, Browser
from PIL import Image

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on this machine")

TELEPHONE, DESK = 375, 1440
"""Widths of windows, CSS pixels; the paper's width is in between."""

PAPER_WIDTH, PAPER_HEIGHT = 688, 1016
"""Printed part of an A4 page with margins of 14 mm, CSS pixels."""

COMPLAINTS = {"Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"}

OVERFLOWING = """
[...document.querySelectorAll('body *')]
    .filter(e => !e.closest('.scroll') && e.getBoundingClientRect().width > 0
        && e.getBoundingClientRect().right > innerWidth + 1)
    .map(e => e.tagName + '.' + e.className)
"""

X_RANGE = """
(() => {{ const host = document.querySelector('#{} [data-root-id]');
    const view = Bokeh.index.get_by_id(host.dataset.rootId);
    return [view.model.x_range.start, view.model.x_range.end]; }})()
"""
"""Time axis of a chart."""

LINKED = ("states", "rates-p", "residual-r", "input-de", "force-az", "coefficient-pdot-p")
"""Charts of every kind over time."""

TOOLTIPS = """
(() => { const found = [];
    const walk = node => { for (const e of node.querySelectorAll('*')) {
        if (e.classList.contains('bk-Tooltip') && e.getClientRects().length)
            found.push((e.shadowRoot || e).textContent);
        if (e.shadowRoot) walk(e.shadowRoot); } };
    walk(document); return found; })()
"""
"""Texts of the tooltips."""

CHART_SIZES = """
[...document.querySelectorAll('figure')].map(e => e.getBoundingClientRect())
    .map(r => [r.width, r.height])
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture(scope="module")
def report(replayed_example: Path) -> Path:
    return replayed_example / "report.html"


def open_page(browser: Browser, report: Path, width: int) -> None:
    """Open the report and wait until every chart is drawn."""
    browser.open(report, width)
    browser.until(DRAWN)


def open_wide(browser: Browser, report: Path) -> None:
    """Open the report in a wide window, unless it is open: drawing takes seconds."""
    if browser.width != DESK:
        open_page(browser, report, DESK)


def x_ranges(browser: Browser) -> dict[str, list[float]]:
    """Return start and end of the drawn time axes of some charts."""
    return {name: browser.value(X_RANGE.format(name)) for name in LINKED}


IN_WINDOW = """
(() => {{ const r = document.querySelector('{}').getBoundingClientRect();
    return r.top < innerHeight && r.bottom > 0; }})()
"""
"""Whether part of an element is in the window."""

NEXT_FRAME = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
"""Resolved after the page has drawn the effect of an event."""


def next_frame(browser: Browser) -> None:
    """Wait until the page has drawn the effect of an event."""
    browser.call("Runtime.evaluate", expression=NEXT_FRAME, awaitPromise=True)


def move(browser: Browser, kind: str, x: float, y: float, **more: object) -> None:
    """Send a mouse event and wait for the next drawn frame."""
    browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)
    next_frame(browser)


def middle_of(browser: Browser, chart: str) -> tuple[float, float]:
    """Bring a chart into view and return its middle, pixels."""
    script = f"""(() => {{ const e = document.querySelector('#{chart} .chart');
        e.scrollIntoView({{behavior: 'instant', block: 'center'}});
        const r = e.getBoundingClientRect();
        return [r.x + r.width / 2, r.y + r.height / 2]; }})()"""
    x, y = browser.value(script)
    return float(x), float(y)


@pytest.mark.parametrize("width", [TELEPHONE, DESK])
def test_the_report_fits_the_window_and_requests_nothing(
    browser: Browser, report: Path, width: int
) -> None:
    open_page(browser, report, width)
    assert browser.value("document.documentElement.scrollWidth") == width
    assert browser.value(OVERFLOWING) == []
    complaints = [event["params"] for event in browser.events if event["method"] in COMPLAINTS]
    kinds = {event.get("type") or event.get("entry", {}).get("level") for event in complaints}
    assert kinds <= {"log", "info"}  # Bokeh logs its version
    requests = [e for e in browser.events if e["method"] == "Network.requestWillBeSent"]
    urls = [request["params"]["request"]["url"] for request in requests]
    assert urls[0] == report.as_uri()
    assert all(url.startswith("data:") for url in urls[1:])
    count = browser.value("document.querySelectorAll('nav a').length")
    assert count == browser.value("document.querySelectorAll('section > h2').length")
    for k in range(count):  # the contents link to the headings
        browser.value(f"document.querySelectorAll('nav a')[{k}].click()")
        next_frame(browser)  # with which the page scrolls
        assert browser.value("document.querySelector(':target').tagName") == "SECTION"
        assert browser.value(IN_WINDOW.format(":target"))


def test_zoom_and_drag_apply_to_all_charts_and_a_tooltip_has_the_value(
    browser: Browser, report: Path
) -> None:
    open_wide(browser, report)
    whole = x_ranges(browser)
    assert len({tuple(span) for span in whole.values()}) == 1
    first, last = whole["rates-p"]
    x, y = middle_of(browser, "rates-p")
    # zoom in: Ctrl and the wheel
    move(browser, "mouseMoved", x, y)
    move(browser, "mouseWheel", x, y, deltaX=0, deltaY=-400, modifiers=2)
    browser.until(f"({X_RANGE.format('rates-p')})[1] < {last - 1.0}")
    near = x_ranges(browser)
    assert len({tuple(span) for span in near.values()}) == 1
    assert near["rates-p"][0] > first
    # pan: a drag to the left shows later times
    # Bokeh ignores a drag after 300 ms without motion: wait for no frame in between.
    press = {"type": "mousePressed", "x": x, "y": y, "button": "left", "clickCount": 1}
    browser.call("Input.dispatchMouseEvent", **press)
    for pulled in (25.0, 50.0):
        move(browser, "mouseMoved", x - pulled, y, button="left", buttons=1)
    move(browser, "mouseReleased", x - 50.0, y, button="left", clickCount=1)
    browser.until(f"({X_RANGE.format('rates-p')})[0] > {near['rates-p'][0]}")
    moved = x_ranges(browser)
    assert len({tuple(span) for span in moved.values()}) == 1
    width = near["rates-p"][1] - near["rates-p"][0]
    assert moved["rates-p"][1] - moved["rates-p"][0] == pytest.approx(width)
    # the tooltip of a line has time and value
    x, y = middle_of(browser, "rates-q")
    move(browser, "mouseMoved", x - 5.0, y)
    move(browser, "mouseMoved", x, y)
    browser.until(f"({TOOLTIPS}).length > 0")
    shown_text = " ".join(browser.value(TOOLTIPS))
    assert re.search(r"time:?\s*\d+\.\d\d s", shown_text), shown_text
    assert re.search(r"measured:?\s*[-−]?\d\.\d{4}", shown_text), shown_text


def test_the_page_follows_the_preferred_colour_scheme(browser: Browser, report: Path) -> None:
    def brightness(scheme: str) -> int:
        browser.prefer(scheme)
        next_frame(browser)
        with Image.open(io.BytesIO(browser.screenshot(x=2, y=2, width=8, height=8))) as corner:
            return int(sum(corner.convert("RGB").getpixel((4, 4))))

    open_wide(browser, report)
    browser.value("scrollTo(0, 0)")
    assert brightness("dark") < 150 < 600 < brightness("light")


def test_print_has_few_a4_pages_with_unbroken_charts_and_all_tables(
    browser: Browser, report: Path
) -> None:
    open_wide(browser, report)
    browser.width = PAPER_WIDTH
    browser.call("Emulation.setEmulatedMedia", media="print", features=[])
    browser.call(
        "Emulation.setDeviceMetricsOverride",
        width=PAPER_WIDTH, height=PAPER_HEIGHT, deviceScaleFactor=1, mobile=False,
    )  # fmt: skip
    sizes = browser.value(CHART_SIZES)
    # Unbroken charts move to the next page, so each must fit on one.
    assert all(width <= PAPER_WIDTH and 40.0 < height < PAPER_HEIGHT for width, height in sizes)
    assert browser.value(OVERFLOWING) == []
    kept = "getComputedStyle(document.querySelector('figure')).breakInside"
    assert browser.value(kept) == "avoid"
    folded = "document.querySelector('details table').getBoundingClientRect().height"
    assert browser.value(folded) > 500.0
    assert browser.value("getComputedStyle(document.querySelector('nav')).display") == "none"
    printed = browser.pdf()
    assert printed.startswith(b"%PDF-")
    assert 5 <= len(re.findall(rb"/Type\s*/Page\b", printed)) <= 14
    boxes = set(re.findall(rb"/MediaBox \[([^\]]+)\]", printed))
    assert boxes
    for box in boxes:
        _, _, width, height = map(float, box.split())
        assert (width, height) == pytest.approx((595.0, 842.0), abs=1.5)
