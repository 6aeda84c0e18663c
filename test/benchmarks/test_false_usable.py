# SPDX-License-Identifier: Apache-2.0
"""False `usable` verdicts: the criterion of a wrong derivative, and the true derivatives."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

pytest.importorskip("jsbsim", reason="JSBSim is a development extra")

import false_usable
import verdict_flights
from imperfections import IMPERFECTIONS, behind
from light_aircraft import TRUTH

from uav_ident_ros.identification.structure import STRUCTURES


def test_a_wrong_derivative_has_a_large_error_and_a_small_sigma() -> None:
    value = np.array([40.0, 20.0, 20.0, -20.0, -2.0, 10.0])
    spread = np.array([1.0, 1.0, 10.0, 1.0, 20.0, 1.0])
    truth = np.array([45.0, 45.0, 45.0, 45.0, 45.0, 0.0])
    far, sign = false_usable.judge(value, spread, truth)
    assert far.tolist() == [False, True, False, True, False, True]
    assert sign.tolist() == [False, False, False, True, False, False]


@pytest.mark.parametrize("name", sorted(STRUCTURES))
def test_whole_derivatives_of_the_true_coefficients_are_the_true_derivatives(name: str) -> None:
    structure = STRUCTURES[name]
    values = verdict_flights.coefficients(structure, TRUTH)[None]
    for derivative in false_usable.MAIN:
        value, _ = false_usable.whole(structure, TRUTH, derivative, values, np.zeros_like(values))
        assert value[0] == pytest.approx(TRUTH[derivative])


def test_every_class_has_flights_and_a_failure_changes_the_true_derivative() -> None:
    trials = verdict_flights.trials(list(verdict_flights.CLASSES), (1, 2))
    assert len(trials) >= 40
    # the repository has no recorded flights
    assert {trial.kind for trial in trials} | {"recorded"} == set(verdict_flights.CLASSES)
    imperfect = {trial.name for trial in verdict_flights.trials(["imperfect"], range(1, 6))}
    aircraft = [name for name, _ in verdict_flights.IMPERFECT_AIRCRAFT]
    assert imperfect == {f"{name}, {label}" for name in aircraft for label in IMPERFECTIONS}
    reversed_ = next(t for t in trials if t.name == "c172p, dr x -1 after the excitation")
    flight = partial(reversed_.fly, duration=80.0)().flight
    assert verdict_flights.truth(flight, 70.0)["rdot/dr"] == pytest.approx(-4.19, rel=0.01)
    assert verdict_flights.truth(flight, 76.0)["rdot/dr"] == pytest.approx(4.19, rel=0.01)


def test_every_imperfection_changes_the_signals_or_the_surfaces() -> None:
    clean = verdict_flights.fly("light_aircraft", 1, duration=16.0, excitation=((0.0, 1e3),))
    commands = np.outer([0.005, 0.06], [1.0, -1.0, 1.0, 1.0])  # small and large
    for label, values in IMPERFECTIONS.items():
        if "spoil" in values:
            spoiled = values["spoil"](np.random.default_rng(1), clean)
            assert any(
                not np.array_equal(getattr(spoiled, name), getattr(clean, name))
                for name in ("imu_t_ns", "rates", "specific_force", "actuator_t_ns", "actuators")
            ), label
        elif "actuators" in values:
            reached = [values["actuators"](np.zeros(4), commanded) for commanded in commands]
            assert not np.array_equal(np.array(reached)[:, :3], commands[:, :3]), label
            assert np.array_equal(np.array(reached)[:, 3], commands[:, 3]), label
        else:
            assert replace(verdict_flights.SENSORS, **values["sensors"]) != verdict_flights.SENSORS


def test_surfaces_behind_a_play_stay_while_the_record_has_the_commands() -> None:
    play = partial(behind, 1.0)
    flown = verdict_flights.fly(
        "light_aircraft", 1, duration=4.0, excitation=((0.0, 1e3),), actuators=play
    )
    surfaces = flown.flight.extra["surfaces"]
    assert np.ptp(surfaces[:, :3], axis=0).max() < 1e-4
    assert np.ptp(surfaces[:, 3]) > 0.0
    assert np.ptp(flown.actuators, axis=0).min() > 0.02


def test_a_clean_flight_is_usable_without_wrong_derivatives() -> None:
    trial = verdict_flights.trials(["clean"], (1,), 0.5)[0]
    outcome = false_usable.run(trial, "")
    assert outcome.usable > 0.9
    assert outcome.wrong == outcome.wrong_sign == outcome.fault == 0.0
    assert "clean" in false_usable.report([outcome])


@pytest.mark.parametrize(
    ("seed", "name"), [(1, "wind 0.3, travel 0.06"), (2, "wind 1, travel 0.04")]
)
def test_surfaces_that_saturate_are_not_usable_after_a_warm_start(seed: int, name: str) -> None:
    trials = verdict_flights.trials(["warm"], (seed,), verdict_flights.SHORT)
    (trial,) = (trial for trial in trials if name in trial.name)
    assert false_usable.run(trial, "").wrong < 0.02


def test_the_injected_signal_of_a_published_flight_is_given_to_the_identifier() -> None:
    """Without it a gust that an autopilot answers widens sigma."""
    trial = verdict_flights.trials(["published"], (1,), 0.3)[0]
    assert trial.published
    with_, without = (
        false_usable.run(replace(trial, published=published), "") for published in (True, False)
    )
    assert with_.last["pdot/da"] != without.last["pdot/da"]


def test_a_flight_through_a_bag_gives_the_same_coefficients() -> None:
    trial = next(t for t in verdict_flights.trials(["clean"], (1,), 0.3) if t.replayed)
    replayed = false_usable.run(trial, "")
    direct = false_usable.run(replace(trial, replayed=False), "")
    for name, values in direct.last.items():  # the bag's parameter file has nine figures
        assert replayed.last[name] == pytest.approx(values, rel=1e-6)
    assert replayed.usable == direct.usable
