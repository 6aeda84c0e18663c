# SPDX-License-Identifier: Apache-2.0
"""Six hours of flight in one identifier: ``python benchmarks/endurance.py``.

A flight of eleven minutes, one of excitation and ten of normal flight with gusts and an autopilot,
is repeated with continuous stamps. The delay is estimated. For every hour the program prints the
processor time of the ticks, the memory of the process and the errors of the coefficients; all must
be constant.
"""

import time
from collections.abc import Iterator

import bench
import cases
import numpy as np

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.simulation.noise import Samples, SentSample

FLIGHT = "exact_quiet_gusts_03"

HOUR = 3600.0
MARGIN = 1.0
"""Flight time beyond the last hour, s: a tick is due with the samples after it."""


def messages(flown: Samples, duration: float) -> Iterator[SentSample]:
    """Yield the messages of the repeated flight, for `duration` s."""
    flight, t_ns = list(flown.messages()), flown.imu_t_ns
    start = int(t_ns[0])
    period = int(t_ns[-1]) - start + int(np.median(np.diff(t_ns)))
    lap = 0
    while True:
        for message in flight:
            now = message.t_ns + lap * period
            if (now - start) * 1e-9 > duration:
                return
            yield message._replace(t_ns=now)
        lap += 1


def report(hour: int, times: list[float], error: FloatArray) -> None:
    """Print the figures of an hour."""
    p50, p99, most = (1e6 * np.percentile(times, q) for q in (50, 99, 100))
    print(
        f"hour {hour}: {len(times)} ticks, p50 {p50:.0f} us, p99 {p99:.0f} us, most {most:.0f} us; "
        f"memory {bench.resident_mb():.1f} MiB; dominant coefficients off by at most "
        f"{error.max():.1%}",
        flush=True,
    )


def main() -> None:
    """Fly and print."""
    options = bench.parser(__doc__, hours=6.0).parse_args()
    case = cases.load(FLIGHT)
    assert case.flight is not None
    identifier = OnlineIdentifier(case.settings({"actuators.estimate_delay": True}))
    truth = cases.truth_in(identifier.structure, case.flight)
    dominant = cases.places(identifier.structure, cases.DOMINANT)
    times: list[float] = []
    hour, start = 1, int(case.samples.imu_t_ns[0])
    print(f"memory at the start, the flight in it, {bench.resident_mb():.1f} MiB")
    for message in messages(case.samples, options.hours * HOUR + MARGIN):
        message.give(identifier)
        while (due := identifier.intake.due) is not None:
            began = time.thread_time()
            estimate = identifier.update(due)
            times.append(time.thread_time() - began)
            assert estimate is not None
            if due - start >= hour * HOUR * 1e9:
                error = np.abs(estimate.coefficients / np.where(truth, truth, 1.0) - 1.0)
                report(hour, times, error[dominant])
                hour, times = hour + 1, []


if __name__ == "__main__":
    main()
