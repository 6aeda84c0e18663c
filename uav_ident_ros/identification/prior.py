# SPDX-License-Identifier: Apache-2.0
"""What is known before the flight: initial values, their uncertainty, and what is fixed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.estimate import CoefficientSet
from uav_ident_ros.identification.rigid_body import Inertia, product_coefficients
from uav_ident_ros.identification.settings import Settings, SettingsError
from uav_ident_ros.identification.structure import (
    PRODUCT_COLUMNS,
    STRUCTURES,
    BoolArray,
    FloatArray,
)

PRODUCT_SIGMA = 1.0
"""Prior standard deviation of the rate-product coefficients: the inertia ratios of a rigid
body lie within -1 ... 1."""

LARGEST_COEFFICIENT = 1e6
"""Magnitude beyond which a coefficient is nonsense in SI units."""


@dataclass(frozen=True)
class Start:
    """Where an estimator starts.

    Parameters
    ----------
    values : (3, n) array
        Initial coefficients, SI.
    sigma : (3, n) array
        Their standard deviations; inf where nothing is known, 0 where not free.
    free : (3, n) bool array
        Coefficients that move.
    """

    values: FloatArray
    sigma: FloatArray
    free: BoolArray

    @property
    def precision(self) -> FloatArray:
        """Prior information ``1 / sigma^2``, shape (3, n); 0 where nothing is known."""
        precision = np.zeros_like(self.sigma)
        known = self.free & np.isfinite(self.sigma)
        precision[known] = self.sigma[known] ** -2
        return precision


def start_from(settings: Settings, initial: CoefficientSet | None = None) -> Start:
    """Gather the prior knowledge.

    Parameters
    ----------
    settings : Settings
        Initial values, fixed coefficients, known inertias.
    initial : CoefficientSet, optional
        Coefficients from a file; they win over the values in the settings.

    Raises
    ------
    SettingsError
        If `initial` belongs to another structure, or the inertias are impossible.
    """
    structure = STRUCTURES[settings.structure]
    values = np.zeros((3, structure.size))
    sigma = np.full((3, structure.size), np.inf)
    free = structure.mask.copy()
    sigma[:, PRODUCT_COLUMNS] = PRODUCT_SIGMA
    if settings.initial_coefficients:
        given = np.array(settings.initial_coefficients).reshape(3, structure.size)
        values = np.where(structure.mask, given, 0.0)
    if initial is not None:
        if initial.structure != structure.name:
            raise SettingsError(
                "initial_coefficients_file",
                f"the initial coefficients are of structure '{initial.structure}', "
                f"'structure' is '{structure.name}'",
            )
        values = np.where(structure.mask, initial.values, 0.0)
        known = (initial.sigma > 0.0) & np.isfinite(initial.sigma)
        sigma = np.where(known, initial.sigma, sigma)
    if settings.model.inertia:
        try:
            inertia = Inertia(*settings.model.inertia)
        except ValueError as error:
            raise SettingsError("model.inertia", f"'model.inertia': {error}") from None
        values[:, PRODUCT_COLUMNS] = product_coefficients(inertia)
        free[:, PRODUCT_COLUMNS] = False
    for name in settings.fixed_coefficients:
        free[structure.index(name)] = False
    return Start(values, np.where(free, sigma, 0.0), free)
