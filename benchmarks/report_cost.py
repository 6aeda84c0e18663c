# SPDX-License-Identifier: Apache-2.0
"""Cost of the replay and the report of a long flight: ``python benchmarks/report_cost.py``.

Each flight is replayed with a report in a process of its own, beside an iteration over its raw
messages with rosbags. Headless Chromium then opens the page. Measured are wall and CPU time until
the visible part is drawn, and until all charts are.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import bench

sys.path.insert(0, str(bench.ROOT / "test" / "report"))

from chromium import CHROMIUM, DRAWN, IN_SIGHT, Browser

from uav_ident_ros.simulation.cli import main as simulate

LOOK = 0.05
"""Period for reading the memory of a process, s."""

ROUNDS = 3
"""Number of times that a page is opened; the shortest time counts."""

RAW = "import sys; from rosbags.rosbag2 import Reader\nfor _ in Reader(sys.argv[1]).__enter__()"
RAW += ".messages(): pass"


def cost(command: list[str]) -> tuple[float, float]:
    """Run a command; return its time, s, and the largest memory of its process, MB."""
    begun, peak = time.monotonic(), 0.0
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        while process.poll() is None:
            peak = max(peak, bench.peak_mb(process.pid))
            time.sleep(LOOK)
        errors = process.stderr.read() if process.stderr is not None else b""
    if process.returncode not in (0, 1):  # statuses of a usable and of an unusable result
        raise SystemExit(f"{command[0]}: {errors.decode()}")
    return time.monotonic() - begun, peak


def opening(page: Path, profile: Path) -> tuple[float, ...]:
    """Return wall and CPU time until the visible part is drawn, and until all is, s."""
    found: list[float] = []
    with Browser(profile) as browser:
        browser.call("Performance.enable", timeDomain="threadTicks")
        begun = time.monotonic()
        browser.open(page, 1440)
        for drawn in (IN_SIGHT, DRAWN):
            browser.until(drawn)
            found.append(time.monotonic() - begun)
            metrics = browser.call("Performance.getMetrics")["metrics"]
            found.append(next(m["value"] for m in metrics if m["name"] == "TaskDuration"))
    return tuple(found)


def rows(minutes: float, folder: Path) -> str:
    """Measure a flight of `minutes`; return its row."""
    bag, output = folder / "flight", folder / "output"
    arguments = ["--output", str(bag), "--duration", str(60.0 * minutes)]
    if simulate([*arguments, "--imu-rate", "200", "--actuator-rate", "50"]):
        raise SystemExit("simulate failed")
    raw_time, raw_memory = cost([sys.executable, "-c", RAW, str(bag)])
    replay = [sys.executable, "-m", "uav_ident_ros", "replay", str(bag), "--output", str(output)]
    own = ["--params-file", str(bag / "identifier.yaml"), "--report"]
    seconds, memory = cost([*replay, *own])
    page = output / "report.html"
    size = page.stat().st_size / 1e6
    drawn = [opening(page, folder / f"profile{k}") for k in range(ROUNDS)] if CHROMIUM else []
    opened = "".join(f"{v:>10.1f}" for v in min(drawn)) if drawn else "  no Chromium"
    return (
        f"{minutes:>7g}{raw_time:>10.1f}{raw_memory:>8.0f}{seconds:>12.1f}{memory:>8.0f}"
        f"{60.0 * minutes / seconds:>13.0f}{size:>10.1f}{opened}"
    )


def main() -> None:
    """Measure and print."""
    parser = bench.parser(__doc__)
    parser.add_argument("--minutes", type=float, nargs="+", default=[10.0, 60.0])
    options = parser.parse_args()
    print(
        f"{'minutes':>7}{'raw [s]':>10}{'[MB]':>8}{'replay [s]':>12}{'[MB]':>8}"
        f"{'x real time':>13}{'page [MB]':>10}{'open [s]':>10}{'CPU [s]':>10}"
        f"{'all [s]':>10}{'CPU [s]':>10}"
    )
    for minutes in options.minutes:
        with tempfile.TemporaryDirectory() as folder:
            print(rows(minutes, Path(folder)), flush=True)


if __name__ == "__main__":
    main()
