# SPDX-License-Identifier: Apache-2.0
"""From messages to coefficients: gaps, bounded memory, and independence of the sensors."""

from dataclasses import replace
from typing import Any

import flying
import numpy as np
import pytest

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.simulation.channels import CHANNEL_SETS
from uav_ident_ros.simulation.flight import Flight
from uav_ident_ros.simulation.inputs import ColouredNoise
from uav_ident_ros.simulation.noise import Sensors, measure
from uav_ident_ros.simulation.plant import SMALL_UAV

# Inertias are known: rate products that still converge would drift during the gap.
BODY = SMALL_UAV.inertia
assert BODY is not None
INERTIA = (BODY.ix, BODY.iy, BODY.iz, BODY.ixz)

MS = 1_000_000
S = 1_000_000_000


@pytest.fixture(scope="module")
def calm_flight() -> Flight:
    """A flight without gusts at 1 kHz, from which every Imu rate is sampled."""
    return flying.plant_flight(20.0, force=ColouredNoise(0.3, 0.5), rate=1000.0, max_step=1e-3)


# -- gaps --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lost", "gap", "limit"),
    [
        # A gap in the rates is detected at once; inputs are held for a while first.
        ("rates", 0.5, 2e-3),
        ("actuators", 0.5, 4e-2),
        ("actuators", 3.0, 4e-2),
        ("both", 3.0, 4e-2),
        ("a new time base", 0.0, 2e-3),
    ],
)
def test_a_gap_leaves_no_jump(calm_flight: Flight, gap: float, lost: str, limit: float) -> None:
    """Without noise any jump would come from a transient of the filters."""
    m = measure(calm_flight, Sensors())
    start = int(m.imu_t_ns[0]) + 12 * S
    end = start + round(gap * S)
    back = 10_000 * S if "base" in lost else 0
    kept = [
        message._replace(t_ns=message.t_ns - back * (message.t_ns > start))
        for message in flying.messages(m)
        if not (start < message.t_ns < end and lost in (message.stream, "both"))
    ]
    own = flying.settings(m, estimator="least_squares", model__inertia=INERTIA)
    estimates = flying.run(OnlineIdentifier(own), kept)
    t = np.array([e.t_ns + back * (e.t_ns < start - 100 * S) for e in estimates])
    columns = [STRUCTURES["augmented"].index(name) for name in flying.linear_names(calm_flight)]
    values = np.array([[e.coefficients[i] for i in columns] for e in estimates])
    before = values[np.searchsorted(t, start, side="right") - 1]
    after = values[(t > end) & (t < end + 5 * S)]
    assert len(after) > 40
    assert np.abs(after / before - 1.0).max() < limit


# -- memory ------------------------------------------------------------------------------------


PAPER = {
    "filter.method": "backward_difference", "estimator": "gradient", "structure": "augmented",
}  # fmt: skip


@pytest.mark.parametrize(
    ("feed", "own", "interval"),
    [
        *((feed, {}, 5) for feed in ("both", "rates", "actuators", "stopped rates")),
        *((feed, PAPER, 5) for feed in ("both", "rates", "actuators", "stopped rates")),
        ("both", {"actuators.interpolation": "linear"}, 5),
        ("both", {"actuators.learn_trim_time": 1.0}, 5),
        ("both", {}, 400),  # every interval is a gap
    ],
)
def test_memory_stays_bounded(feed: str, own: dict[str, Any], interval: int) -> None:
    identifier = OnlineIdentifier(Settings.from_values({"estimator": "least_squares", **own}))
    sizes = []
    for k in range(22_000 // interval):
        t = S + k * interval * MS
        if feed != "actuators" and not (feed == "stopped rates" and k > 500):
            identifier.add_rates(t, (0.1, 0.0, 0.0), (0.0, 0.0, 9.8))
        if feed != "rates" and k % 4 == 0:
            identifier.add_actuators(t, (0.0, 0.0, 0.0, 0.0))
        list(identifier.advance())
        if k % (1000 // interval) == 0:
            buffers = (identifier.sampler.rates, identifier.sampler.raw_inputs)
            waiting = sum(len(buffer._waiting_t) + len(buffer.t) for buffer in buffers)
            sizes.append(waiting + identifier.intake.waiting)
    assert max(sizes[15:]) < 600
    assert sizes[-1] <= max(sizes[10:20])


# -- independence of ticks, sensors and channels ----------------------------------------------


def test_the_rate_of_the_ticks_does_not_change_the_estimates() -> None:
    m = flying.light_measured(25.0, rate=200.0)
    usual, slow = (flying.identified(m, update_rate=rate)[1][-1] for rate in (20.0, 10.0))
    moved = np.abs(slow.coefficients - usual.coefficients)
    assert (moved <= 0.3 * usual.sigma).all()
    known = usual.sigma > 0.0
    ratio = slow.sigma[known] / usual.sigma[known]
    assert ratio.min() > 0.6 and ratio.max() < 1.6


VARIANTS: list[tuple[str, dict[str, Any], float]] = [
    # products of rates are not piecewise linear
    ("plain", {"rate": 50.0, "convention": "frd"}, 0.03),
    ("pwm", {"rate": 1000.0}, 0.01),
    ("elevon", {"drop": 0.2}, 0.01),
    ("plain", {"stamp_jitter": 0.005}, 0.05),
    ("quadrotor", {"stamped": False}, 0.01),
]


@pytest.mark.parametrize(("channels", "variant", "limit"), VARIANTS)
def test_sensors_and_channels_do_not_change_the_coefficients(
    calm_flight: Flight, channels: str, variant: dict[str, Any], limit: float
) -> None:
    """Without noise only the pairing of rates and inputs matters."""
    m = measure(replace(calm_flight, channel_set=CHANNEL_SETS[channels]), Sensors(**variant))
    _, (*_, last) = flying.identified(m, estimator="least_squares")
    names = flying.linear_names(calm_flight)
    assert flying.worst_error(last.coefficients, calm_flight, names, "augmented") < limit
