# SPDX-License-Identifier: Apache-2.0
"""Cost of a tick beside that of another commit: ``python benchmarks/tick_cost.py [FLIGHT ...]``.

It measures the processor time of ticks without pauses, with default parameters. The two commits run
in turns, each run in a process of its own. By default ``--beside`` is the last commit before
sideslip and angle of attack became states, where the default structure has measured forces. Only
ratios within one run are comparable.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import bench
import cases
import numpy as np
from bench import ROOT

from uav_ident_ros.identification.samples import AIRSPEED, RATES_STREAM

BESIDE = "f99fd36"
"""The last commit before `flight_dynamics`."""

TURNS = 3
"""Number of runs of each commit; the shortest time counts, because other load only adds to it."""

DRIVER = """
import json, sys, time
sys.path.insert(0, sys.argv[1])
import numpy as np
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import Settings
given = np.load(sys.argv[2])
identifier, times = OnlineIdentifier(Settings.from_values(json.loads(sys.argv[3]))), []
asked = getattr(identifier, "due", None) or (lambda: identifier.intake.due)
streams = given["kind"].tolist(), given["t"].tolist(), given["v"].tolist()
for kind, t, v in zip(*streams):
    if not kind:
        identifier.add_actuators(t, v[: given["channels"]])
        continue
    identifier.add_rates(t, v[:3], v[3:])
    while (due := asked()) is not None:
        began = time.thread_time()
        identifier.update(due)
        times.append(time.thread_time() - began)
print(json.dumps([1e3 * np.mean(times), *(1e3 * np.percentile(times, [50, 99]))]))
"""
"""Program that runs in the process of each commit, on the public interface alone."""


def messages(case: cases.Case, path: Path) -> None:
    """Write the messages of a flight to a file, in the order of arrival."""
    listed = [
        (stream == RATES_STREAM, t, np.resize(v, 6))
        for _, stream, t, v in case.samples.messages()
        if stream != AIRSPEED
    ]
    kind, t, v = (np.array(column) for column in zip(*listed, strict=True))
    np.savez(path, kind=kind, t=t, v=v, channels=case.samples.actuators.shape[1])


def run(root: Path, path: Path, parameters: str) -> list[float]:
    """Return mean, median and 99th percentile of a tick, ms."""
    command = [sys.executable, "-c", DRIVER, str(root), str(path), parameters]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=path.parent)
    return [float(value) for value in json.loads(done.stdout)]


def main() -> None:
    """Print a line for each flight."""
    parser = bench.parser(__doc__)
    parser.add_argument("flights", nargs="*", metavar="FLIGHT", default=["thor75_auto"])
    parser.add_argument("--beside", default=BESIDE, metavar="COMMIT", help="(%(default)s)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        other, path = Path(folder) / "other", Path(folder) / "messages.npz"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--quiet", "--detach", other, options.beside], check=True)
        try:
            for name in options.flights:
                case = cases.load(name)
                messages(case, path)
                parameters = json.dumps(case.parameters)
                turns = [
                    [run(root, path, parameters) for root in (ROOT, other)] for _ in range(TURNS)
                ]
                own, beside = np.min(turns, axis=0)
                ratios = ", ".join(f"{ratio:.2f}" for ratio in own / beside)
                print(
                    f"{name}: mean, p50, p99 {own.round(3)} ms, {options.beside} "
                    f"{beside.round(3)} ms, ratios {ratios}"
                )
        finally:
            subprocess.run([*git, "remove", "--force", other], check=True)


if __name__ == "__main__":
    main()
