# SPDX-License-Identifier: Apache-2.0
"""Properties for every sequence of inputs: finite, bounded estimates, whatever the batching.

Hypothesis draws the sequences, by the profiles of test/conftest.py.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import example, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.identifier import OnlineIdentifier, State
from uav_ident_ros.identification.samples import LARGEST_GYRO_RATE, LATEST_STAMP
from uav_ident_ros.identification.settings import LARGEST_NUMBER, Settings, SettingsError
from uav_ident_ros.identification.speed import LARGEST_SPEED_RATIO
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray
from uav_ident_ros.simulation.noise import SentSample

S = 1_000_000_000
MS = 1_000_000

START_NS = 1_700_000_000 * S

FEWER = hypothesis_settings(max_examples=hypothesis_settings().max_examples // 5)
"""For examples that take a second each."""

HOSTILE = (
    math.nan, math.inf, -math.inf, 1.7e308, -1.7e308, 1e154, 5e-324, -5e-324, 2.2e-308, 1e-160,
    99.999, -99.999, 999.9, 99_999.0, -99_999.0, -0.0,
)  # fmt: skip
"""Values that break arithmetic, and the largest accepted ones."""

ROOT_3 = math.sqrt(3.0)

any_float = st.floats(allow_subnormal=True, width=64)
any_stamp = st.one_of(
    st.integers(-(2**65), 2**65),
    st.integers(-10, 10),
    st.integers(-5 * S, 5 * S).map(lambda offset: START_NS + offset),
)

# --- settings ---------------------------------------------------------------------------------


def changed(values: dict[str, object]) -> Settings:
    """Return settings with the given values, changed where these exclude each other."""
    if (values["structure"], values["estimator"]) == ("flight_dynamics", "gradient"):
        values = values | {"estimator": "least_squares"}
    try:
        return Settings.from_values(values)
    except SettingsError:
        return Settings.from_values(
            values | {"actuators.estimate_delay": False, "airspeed.type": ""}
            if values["estimator"] == "gradient"
            else values | {"filter.method": "state_variable"}
        )


any_settings = st.fixed_dictionaries(
    {
        "structure": st.sampled_from(sorted(STRUCTURES)),
        "estimator": st.sampled_from(["instrumental_variable", "least_squares", "gradient"]),
        "filter.method": st.sampled_from(["state_variable"] * 3 + ["backward_difference"]),
        "update_rate": st.sampled_from([20.0, 7.0, 50.0]),
        "input_wait": st.sampled_from([0.05, 0.0]),
        "forgetting_time": st.sampled_from([200.0, 5.0, 0.0]),
        "filter.cutoff": st.sampled_from([15.0, 200.0, 1.0]),
        "actuators.estimate_delay": st.booleans(),
        "actuators.delay": st.sampled_from([0.0, 0.03]),
        "actuators.time_constant": st.sampled_from([0.0, 0.05]),
        "actuators.interpolation": st.sampled_from(["hold", "linear"]),
        "actuators.learn_trim_time": st.sampled_from([0.0, 0.5]),
        "airspeed.type": st.sampled_from(["", "std_msgs/msg/Float64"]),
        "armed.type": st.sampled_from(["", "std_msgs/msg/Bool"]),
        "model.leak_time": st.sampled_from([5.0, 0.0]),
        "model.inertia": st.sampled_from([(), (1.1, 1.4, 2.1, 0.1)]),
        "gradient.step": st.sampled_from(["guarded", "euler"]),
        "gradient.normalisation": st.sampled_from(["variance", "power", "none"]),
        "imu.lever_arm": st.sampled_from([(0.0, 0.0, 0.0), (0.3, -0.1, 100.0)]),
    }
).map(changed)


# --- events -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fly:
    """Samples of all streams: a first-order response to multisines, some values hostile."""

    seconds: float
    rate: float
    amplitude: float
    hostility: float  # Share of replaced values
    seed: int

    def samples(self, start_ns: int) -> Iterator[tuple[str, int, tuple[float, ...]]]:
        """Return streams, stamps and values of the samples."""
        rng = np.random.default_rng(self.seed)
        count = max(1, round(self.seconds * self.rate))
        t = np.arange(count) / self.rate
        phases = rng.uniform(0.0, 6.0, (4, 1))
        u = np.sin(np.linspace(3.0, 9.0, 4)[:, None] * t + phases).T
        x = self.amplitude * np.cumsum(u[:, [2, 0, 1]] + rng.normal(size=(count, 3)), axis=0)
        x /= max(1.0, self.rate)
        force = self.amplitude * rng.normal(size=(count, 3))
        offsets = np.arange(count) * round(S / self.rate) + rng.integers(0, 2, count) * MS
        for k in range(count):
            t_ns = start_ns + int(offsets[k])
            yield "rates", t_ns, self._with_hostile(rng, (*x[k], *force[k]))
            if k % 4 == 0:
                yield "actuators", t_ns, self._with_hostile(rng, self.amplitude * u[k])
            if k % 20 == 0:
                yield "airspeed", t_ns, self._with_hostile(rng, (20.0 + 5.0 * u[k, 0],))
                yield "armed", t_ns, (float(rng.random() < 0.9),)

    def _with_hostile(self, rng: np.random.Generator, values: ArrayLike) -> tuple[float, ...]:
        hostile = rng.random(np.size(values)) < self.hostility
        chosen = rng.choice(HOSTILE, np.size(values))
        return tuple(np.where(hostile, chosen, values).tolist())


def lived(settings: Settings, history: list[Any]) -> tuple[OnlineIdentifier, list[Estimate]]:
    """Return an identifier after all events, and its estimates."""
    identifier, now_ns = OnlineIdentifier(settings), START_NS
    estimates: list[Estimate] = []
    for event in history:
        match event:
            case Fly():
                for k, sample in enumerate(event.samples(now_ns)):
                    SentSample(0, *sample).give(identifier)
                    if k % 16 == 0:
                        estimates += identifier.advance()
                now_ns += round(event.seconds * S)
            case stream, t_ns, values, times:  # five that agree make a time base
                for k in range(times):
                    SentSample(0, stream, t_ns + k * MS, values).give(identifier)
            case "clock jumps", ns:
                now_ns = max(1, now_ns + ns)
            case "clock shows", t_ns:
                now_ns = t_ns
            case "adapt", adapt:  # as by services, parameters, jumps of /clock
                identifier.supervisor.adapt = adapt
            case "resume":
                identifier.resume(identifier.coefficient_set(now_ns), identifier.delay)
            case "note_saved":
                identifier.note_saved(identifier.coefficient_set(now_ns))
            case command:
                getattr(identifier, command)()
        estimates += identifier.advance()
    return identifier, estimates


flights = st.builds(
    Fly,
    # The first values are drawn most often.
    seconds=st.sampled_from([3.0, 8.0, 1.0, 0.1]),
    rate=st.sampled_from([200.0, 50.0, 4.0]),
    amplitude=st.sampled_from([1.0, 0.1, 30.0, 1e4, 1e-9, 1e-160, 1e-310, 0.0]),
    hostility=st.sampled_from([0.0, 0.0, 0.02, 0.3]),
    seed=st.integers(0, 2**32 - 1),
)
single_samples = st.tuples(  # any stamp, and any number of any values
    st.sampled_from(["rates", "actuators", "airspeed"]),
    any_stamp,
    st.lists(any_float, min_size=1, max_size=7).map(tuple),
    st.sampled_from([1, 1, 6]),
)
offsets = st.sampled_from([-3600 * S, -2 * S, -MS, 300 * MS, 2 * S, 3600 * S])
clocks = st.tuples(st.just("clock jumps"), offsets) | st.tuples(st.just("clock shows"), any_stamp)
adapt = st.tuples(st.just("adapt"), st.booleans())
commands = st.sampled_from(["reset", "restart", "resume", "note_saved"]) | adapt
events = st.one_of(flights, flights, flights, single_samples, clocks, commands)
histories = st.lists(events, min_size=3, max_size=12)


# --- finite and bounded -----------------------------------------------------------------------


def within(values: FloatArray, bound: float) -> bool:
    return bool((np.abs(values) <= bound).all())  # NaN fails too


def check(estimate: Estimate, settings: Settings) -> None:
    """Assert that everything in an estimate is finite and within its bounds."""
    scale = LARGEST_SPEED_RATIO**2 if settings.airspeed.type else 1.0
    assert within(estimate.coefficients, LARGEST_NUMBER * scale)
    assert np.isfinite(estimate.sigma).all()
    assert (estimate.sigma >= 0.0).all()
    # After a gap the model starts from the measured rates.
    assert within(estimate.predicted_rates, ROOT_3 * LARGEST_GYRO_RATE)
    assert within(estimate.prediction_error, 2.0 * ROOT_3 * LARGEST_GYRO_RATE)
    assert within(estimate.fit, 1000.0)
    assert (estimate.fit <= 100.0).all()
    assert estimate.state in [state.value for state in State]
    structure = STRUCTURES[settings.structure]
    assert not estimate.coefficients[~structure.mask].any()
    assert (estimate.flow is not None) == structure.has_flow
    if estimate.flow is not None:
        assert np.isfinite(estimate.flow).all()
        assert abs(np.linalg.norm(estimate.flow.down) - 1.0) < 1e-9
        assert estimate.flow.airspeed > 0.0


# An Imu at 4 Hz leaves only two delays, without a minimum between them.
SLOW_IMU = [Fly(seconds, rate, 0.1, 0.0, 0) for seconds, rate in ((6.0, 4.0), (2.0, 50.0))]

# Stamps of PX4 are 64 bits of microseconds.
BEYOND_64_BITS = [
    ("clock shows", 2**64 * 1000), SLOW_IMU[1], ("clock shows", 2**63 - S), SLOW_IMU[1],
]  # fmt: skip

# Signals whose squares underflow.
DENORMAL = [Fly(3.0, 50.0, 1e-160, 0.02, 1)]
DENORMAL_IN_THE_PAPER = [Fly(3.0, 50.0, 0.0, 0.02, 2)]
PAPER = Settings.from_values(
    {
        "estimator": "gradient",
        "filter.method": "backward_difference",
        "structure": "throttle_coupled",
    }
)


@FEWER
@example(settings=Settings(), history=DENORMAL)
@example(settings=PAPER, history=DENORMAL_IN_THE_PAPER)
@example(settings=Settings(), history=BEYOND_64_BITS)
@example(settings=Settings.from_values({"actuators.estimate_delay": True}), history=SLOW_IMU)
@given(settings=any_settings, history=histories)
def test_all_inputs_yield_finite_bounded_estimates(settings: Settings, history: list[Any]) -> None:
    identifier, estimates = lived(settings, history)
    for estimate in estimates:
        assert 0 < estimate.t_ns <= LATEST_STAMP
        check(estimate, settings)
    assert np.isfinite(identifier.estimator.information.excitation()).all()
    assert math.isfinite(identifier.delay)
    assert within(identifier.coefficient_set().values, LARGEST_NUMBER)


# --- batching and order -----------------------------------------------------------------------

Sample = tuple[str, int, tuple[float, ...]]

steady_flights = st.builds(
    Fly,
    seconds=st.sampled_from([0.3, 2.0, 4.0]),
    rate=st.sampled_from([50.0, 200.0]),
    amplitude=st.sampled_from([0.1, 1.0, 10.0]),
    hostility=st.sampled_from([0.0, 0.05]),
    seed=st.integers(0, 2**32 - 1),
)
gaps = st.sampled_from([0, 20 * MS, 400 * MS, 900 * MS])
legs = st.lists(st.tuples(steady_flights, gaps), min_size=1, max_size=4)
new_bases = st.sampled_from([2 * S, 400 * MS, 3600 * S])
jumping_legs = st.lists(st.tuples(steady_flights, new_bases), min_size=2, max_size=3)
TWO_BASES = [(Fly(3.0, 200.0, 1.0, 0.0, 1), 2 * S), (Fly(3.0, 200.0, 1.0, 0.0, 2), 0)]


def estimates_of(
    settings: Settings, samples: list[Sample], batches: Iterator[int]
) -> tuple[list[Estimate], dict[str, Any]]:
    """Return estimates and dropped samples, with ticks computed after batches of samples."""
    identifier, left = OnlineIdentifier(settings), next(batches)
    estimates: list[Estimate] = []
    for sample in samples:
        SentSample(0, *sample).give(identifier)
        left -= 1
        if left <= 0:
            estimates += identifier.advance()
            left = next(batches)
    estimates += identifier.advance()
    return estimates, identifier.intake.drops


def exactly(estimate: Estimate) -> tuple[Any, ...]:
    """Return everything in an estimate, arrays as bytes."""
    return tuple(
        value.tobytes() if isinstance(value, np.ndarray) else value
        for value in vars(estimate).values()
    )


@FEWER
@given(
    settings=any_settings,
    legs=legs | jumping_legs,
    sizes=st.lists(st.integers(1, 500), min_size=1, max_size=8),
    seed=st.integers(0, 2**32 - 1),
)
@example(settings=Settings(), legs=TWO_BASES, sizes=[97], seed=0)
def test_batching_and_order_of_arrival_do_not_change_the_estimates(
    settings: Settings, legs: list[tuple[Fly, int]], sizes: list[int], seed: int
) -> None:
    """The samples are the same; batches, and any order within `input_wait`, change no bit.

    Ticks due before a jump of the stamps are computed even after it.
    """
    samples: list[Sample] = []
    start_ns = START_NS
    for flight, gap_ns in legs:
        samples += flight.samples(start_ns)
        start_ns += round(flight.seconds * S) + gap_ns
    reference, dropped = estimates_of(settings, samples, itertools.repeat(1))
    jumps = any(gap_ns > S for _, gap_ns in legs)
    if not jumps:  # samples arrive up to `input_wait` late; at 0 only the streams' order changes
        wait_ns = max(round(settings.input_wait * S), 1)
        late = np.random.default_rng(seed).integers(0, wait_ns, len(samples)).tolist()
        arrivals = [sample[1] + wait for sample, wait in zip(samples, late, strict=True)]
        samples = [samples[k] for k in sorted(range(len(samples)), key=arrivals.__getitem__)]
    estimates, also_dropped = estimates_of(settings, samples, itertools.cycle(sizes))
    assert list(map(exactly, estimates)) == list(map(exactly, reference))
    assert also_dropped == dropped
