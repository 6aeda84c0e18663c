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
    """Return the configured estimator.

    Parameters
    ----------
    settings : Settings
        Structure, ``estimator``, and the settings of that one.
    start : Start
        Initial coefficients with their standard deviations: `prior.start_from` collects them.

    Raises
    ------
    SettingsError
        If the gains of the paper's law are no symmetric, positive semi-definite matrix.

    See Also
    --------
    uav_ident_ros.identification.identifier.OnlineIdentifier : Conditions the samples, and judges.

    References
    ----------
    P. C. Young, Recursive Estimation and Time-Series Analysis, 2011: the instrumental variable with
    the model's own state.

    Examples
    --------
    >>> import numpy as np
    >>> from uav_ident_ros.identification.prior import start_from
    >>> from uav_ident_ros.identification.regression import Regression
    >>> from uav_ident_ros.identification.structure import STRUCTURES
    >>> settings = Settings.from_values({"structure": "baseline", "estimator": "least_squares"})
    >>> estimator = make_estimator(settings, start_from(settings))
    >>> f = np.random.default_rng(0).standard_normal((40, 12))  # 2 s of samples of 50 ms
    >>> truth = np.where(STRUCTURES["baseline"].mask, -2.0, 0.0)
    >>> samples = Regression.of(y=f @ truth.T, f=f, z=f, dt=0.05)
    >>> estimator.update(samples, *estimator.conditioned(samples), weight=np.ones(3))
    >>> bool(np.abs(estimator.coefficients - truth).max() < 0.05)  # The prior still counts
    True
    """
    if settings.estimator == "gradient":
        return GradientEstimator(settings, start)
    instrumental = settings.estimator == "instrumental_variable"
    return RecursiveRegression(start, settings, instrumental=instrumental)
