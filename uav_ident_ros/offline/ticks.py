# SPDX-License-Identifier: Apache-2.0
"""The estimates of a flight: in memory, and as a bag."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import overload

import numpy as np

from uav_ident_ros.bags import writing
from uav_ident_ros.bags.reading import METADATA_FILE
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.structure import FloatArray, Structure
from uav_ident_ros.messages.published import coefficients_layout, dense_coefficients, named_entries
from uav_ident_ros.offline import NODE_NAME


class Ticks(Sequence[Estimate]):
    """Estimates of one structure, in order.

    Only the free coefficients are kept: an hour of whole matrices would take twice the memory.
    """

    def __init__(self, structure: Structure, estimates: Iterable[Estimate] = ()) -> None:
        self.structure = structure
        self._estimates: list[Estimate] = []
        for estimate in estimates:
            self.append(estimate)

    def append(self, estimate: Estimate) -> None:
        """Add the next estimate."""
        mask = self.structure.mask
        free, sigma = estimate.coefficients[mask], estimate.sigma[mask]
        self._estimates.append(replace(estimate, coefficients=free, sigma=sigma))

    def chosen(self, which: Iterable[int]) -> Ticks:
        """Return the estimates at some indices, without copying their arrays."""
        result = Ticks(self.structure)
        result._estimates = [self._estimates[k] for k in which]
        return result

    def __len__(self) -> int:
        return len(self._estimates)

    @overload
    def __getitem__(self, item: int) -> Estimate: ...
    @overload
    def __getitem__(self, item: slice) -> Ticks: ...
    def __getitem__(self, item: int | slice) -> Estimate | Ticks:
        if isinstance(item, slice):
            return self.chosen(range(len(self))[item])
        estimate, mask = self._estimates[item], self.structure.mask
        values, sigma = np.zeros(mask.shape), np.zeros(mask.shape)
        values[mask], sigma[mask] = estimate.coefficients, estimate.sigma
        return replace(estimate, coefficients=values, sigma=sigma)

    def history(self, index: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        """Return one coefficient and its standard deviation over the ticks, (K,) each."""
        k = self.structure.free.index(index)
        found = [(estimate.coefficients[k], estimate.sigma[k]) for estimate in self._estimates]
        values, sigma = np.array(found).reshape(-1, 2).T
        return values, sigma


# --- as a bag -------------------------------------------------------------------------------------


def write_estimates(
    path: Path,  # Folder of the bag
    estimates: Ticks,
    frame_id: str,  # Frame of the predicted rates: that of the Imu
) -> None:
    """Write a bag of estimates as of the node; as `check_place`, raises `BagWriteError`."""
    check_place(path)
    latched, reliable = writing.qos(1, transient_local=True), writing.qos(10)
    topics = {
        "coefficients_named": (writing.JOINT_STATE, latched),
        "coefficients": (writing.ARRAY, latched),
        "predicted_rates": (writing.VECTOR, reliable),
        "prediction_error": (writing.VECTOR, reliable),
    }
    structure = estimates.structure
    layout = coefficients_layout(structure)
    with writing.whole(path, replace=True) as working, writing.BagWriter(working) as bag:
        for topic, (msgtype, profile) in topics.items():
            bag.topic(f"{NODE_NAME}/{topic}", msgtype, profile)
        for e in estimates:
            rates, errors = e.predicted_rates.tolist(), e.prediction_error.tolist()
            messages = (
                writing.joint_state(e.t_ns, *named_entries(e, structure)),
                writing.array(dense_coefficients(e, structure), layout),
                writing.vector_stamped(e.t_ns, rates, frame_id),
                writing.vector_stamped(e.t_ns, errors, frame_id),
            )
            for topic, message in zip(topics, messages, strict=True):
                bag.write(f"{NODE_NAME}/{topic}", e.t_ns, message)


def check_place(path: Path) -> None:
    """Raise `BagWriteError` if a path exists and is no bag: nothing else may be replaced."""
    if path.is_dir():
        files = [file for file in path.iterdir() if file.name != METADATA_FILE]
        if all(file.suffix == ".mcap" and file.is_file() for file in files):
            return
    if path.exists():
        raise writing.BagWriteError(f"'{path}' exists and is no bag: it is left alone")
