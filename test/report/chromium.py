# SPDX-License-Identifier: Apache-2.0
"""A real browser for the tests of the report: Chromium, headless, over its DevTools pipe."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")

FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--hide-scrollbars", "--remote-debugging-pipe",
    "--no-zygote",  # a child of the browser that outlives it, for the init process to reap
)  # fmt: skip

PATIENCE = 240.0
"""Time limit of a response on a busy machine, s."""

LOOK = 0.02
"""Interval between checks of a page, s."""

DRAWN = "Bokeh.documents.length === 1 && Bokeh.documents[0].is_idle"
"""Whether every chart of a page is drawn."""

IN_SIGHT = """
[...document.querySelectorAll('[data-root-id]')]
    .filter(e => e.getBoundingClientRect().top < innerHeight)
    .every(e => Bokeh.index.get_by_id(e.dataset.rootId)?.is_idle)
"""
"""Whether the charts in the window, and those above it, are drawn."""


class Browser:
    """A page in a separate browser; a context manager."""

    def __init__(
        self,
        profile: Path,  # An empty folder
    ) -> None:
        assert CHROMIUM is not None
        commands, self._commands = os.pipe()
        self._answers, answers = os.pipe()
        # Chromium reads its commands from descriptor 3 and answers on 4.
        shell = f'exec "$0" "$@" 3<&{commands} 4>&{answers}'
        self._process = subprocess.Popen(
            ["bash", "-c", shell, CHROMIUM, *FLAGS, f"--user-data-dir={profile}", "about:blank"],
            pass_fds=(commands, answers),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(commands)
        os.close(answers)
        self._unread = b""
        self._count = 0
        self._session: str | None = None
        self.width = 0  # of the open page; 0 before the first
        # Events since the page was opened: requests, console messages, errors
        self.events: list[dict[str, Any]] = []
        targets = self.call("Target.getTargets")["targetInfos"]
        page = next(target["targetId"] for target in targets if target["type"] == "page")
        attached = self.call("Target.attachToTarget", targetId=page, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._commands)  # the browser ends with its pipe
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._answers)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command to the browser; return the response."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._read()
            if answer.get("id") == self._count:
                assert "error" not in answer, answer
                return answer["result"]
            self.events.append(answer)

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._unread:
            data = os.read(self._answers, 1 << 20)
            assert data, "the browser has gone"
            self._unread += data
        message, _, self._unread = self._unread.partition(b"\0")
        return json.loads(message)

    def prefer(self, scheme: str) -> None:
        """Set the preferred colour scheme, light or dark; links jump without animation."""
        features = [
            {"name": "prefers-color-scheme", "value": scheme},
            {"name": "prefers-reduced-motion", "value": "reduce"},
        ]
        self.call("Emulation.setEmulatedMedia", media="", features=features)

    def open(self, page: Path, width: int, height: int = 900) -> None:
        """Open a file in a window of a width; below 600 px on a telephone's screen."""
        self.width = width
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )
        self.prefer("light")
        self.events.clear()
        self.call("Page.navigate", url=page.resolve().as_uri())
        self.until("document.readyState === 'complete'")

    def until(self, expression: str) -> None:
        """Wait until a JavaScript condition holds in the page."""
        deadline = time.monotonic() + PATIENCE
        while not self.value(expression):
            assert time.monotonic() < deadline, expression
            time.sleep(LOOK)

    def value(self, expression: str) -> Any:
        """Return the value of a JavaScript expression in the page."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def screenshot(self, **clip: float) -> bytes:
        """Return a PNG of a part of the window: x, y, width, height."""
        answer = self.call("Page.captureScreenshot", clip={**clip, "scale": 1})
        return base64.b64decode(answer["data"])

    def pdf(self) -> bytes:
        """Return the page as a PDF, on the paper of its style sheet."""
        answer = self.call("Page.printToPDF", preferCSSPageSize=True, printBackground=False)
        return base64.b64decode(answer["data"])
