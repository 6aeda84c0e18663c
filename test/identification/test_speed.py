# SPDX-License-Identifier: Apache-2.0
"""Speed scaling: one set of coefficients over a range of airspeeds."""

from copy import deepcopy
from functools import cache
from typing import Any

import numpy as np
import pytest
from flying import AMPLITUDES, integrated, run, sent

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import AirspeedSettings, Settings
from uav_ident_ros.identification.speed import AirspeedFilter, SpeedScaling
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray
from uav_ident_ros.simulation.inputs import Segment, sample_inputs
from uav_ident_ros.simulation.plant import SMALL_UAV

RATE = 100.0
REFERENCE = 20.0
START_NS = 1_700_000_000 * 10**9
PLANT = SMALL_UAV
STRUCTURE = STRUCTURES[PLANT.structure]


def airspeed(t: FloatArray) -> FloatArray:
    """Slow variation between 14 and 28 m/s."""
    return 21.0 + 7.0 * np.sin(2 * np.pi * t / 40.0)


def scaled(speed: float) -> FloatArray:
    """Coefficients of the plant at an airspeed."""
    ratio = speed / REFERENCE
    power = np.r_[np.zeros(5), np.ones(3), 2.0 * np.ones(4)]
    return PLANT.coefficients * ratio**power


@cache
def flown() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times, rates and inputs of a plant whose coefficients follow the airspeed."""
    t = np.arange(round(40.0 * RATE)) / RATE
    u = sample_inputs([Segment("multisine", amplitudes=AMPLITUDES, seed=1)], t)
    return t, integrated(STRUCTURE, t, u, lambda now: scaled(float(airspeed(np.array(now))))), u


def worst_linear(found: FloatArray, truth: FloatArray) -> float:
    linear = STRUCTURE.mask & (np.arange(12) >= 5)
    return float(np.abs(found / np.where(linear, truth, 1.0) - 1.0)[linear].max())


FRD = {"imu.convention": "frd", "forgetting_time": 0.0, "update_rate": 10.0}
MEASURED = {"airspeed.type": "std_msgs/msg/Float64", "airspeed.reference": REFERENCE}


def identify(
    silent: tuple[float, float] = (0.0, 0.0), noise: float = 0.0, **values: Any
) -> tuple[OnlineIdentifier, list[Estimate]]:
    """The identifier after the flight, and its estimates.

    No airspeed arrives in an interval, s; it has a noise, m/s rms.
    """
    identifier = OnlineIdentifier(
        Settings.from_values({"structure": STRUCTURE.name, **FRD, **values})
    )
    t, x, u = flown()
    t_ns = [START_NS + round(now * 1e9) for now in t]
    speed = airspeed(t) + noise * np.random.default_rng(1).standard_normal(len(t))
    told = [
        sample
        for now, sample in zip(t, sent("airspeed", t_ns, speed[:, None]), strict=True)
        if not silent[0] < now < silent[1]
    ]
    stream = [*sent("actuators", t_ns, u), *told, *sent("rates", t_ns, x)]
    return identifier, run(identifier, sorted(stream, key=lambda sample: sample.t_ns))


def test_one_set_of_coefficients_holds_at_all_airspeeds() -> None:
    identifier, (*_, estimate) = identify(**MEASURED)
    assert worst_linear(identifier.coefficient_set().values, PLANT.coefficients) < 0.02
    now = (estimate.t_ns - START_NS) * 1e-9
    assert worst_linear(estimate.coefficients, scaled(float(airspeed(np.array(now))))) < 0.02


def test_a_silent_airspeed_pauses_learning_and_denies_the_verdict_until_it_returns() -> None:
    _, estimates = identify(silent=(32.0, 36.0), **MEASURED)
    states = {
        (e.state, e.reason, e.usable) for e in estimates if 34.1 < (e.t_ns - START_NS) * 1e-9 < 36.0
    }
    assert states == {("paused", "no airspeed has arrived in the last 2 s", False)}
    before, after = (estimates[round(10.0 * t)] for t in (33.0, 37.0))
    assert before.usable and after.usable


def test_without_an_airspeed_the_scaling_is_off() -> None:
    identifier, (*_, estimate) = identify()
    np.testing.assert_array_equal(identifier.coefficient_set().values, estimate.coefficients)
    assert worst_linear(estimate.coefficients, PLANT.coefficients) > 0.05


@pytest.mark.parametrize(
    ("speed", "ratio"), [(200.0, 3.0), (1.0, 1.0 / 3.0), (0.0, 1.0 / 3.0), (40.0, 2.0)]
)
def test_the_scaling_is_limited_to_three_times_the_reference(speed: float, ratio: float) -> None:
    scaling = SpeedScaling(AirspeedSettings("std_msgs/msg/Float64", REFERENCE), STRUCTURE)
    scaling.samples.append(START_NS, (speed,))
    scaling.samples.merge(START_NS)
    scaling.update(START_NS)
    assert scaling.newest == speed
    assert scaling.scale[STRUCTURE.index("pdot/p")] == pytest.approx(ratio)
    assert scaling.scale[STRUCTURE.index("pdot/da")] == pytest.approx(ratio**2)


def filtered(
    samples: FloatArray, found: AirspeedFilter | None = None, start_ns: int = START_NS
) -> tuple[FloatArray, FloatArray]:
    """Airspeed and its sigma after each of some samples, m/s, a tenth of a second apart."""
    found, out = found or AirspeedFilter(), []
    for k, sample in enumerate(samples.tolist()):
        found.add(start_ns + k * 10**8, sample)
        out.append((found.airspeed, found.sigma))
    return np.array(out).T


def random_walk(step: float, noise: float) -> tuple[FloatArray, FloatArray]:
    """An airspeed in gusts, and its samples over ten minutes, m/s."""
    rng = np.random.default_rng(1)
    true = 20.0 + step * np.cumsum(rng.standard_normal(6000))
    return true, true + noise * rng.standard_normal(len(true))


@pytest.mark.parametrize(("step", "noise"), [(0.05, 0.5), (0.1, 0.3), (0.3, 0.3), (0.2, 3.0)])
def test_the_filter_is_as_good_as_kalmans_of_known_noise(step: float, noise: float) -> None:
    true, samples = random_walk(step, noise)
    found, sigma = (signal[600:] for signal in filtered(samples))
    ratio = (step / noise) ** 2  # Harvey 1989, section 4.1.2
    gain = 0.5 * (np.sqrt(ratio**2 + 4.0 * ratio) - ratio)
    least = noise * np.sqrt(gain)
    assert np.sqrt(np.mean((found - true[600:]) ** 2)) < 1.1 * least
    assert np.median(sigma) == pytest.approx(least, rel=0.15)


def test_an_airspeed_without_noise_passes_as_it_is() -> None:
    samples = airspeed(np.arange(0.0, 120.0, 0.1))
    found, sigma = filtered(samples)
    np.testing.assert_array_equal(found, samples)
    assert not sigma.any()
    true, samples = random_walk(0.3, 0.0)
    # the bandwidth of 32 1/s keeps a share of exp(-3.2) of a step
    assert np.std((filtered(samples)[0] - true)[600:]) < 0.05 * 0.3


def test_a_step_of_the_sensor_and_its_return_are_followed_at_once() -> None:
    _, samples = random_walk(0.05, 0.5)
    samples[3000:3100] *= 0.7
    found, _ = filtered(samples)
    assert found[3000] == samples[3000]
    assert found[3100] == samples[3100]
    assert np.std(np.diff(found[3200:])) < 0.3 * np.std(np.diff(samples[3200:]))


def test_after_a_silence_or_in_a_new_time_base_the_first_sample_counts() -> None:
    """A new time base keeps the known noise."""
    true, samples = random_walk(0.05, 0.5)
    filtered(samples[:1000], found := AirspeedFilter())
    anew = deepcopy(found)
    found.add(START_NS + 120 * 10**9, true[1000] + 1.5)
    assert found.airspeed == pytest.approx(true[1000] + 1.5, abs=0.02)
    anew.restart()
    errors = filtered(samples[1000:1100], anew, 1)[0] - true[1000:1100]
    assert anew.airspeed != samples[1099]
    assert errors[0] == pytest.approx(samples[1000] - true[1000])
    assert np.std(errors[10:]) < 0.25  # not the 0.5 of the samples


def test_noise_of_the_airspeed_neither_shakes_the_coefficients_nor_escapes_sigma() -> None:
    _, estimates = identify(noise=3.0, **MEASURED)
    late = [e for e in estimates if (e.t_ns - START_NS) * 1e-9 > 20.0]
    for name in ("pdot/da", "qdot/de", "rdot/dr"):
        place = STRUCTURE.index(name)
        value, sigma = np.array([(e.coefficients[place], e.sigma[place]) for e in late]).T
        speed = airspeed(np.array([(e.t_ns - START_NS) * 1e-9 for e in late]))
        true = PLANT.coefficients[place] * (speed / REFERENCE) ** 2
        error = value - true
        assert np.std(error / true) < 0.1, name  # 0.3 with the samples as they are
        assert np.mean(np.abs(error) < 2.0 * sigma) > 0.9, name


def test_sigma_of_the_airspeed_enters_by_the_power_of_each_coefficient() -> None:
    scaling = SpeedScaling(AirspeedSettings("std_msgs/msg/Float64", REFERENCE), STRUCTURE)
    samples = random_walk(0.05, 0.5)[1][:600]
    for k, sample in enumerate(samples.tolist()):
        scaling.samples.append(START_NS + k * 10**8, (sample,))
    scaling.samples.merge(START_NS + 10**12)
    scaling.update(START_NS + 10**12)
    sigma, share = np.where(STRUCTURE.mask, 0.1, 0.0), filtered(samples)[1][-1] / scaling.airspeed
    fixed, inertia = STRUCTURE.index("pdot/dr"), STRUCTURE.index("pdot/qr")
    sigma[fixed] = 0.0
    wide = scaling.widened(sigma, 10.0 * PLANT.coefficients)
    for name, power in (("pdot/p", 1.0), ("pdot/da", 2.0)):
        place = STRUCTURE.index(name)
        by_speed = power * share * 10.0 * PLANT.coefficients[place]
        assert wide[place] == pytest.approx(np.hypot(0.1, by_speed))
    assert wide[fixed] == 0.0
    assert wide[inertia] == 0.1
