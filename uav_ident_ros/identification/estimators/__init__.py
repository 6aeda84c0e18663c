# SPDX-License-Identifier: Apache-2.0
"""Estimators of the coefficients: the paper's law, least squares, the instrumental variable.

All three are the law ``Am_dot = e f^T K``. The paper's K is a setting, that of the others is
computed.
"""

from uav_ident_ros.identification.estimators.estimator import Estimator
from uav_ident_ros.identification.estimators.gradient import GradientEstimator
from uav_ident_ros.identification.estimators.recursive import RecursiveRegression
from uav_ident_ros.identification.prior import Start
from uav_ident_ros.identification.settings import Settings

__all__ = ("Estimator", "make_estimator")


def make_estimator(settings: Settings, start: Start) -> Estimator:
    """Return the configured estimator."""
    if settings.estimator == "gradient":
        return GradientEstimator(settings, start)
    instrumental = settings.estimator == "instrumental_variable"
    return RecursiveRegression(start, settings, instrumental=instrumental)
