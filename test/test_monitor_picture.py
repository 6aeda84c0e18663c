# SPDX-License-Identifier: Apache-2.0
"""The monitor's view of the received messages: size, symbols, texts, verdict."""

import io
import math
import re

import numpy as np
import pytest
from excerpts import SECOND_NS
from rich.console import Console

from uav_ident_ros.bags.writing import joint_state
from uav_ident_ros.client import Coefficients
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.messages.published import FIT_NAMES, USABLE_NAME, entry_names
from uav_ident_ros.monitor.picture import picture
from uav_ident_ros.monitor.watched_node import TREND_TIME, Coefficient, WatchedNode

STATUS = {
    "excitation pdot [0..1]": "0.280", "hold p [%]": "-12.0", "hold q [%]": "3.0",
    "hold r [%]": "95.0", "delay [s]": "0.0231", "delay confidence": "sure",
    "collinear": "qdot/1, qdot/az; rdot/p, rdot/r",
    "ticks: count": "651", "ticks: update time p99 [ms]": "0.300",
    "rates: topic": "/mavros/imu/data_raw", "rates: rate [Hz]": "200.0", "rates: age [s]": "0.01",
    "rates: dropped": "3", "rates: dropped: late": "2", "rates: dropped: not finite": "1",
    "actuators: topic": "/mavros/rc/out", "actuators: rate [Hz]": "0.0",
    "actuators: age [s]": "no message yet", "actuators: dropped": "0",
    "airspeed: topic": "/airspeed", "airspeed: rate [Hz]": "10.0", "airspeed: age [s]": "0.11",
    "airspeed: dropped": "0", "armed: topic": "/armed", "armed: rate [Hz]": "1.0",
    "armed: age [s]": "0.51", "armed: dropped": "0",
}  # fmt: skip


def published(
    t_ns: int, structure: str, values: dict[str, float], sigma: float = 0.5
) -> Coefficients:
    """Return a controller's view of a message with some entries; the others are zero."""
    names = entry_names(STRUCTURES[structure])
    positions, efforts = [values.get(name, 0.0) for name in names], [sigma] * len(names)
    if len(values) == len(names):
        efforts[:2] = 0.0, math.inf
    return Coefficients.from_message(joint_state(t_ns, names, positions, efforts))


def received(
    structure: str = "augmented", *, usable: bool = True, scale: float = 1.0
) -> tuple[WatchedNode, list[float]]:
    """Return a watched node after two ticks and one status, and its clock, s."""
    now = [100.0]
    result = WatchedNode("/drone1/identifier", lambda: now[0])
    names = entry_names(STRUCTURES[structure])
    values = dict(zip(names, (scale * np.linspace(-60.0, 60.0, len(names))).tolist(), strict=True))
    values |= dict(zip(FIT_NAMES, (84.0, 20.0, 86.0), strict=True))
    values |= {name: float(usable) for name in names if name.startswith(USABLE_NAME)}
    for t_ns in (SECOND_NS, SECOND_NS + 50_000_000):
        result.take(published(t_ns, structure, values))
    result.diagnosed("learning: the 1-second fit of q is 20 %", STATUS)
    return result, now


def printed(width: int, encoding: str = "utf-8") -> Console:
    """Return a console of a width that records its output."""
    file = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    return Console(file=file, width=width, record=True, force_terminal=False)


def text(result: WatchedNode, width: int = 80, encoding: str = "utf-8") -> str:
    console = printed(width, encoding)
    console.print(picture(result, console))
    return "\n".join(line.rstrip() for line in console.export_text().splitlines())


@pytest.mark.parametrize("structure", STRUCTURES)
@pytest.mark.parametrize("scale", [1.0, 1e-9, 1e9, 1e300])
def test_the_view_fits_on_80_columns_and_24_lines(structure: str, scale: float) -> None:
    result, _ = received(structure, scale=scale)
    if "beta" in STRUCTURES[structure].regressors:  # force rows replace the view of further inputs
        left_out = ("airspeed", "armed", "rates: dropped")
        few = {k: v for k, v in STATUS.items() if not k.startswith(left_out)}
        result.diagnosed("converged", few | {"rates: dropped": "0", "structure": structure})
    shown = text(result).splitlines()
    assert len(shown) <= 24
    assert max(map(len, shown)) <= 80


@pytest.mark.parametrize("width", [20, 40, 60, 120, 200])
def test_other_widths_are_respected_with_all_regressors(width: int) -> None:
    result, _ = received()
    shown = text(result, width)
    assert max(map(len, shown.splitlines())) <= width
    assert text(received("flight_dynamics")[0], width, encoding="ascii").isascii()
    if width >= 40:
        for name in STRUCTURES["augmented"].regressors:
            assert re.search(rf"(^| ){name} ", shown, re.MULTILINE)


def test_labels_that_the_node_does_not_publish_are_shown_as_unknown() -> None:
    """A node of another version may lack some."""
    result, _ = received()
    for label in STATUS:
        result.diagnosed("learning", {k: v for k, v in STATUS.items() if k != label})
        assert text(result)
    result.diagnosed("learning", {k: v for k, v in STATUS.items() if k != "rates: age [s]"})
    assert "200.0 Hz  ?  dropped 3" in text(result)


def test_every_number_has_its_place_and_label() -> None:
    shown = text(received()[0])
    head = shown.splitlines()[0]
    assert head == "/drone1/identifier  learning  usable  tick 1.05 s"
    assert "the 1-second fit of q is 20 %" in shown
    assert "pq    -60.000 fixed" in shown
    assert "qr    -56.250   inf    0 →" in shown
    assert "p     -52.500 0.500  105 →" in shown
    assert "pdot ✓   excited 0.28" in shown
    assert "fit 84 %  hold -12 %" in shown
    assert "fit 86 %  hold 95 %" in shown
    assert "/mavros/imu/data_raw" in shown
    assert "200.0 Hz  age 0.01 s  dropped 3\n          dropped: late 2, not finite 1\n" in shown
    assert "0.0 Hz  no message yet  dropped 0" in shown
    assert "delay     23 ms  estimated, sure" in shown
    assert "ticks     651  update 0.300 ms (p99)" in shown
    assert "collinear: qdot/1, qdot/az; rdot/p, rdot/r" in shown


RUNNING = {
    "excite: state": "rudder", "excite: last run": "none yet", "excite: elapsed [s]": "4.1",
    "excite: remaining [s]": "25.9", "excite: until known [s]": "9",
    "excite: not known yet": "qdot/de, rdot/dr",
}  # fmt: skip


@pytest.mark.parametrize(
    ("status", "line"),
    [
        (RUNNING, "excite    rudder  4.1 s, at most 25.9 s left  known in 9 s: qdot/de, rdot/dr"),
        (RUNNING | {"excite: until known [s]": "unknown"},
         "excite    rudder  4.1 s, at most 25.9 s left  still unknown: qdot/de, rdot/dr"),
        ({"excite: last run": "aborted: p too large"}, "excite    aborted: p too large"),
        ({"excite: last run": "done after 20 s"}, "excite    done after 20 s"),
        ({"excite: last run": "none yet"}, ""),
    ],
)  # fmt: skip
def test_a_run_of_excitation_is_shown_during_and_after_it(
    status: dict[str, str], line: str
) -> None:
    result, _ = received()
    result.diagnosed("learning", STATUS | status)
    lines = [shown for shown in text(result, 100).splitlines() if shown.startswith("excite ")]
    assert lines == ([line] if line else [])
    if "aborted" in line:
        assert styles(result)["aborted: p too large"] == "yellow"


def styles(result: WatchedNode) -> dict[str, str]:
    console = printed(80)
    segments = console.render(picture(result, console))
    return {segment.text.strip(): str(segment.style) for segment in segments}


def test_good_and_bad_states_differ_in_colour() -> None:
    found = styles(received()[0])
    assert found["usable"] == "bold green"
    assert found["fit 84 %"] == "green"
    assert found["fit 86 %"] == "yellow"  # worse than holding the rate
    assert found["dropped 3"] == "yellow"
    result, _ = received(usable=False)
    result.diagnosed("fault: the frame is wrong", {})
    found = styles(result)
    assert found["fault"] == "bold red"
    assert found["not usable"] == "bold yellow"


def test_an_old_verdict_is_not_usable() -> None:
    result, now = received()
    assert result.usable
    now[0] += 2.0
    assert not result.usable
    assert "last tick 1.05 s, none since" in text(result)

    result, _ = received()
    result.diagnosed("waiting: no message on '/imu/data' for more than 2 s", STATUS)
    assert not result.usable

    latched = WatchedNode("/identifier")
    for _ in range(2):  # a repeated tick counts once
        latched.take(published(SECOND_NS, "baseline", {USABLE_NAME: 1.0}))
    latched.diagnosed("converged", {})
    assert not latched.usable


def test_the_view_shows_missing_messages_and_two_nodes_of_one_name() -> None:
    result = WatchedNode("/identifier")
    result.publishers = 2
    shown = text(result)
    assert "no tick yet" in shown
    assert "no status on /diagnostics yet" in shown
    assert shown.count("no fit yet") == 3
    assert "2 nodes publish under this name" in shown


def test_a_trend_is_more_than_a_standard_deviation() -> None:
    for past, sigma, trend in (
        ((1.0, 1.2, 1.6), 0.5, 1), ((1.0, 1.2, 1.4), 0.5, 0), ((1.0, 0.2), 0.5, -1),
        ((1.0, 9.0), 0.0, 0), ((1.0, 9.0), math.inf, 0),
    ):  # fmt: skip
        assert Coefficient("pdot/p", past[-1], sigma, past).trend == trend


def watched(*ticks: tuple[float, float]) -> WatchedNode:
    """Return a watched node whose `pdot/p` had these values at these times, s."""
    result = WatchedNode("/identifier")
    for t, value in ticks:
        result.take(published(round(t * 1e9), "baseline", {"pdot/p": value}, 0.01))
    return result


def test_a_trend_covers_ten_seconds_and_restarts_on_a_backward_time_jump() -> None:
    def damping(*ticks: tuple[float, float]) -> Coefficient:
        """Return the coefficient `pdot/p` of the view."""
        (found,) = [c for c in watched(*ticks).rows()["pdot"] if c.name == "pdot/p"]
        return found

    rising = [(1.0 + 0.05 * k, 0.05 * k) for k in range(1000)]
    coefficient = damping(*rising)
    assert coefficient.trend == 1
    assert coefficient.value - coefficient.past[0] == pytest.approx(TREND_TIME, abs=0.5)
    steady = [*rising, *((60.0 + 0.05 * k, rising[-1][1]) for k in range(300))]
    assert damping(*steady).trend == 0
    assert damping((50.0, 9.0), (51.0, 9.0), (1.0, 0.0)).past == (0.0,)


def test_past_values_are_drawn_if_width_and_encoding_permit() -> None:
    result = watched(*((1.0 + 0.5 * k, 0.1 * k) for k in range(20)))
    wide = text(result, 120)
    assert "▁" in wide and "█" in wide and "↗" in wide
    assert "█" not in text(result, 80)
    plain = text(result, 120, encoding="ascii")
    assert "p      +1.900 0.010  190 /" in plain
    plain.encode("ascii")


def test_modes_follow_from_the_published_coefficients() -> None:
    structure = STRUCTURES["flight_dynamics"]
    known = {
        "pdot/p": -9.0, "pdot/beta": -25.0, "qdot/q": -6.0, "qdot/alpha": -40.0, "rdot/r": -1.8,
        "rdot/beta": 12.0, "ay/beta": -12.0, "az/alpha": -100.0, "state/airspeed": 20.0,
    }  # fmt: skip
    result = watched()
    result.take(published(SECOND_NS, structure.name, known, 0.0))
    # the characteristic polynomial of q and alpha: s^2 + (6 + 5) s + 6 * 5 + 40
    assert "modes     short period 8.4 ζ.66, " in text(result)
    assert result.modes()[0].frequency == pytest.approx(math.sqrt(70.0), rel=1e-3)
    result.take(published(2 * SECOND_NS, structure.name, {}))
    assert "modes" not in text(result)


def test_states_and_the_rows_of_forces_and_kinematics_are_shown() -> None:
    result = WatchedNode("/identifier")
    values = {
        "ay/beta": -16.0, "betadot/1": 0.2, "state/alpha": 0.1, "state/airspeed": 19.5,
        "verdict/usable/pdot": 1.0,
    }  # fmt: skip
    for t_ns in (SECOND_NS, SECOND_NS + 50_000_000):
        result.take(published(t_ns, "flight_dynamics", values, 0.1))
    names = [c.name for row in result.rows().values() for c in row]
    assert names == list(STRUCTURES["flight_dynamics"].names)
    shown = text(result, 120)
    assert "state     alpha +5.7°, beta +0.0°, roll +0.0°, pitch +0.0°, airspeed 19.5 m/s" in shown
    assert re.search(r"^ay .*az .*kinematics$", shown, re.MULTILINE)
    assert re.search(r"beta  -16.000 0.100", shown)
    assert re.search(r"betadot/1  +\+0.200", shown)
    assert re.search(r"^pdot ✓ +qdot ✗ +rdot ✗$", shown, re.MULTILINE)
