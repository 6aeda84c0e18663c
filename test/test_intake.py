# SPDX-License-Identifier: Apache-2.0
"""Messages taken in blocks, and a score in pieces: as one by one, and as the whole."""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from excerpts import ACTUATORS, IMU, SECOND_NS, Entry, excerpt, parameters, replayed_run

from uav_ident_ros.bags.messages import NOT_MEASURED
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.offline import run as offline

SECONDS = 16.0

Spoil = Callable[[int, str, Any], list[Any]]


def bad_values(k: int, topic: str, message: Any) -> list[Any]:
    if topic == IMU and k % 900 == 13:
        message.angular_velocity.x = (float("nan"), 200.0, float("inf"))[k % 3]
    if topic == IMU and k % 900 == 500:
        message.linear_acceleration.z = 1e6
    if topic == ACTUATORS and k % 50 == 7:
        message.position = message.position * np.nan
    return [message]


def bad_stamps(k: int, topic: str, message: Any) -> list[Any]:
    if topic == IMU and k % 1500 == 13:
        message.header.stamp.sec += (5000, -5000)[k % 2]
    if topic == IMU and k % 700 == 100:
        return [message, message]
    return [message]


def disorder(k: int, topic: str, message: Any) -> list[Any]:
    stamp = message.header.stamp
    if k % 40 == 5:  # logged on time, but stamped a little earlier than the one before
        late = stamp.sec * SECOND_NS + stamp.nanosec - 30_000_000
        stamp.sec, stamp.nanosec = divmod(late, SECOND_NS)
    return [message]


def new_base(k: int, topic: str, message: Any) -> list[Any]:
    if k > 3000:
        message.header.stamp.sec += 777
    return [message]


def frames(k: int, topic: str, message: Any) -> list[Any]:
    if topic == IMU and 2000 < k < 2500:
        message.header.frame_id = "other_imu"
    if topic == IMU and 3000 < k < 3300:
        message.header.frame_id = "imu_ned"
    return [message]


def not_measured(k: int, topic: str, message: Any) -> list[Any]:
    if topic == IMU and k % 2000 == 1000:
        message.angular_velocity_covariance = NOT_MEASURED
    if topic == IMU and k > 3000:
        message.linear_acceleration_covariance = NOT_MEASURED
    return [message]


SPOILERS: dict[str, tuple[Spoil, ...]] = {
    "values": (bad_values, frames, not_measured),
    "stamps": (disorder, new_base, bad_stamps),
}


@pytest.mark.parametrize("spoiler", SPOILERS)
def test_batches_of_any_size_give_the_same_of_whatever_is_wrong(
    spoiler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    count = itertools.count()

    def spoilt(topic: str, log_ns: int, message: Any) -> list[Entry]:
        k = next(count)
        for spoil in SPOILERS[spoiler]:
            (message, *more) = spoil(k, topic, message)
        return [(topic, log_ns, m) for m in (message, *more)]

    path = excerpt(tmp_path / "bag", SECONDS, change=spoilt)
    found = []
    for batch in (1, 100, 2048):
        monkeypatch.setattr(offline, "BATCH", batch)
        run = replayed_run(path, parameters())
        estimates = b"".join(
            b"".join(
                np.asarray(part).tobytes()
                for part in (e.t_ns, e.coefficients, e.sigma, e.predicted_rates, e.prediction_error)
            )
            for e in run.estimates
        )
        eras = range(run.intake.era + 1)
        records = [
            [part.tobytes() for part in record.of_era(era)]
            for record in (run.intake.rates, run.intake.actuators)
            for era in eras
        ]
        counts = [run.refusals(stream) for stream in ("rates", "actuators")]
        words = [(e.state, e.reason, e.usable) for e in run.estimates]
        found.append((estimates, records, counts, words, run.intake.frame_ids, run.fault))
    assert len(found[0][3]) > 100
    assert found[1] == found[0]
    assert found[2] == found[0]


def test_the_blocks_are_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Or the test above would compare nothing."""
    one_by_one = []
    original = OnlineIdentifier.add_rates
    monkeypatch.setattr(
        OnlineIdentifier,
        "add_rates",
        lambda self, *sample: one_by_one.append(1) or original(self, *sample),
    )
    run = replayed_run(excerpt(tmp_path / "bag", 10.0), parameters())
    assert run.refusals("rates").received == 10 * 200 + 1
    assert len(one_by_one) <= offline.BATCH  # the first batch: the time base is not known yet


@pytest.mark.parametrize("name", ["c172p", "multisine"])
def test_the_score_in_pieces_is_that_of_the_whole(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = replayed_run(excerpt(tmp_path / "bag", 9.0, name), parameters(name))
    index = run.structure.free[-1]
    assert run.estimates.history(index)[1].tolist() == [e.sigma[index] for e in run.estimates]
    whole = run.score()
    monkeypatch.setattr(offline, "PIECE", 61)
    for selection, fit in run.score().items():
        np.testing.assert_allclose(fit.free, whole[selection].free, rtol=1e-9)
        np.testing.assert_allclose(fit.measured_force, whole[selection].measured_force, rtol=1e-9)
        assert (fit.windows, fit.samples) == (whole[selection].windows, whole[selection].samples)
