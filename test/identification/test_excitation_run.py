# SPDX-License-Identifier: Apache-2.0
"""A run of excitation: its signals, its limits, its end."""

from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest
from estimates import estimate_of

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.excitation_run import (
    ZERO_TIME_NS,
    ExcitationRun,
    Flying,
    Injection,
    Phase,
)
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import ExcitationSettings, Settings
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.identification.waveforms import ProgrammedInput, multisines

ARMED = "std_msgs/msg/Bool"
TICK_NS = 50_000_000
T0_NS = 1_000 * TICK_NS
STRUCTURE = STRUCTURES["flight_dynamics"]
SETTINGS = ExcitationSettings(duration=20.0)
SEED_1 = [
    [-0.9932, 0.9325, -0.5637, -0.5796],
    [-0.9993, 0.1056, -0.2855, 0.0996],
    [-0.9740, -0.9674, -0.9668, 0.1118],
]
"""Multisines of seed 1, 0.1 to 2 Hz, at 1, 4 and 7.3 s, shape (3, 4)."""

LEVEL = Flying(np.zeros(3), roll=0.0, pitch=0.05, airspeed=20.0)


def estimate(
    t_ns: int, ratio: float = 1.0, state: str = "learning", value: float = 1.0
) -> Estimate:
    """An estimate whose coefficients have a t-ratio of `ratio`."""
    values = value * STRUCTURE.mask
    return estimate_of(
        values, values / ratio, t_ns=t_ns, usable=False, state=state, reason="why it waits"
    )


def started(settings: ExcitationSettings = SETTINGS) -> ExcitationRun:
    run = ExcitationRun(STRUCTURE)
    assert run.start(settings, LEVEL, estimate(T0_NS)) == ""
    return run


def flown(run: ExcitationRun, ticks: int, ratio: float = 1.0) -> list[Injection | None]:
    """Step through `ticks` ticks after the start; return the injected signals."""
    steps = (T0_NS + (k + 1) * TICK_NS for k in range(ticks))
    return [run.step(LEVEL, estimate(t_ns, ratio)) for t_ns in steps]


def values(injection: list[Injection | None]) -> np.ndarray:
    return np.array([a.values for a in injection if a is not None])


# --- the signals -------------------------------------------------------------------------------


def test_multisines_are_orthogonal_with_low_peaks_and_the_set_amplitudes() -> None:
    design = ProgrammedInput(
        ExcitationSettings(amplitude=(0.02, 0.03, 0.04, 0.1), band=(0.1, 2.0), fade_time=0.0)
    )
    t = np.arange(0.0, design.period, 0.01)
    u = np.array([design.sample(float(v)) for v in t])
    gram = u.T @ u
    scale = np.sqrt(np.diag(gram))
    np.testing.assert_allclose(gram / np.outer(scale, scale), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(np.abs(u).max(axis=0), [0.02, 0.03, 0.04, 0.1], rtol=0.01)
    relative_peak = np.ptp(u, axis=0) / (np.sqrt(8.0) * u.std(axis=0))
    assert relative_peak.max() < 1.25  # a single sine has 1
    power = np.abs(np.fft.rfft(u, axis=0)) ** 2
    frequency = np.fft.rfftfreq(len(t), 0.01)
    outside = (frequency < 0.1 - 1e-6) | (frequency > 2.0 + 1e-6)
    assert power[outside].max() < 1e-12 * power.max()
    assert (power[~outside].max(axis=1) > 1e-4 * power.max()).all()  # no harmonic is missing


@pytest.mark.parametrize("low", [0.1, 0.3])
def test_multisines_repeat_after_two_cycles_of_the_lowest_frequency(low: float) -> None:
    design = ProgrammedInput(ExcitationSettings(band=(low, 2.0), duration=60.0, fade_time=0.0))
    first, half, whole = (
        np.array([design.sample(t + later)[:3] for t in np.arange(0.0, 5.0, 0.05)])
        for later in (0.0, 1.0 / low, 2.0 / low)
    )
    np.testing.assert_allclose(whole, first, atol=1e-9)
    assert (np.abs(half - first).max(axis=0) > 0.1 * np.abs(first).max(axis=0)).all()


def test_the_signals_of_a_seed_are_reproduced() -> None:
    """Documented flights and figures depend on the signals of a seed."""
    signals = multisines(np.array([1.0, 4.0, 7.3]), 4, 20.0, (0.1, 2.0), seed=1)
    np.testing.assert_allclose(signals, SEED_1, atol=1e-4)


def test_multisines_fade_in_and_out() -> None:
    settings = ExcitationSettings(duration=20.0, fade_time=2.0)
    faded, plain = ProgrammedInput(settings), ProgrammedInput(replace(settings, fade_time=0.0))
    for t, share in ((0.5, 0.25), (2.0, 1.0), (11.0, 1.0), (19.5, 0.25)):
        np.testing.assert_allclose(faded.sample(t), share * plain.sample(t))
    assert not faded.sample(20.0).any() and not faded.sample(-0.01).any()


@pytest.mark.parametrize("form", ["3211", "doublet", "probe"])
def test_pulses_move_every_input_one_at_a_time(form: str) -> None:
    design = ProgrammedInput(ExcitationSettings(form=form, amplitude=(0.02, 0.03, 0.0, 0.1)))
    u = np.array([design.sample(float(t)) for t in np.arange(0.0, design.duration, 0.01)])
    moved = np.abs(u) > 0.0
    assert moved.sum(axis=1).max() == 1
    np.testing.assert_array_equal(moved.any(axis=0), [True, True, False, True])
    np.testing.assert_allclose(u.max(axis=0), [0.02, 0.03, 0.0, 0.1])
    np.testing.assert_allclose(u.min(axis=0), [-0.02, -0.03, 0.0, -0.1])
    turns = design.duration / design.period
    assert turns == 1.0 if form == "probe" else turns > 1.0 and turns == round(turns)
    runs = [(sign, len(list(run))) for sign, run in groupby(np.sign(u[:, 0]))]
    pulses = runs[: 4 if form == "3211" else 2]
    assert [sign for sign, _ in pulses] == [1.0, -1.0, 1.0, -1.0][: len(pulses)]
    lengths = np.array([length for _, length in pulses]) / pulses[-1][1]
    np.testing.assert_allclose(lengths, [3, 2, 1, 1] if form == "3211" else [1, 1], rtol=0.05)


def test_a_doublets_spectrum_is_highest_in_mid_band() -> None:
    low, high = 0.5, 4.0
    settings = ExcitationSettings(form="probe", amplitude=(1.0, 0.0, 0.0, 0.0), band=(low, high))
    design = ProgrammedInput(settings)
    t = np.arange(0.0, 40.0, 0.005)
    power = np.abs(np.fft.rfft([design.sample(float(v))[0] for v in t])) ** 2
    peak = np.fft.rfftfreq(len(t), 0.005)[power.argmax()]
    assert peak == pytest.approx(np.sqrt(low * high), rel=0.03)


# --- a run -------------------------------------------------------------------------------------


def test_a_run_sends_the_signal_then_zeros_then_no_messages() -> None:
    run = ExcitationRun(STRUCTURE)
    assert run.step(LEVEL, estimate(T0_NS)) is None  # no message before the start
    assert run.start(SETTINGS, LEVEL, estimate(T0_NS)) == ""
    injection = flown(run, 440)
    lead_ns = round(SETTINGS.lead * 1e9)
    design = ProgrammedInput(SETTINGS)
    for k in (0, 10, 100, 300):
        sent = injection[k]
        assert sent is not None
        assert sent.t_ns == T0_NS + (k + 1) * TICK_NS + lead_ns
        np.testing.assert_array_equal(sent.values, design.sample((k + 1) * 0.05))
    assert np.abs(values(injection)).max() > 0.9 * max(SETTINGS.amplitude)
    zeros = [a for a in injection[400:] if a is not None]
    assert not values(injection[400:]).any()
    assert len(zeros) == pytest.approx(ZERO_TIME_NS / TICK_NS, abs=1)
    assert injection[-1] is None
    assert run.step(LEVEL, estimate(T0_NS)) is None  # silent after the clock went back, too
    assert run.why.startswith("complete; not known yet: pdot/p")


@pytest.mark.parametrize("ticks", [0, 1, 10, 100, 396, 399])
@pytest.mark.parametrize("back_ns", [0, 10**11])
def test_an_abort_sends_zeros_at_once_in_every_phase(ticks: int, back_ns: int) -> None:
    """The clock may go back, which ends a run as well."""
    run = started()
    flown(run, ticks)
    now_ns = T0_NS + ticks * TICK_NS + 7
    injection = run.abort(now_ns, "aborted: asked for")
    assert injection.t_ns == now_ns and not injection.values.any()
    assert run.phase is Phase.IDLE and run.why == "aborted: asked for"
    begin_ns = now_ns - back_ns
    after = [run.step(LEVEL, estimate(begin_ns + k * TICK_NS)) for k in range(1, 30)]
    assert not values(after).any()
    assert after[0] is not None and after[-1] is None


BEYOND = [
    (replace(LEVEL, rates=np.array([0.0, 1.6, 0.0])), "learning", "pitch rate 1.60"),
    (replace(LEVEL, rates=np.array([np.nan, 0.0, 0.0])), "learning", "roll rate nan"),
    (replace(LEVEL, rates=None), "learning", "no rates"),
    (replace(LEVEL, roll=-0.9), "learning", "roll angle -0.90"),
    (replace(LEVEL, pitch=0.81), "learning", "pitch angle 0.81"),
    (replace(LEVEL, airspeed=14.0), "learning", "airspeed 14.0"),
    (replace(LEVEL, airspeed=26.0), "learning", "airspeed 26.0"),
    (replace(LEVEL, grounded="not armed"), "learning", "not armed"),
    (LEVEL, "waiting", "waiting: why it waits"),  # its inputs are missing
    (LEVEL, "fault", "fault: why it waits"),
]


def test_beyond_a_limit_a_run_does_not_start_and_ends_at_once() -> None:
    settings = replace(SETTINGS, min_airspeed=15.0, max_airspeed=25.0)
    for flying, state, named in BEYOND:
        printed = ExcitationRun(STRUCTURE).start(settings, flying, estimate(T0_NS, state=state))
        assert named in printed
        run = started(settings)
        flown(run, 100)
        t_ns = T0_NS + 101 * TICK_NS
        injection = run.step(flying, estimate(t_ns, state=state))
        assert injection is not None
        assert injection.t_ns == t_ns and not injection.values.any()
        assert run.why.startswith("aborted: ") and named in run.why


def test_a_refused_start_has_a_reason_and_unknown_signals_do_not_refuse_it() -> None:
    assert ExcitationRun(STRUCTURE).start(SETTINGS, Flying(np.zeros(3)), estimate(T0_NS)) == ""
    assert "going on" in started().start(SETTINGS, LEVEL, estimate(T0_NS))
    still = replace(SETTINGS, amplitude=(0.0,) * 4)
    assert "'excitation.amplitude'" in ExcitationRun(STRUCTURE).start(still, LEVEL, estimate(T0_NS))
    narrow = replace(SETTINGS, band=(1.0, 1.2))
    assert "'excitation.band'" in ExcitationRun(STRUCTURE).start(narrow, LEVEL, estimate(T0_NS))


# --- sufficient information -----------------------------------------------------------------


def test_a_run_fades_out_when_all_is_known_but_not_before_a_period() -> None:
    settings = replace(SETTINGS, duration=60.0)
    run, design = started(settings), ProgrammedInput(settings)
    injection = flown(run, 399, ratio=100.0)
    size = np.abs(values(injection)).max(axis=1)
    ends = int(np.flatnonzero(size)[-1]) + 2
    assert 0.05 * ends == pytest.approx(design.period + settings.fade_time, abs=0.1)
    assert run.why == f"everything is known after {design.period:.0f} s"
    plain = np.abs([design.sample(0.05 * (k + 1)) for k in range(ends)]).max(axis=1)
    assert (np.diff(size[ends - 20 : ends - 1] / plain[-20:-1]) < 0.0).all()  # a fade, no step
    run = started(replace(SETTINGS, min_t_ratio=0.0))  # without a t-ratio the run is complete
    flown(run, 398, ratio=100.0)
    assert run.active


def test_the_time_left_follows_from_the_information_gained_per_second() -> None:
    """sigma^-2 = I0 + k t, with the run's own k and the information I0 at its start."""
    run = started(replace(SETTINGS, duration=300.0))
    before, gain = 4.0, 0.5  # t-ratio squared at the start, and its growth per second
    for k in range(1, 201):
        t_ns = T0_NS + k * TICK_NS
        run.step(LEVEL, estimate(t_ns, ratio=np.sqrt(before + gain * k * 0.05)))
    assert run.sufficiency is not None
    known_at = (SETTINGS.min_t_ratio**2 - before) / gain
    assert run.sufficiency.time_left == pytest.approx(known_at - 10.0, rel=1e-6)
    assert "pdot/da" in run.sufficiency.unknown
    assert "pdot/dth" not in run.sufficiency.unknown  # dth is not excited


def test_a_negligible_coefficient_counts_as_known_by_its_sigma() -> None:
    run = started(replace(SETTINGS, min_t_ratio=10.0))
    t_ns = T0_NS + TICK_NS
    sharp = estimate(t_ns, ratio=100.0, value=10.0)
    row, column = STRUCTURE.index("rdot/da")
    for value, sigma, known in ((0.1, 0.5, True), (0.1, 1.5, False)):
        coefficients, sigmas = sharp.coefficients.copy(), sharp.sigma.copy()
        coefficients[row, column], sigmas[row, column] = value, sigma
        run.step(LEVEL, replace(sharp, coefficients=coefficients, sigma=sigmas))
        assert run.sufficiency is not None
        assert (run.sufficiency.unknown == ()) is known
    assert run.sufficiency.effects["da"] == ("pdot/da", 10.0, pytest.approx(0.1))


def test_attitude_and_airspeed_for_the_limits_follow_from_the_messages() -> None:
    """A vehicle at rest on a slope, in the wind: the accelerometer gives the attitude."""
    settings = Settings.from_values(
        {"imu.convention": "frd", "airspeed.type": "std_msgs/msg/Float64", "armed.type": ARMED}
    )
    identifier = OnlineIdentifier(settings)
    assert identifier.flying().rates is None
    force = (9.81 * np.sin(0.2), -9.81 * np.sin(0.5) * np.cos(0.2), -9.81 * np.cos(0.5) * 0.98)
    for k in range(600):
        t_ns = T0_NS + k * 10_000_000
        identifier.add_actuators(t_ns, (0.0,) * 4)
        identifier.add_airspeed(t_ns, 18.0)
        identifier.add_rates(t_ns, (1e-3 * (k % 2), 0.0, 0.0), force)
        list(identifier.advance())
    flying = identifier.flying()
    assert (flying.roll, flying.pitch) == pytest.approx((0.5, 0.2), abs=0.02)
    assert flying.airspeed == 18.0
    assert flying.grounded == "no message says that it is armed"
    identifier.add_armed(T0_NS + 6_000_000_000, True)
    for seconds, problem in ((7, ""), (9, "no airspeed has arrived in the last 2 s")):
        identifier.update(T0_NS + seconds * 1_000_000_000)
        assert identifier.flying().grounded == problem
