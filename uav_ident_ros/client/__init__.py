# SPDX-License-Identifier: Apache-2.0
"""Client for controllers: the identified model, from the coefficients that `identifier` publishes.

The client has no estimator, and only the functions that take a node need ROS. In a node::

    from uav_ident_ros.client import CoefficientSource, Fallback, subscribe

    source = CoefficientSource(Fallback.LAST_GOOD, nominal=my_aircraft)
    subscribe(self, source)                     # identifier/coefficients_named

    model = source.model(now_ns)                # refused: Refusal, with the reason
    answer = model.invert(wanted, rates, limits)    # inputs that give wanted pdot, qdot, rdot
"""

from uav_ident_ros.client.coefficients import Coefficients, MessageError
from uav_ident_ros.client.excitation import Excitation
from uav_ident_ros.client.model import AttitudeModel, Inversion, Refusal
from uav_ident_ros.client.source import CoefficientSource, Fallback, History
from uav_ident_ros.client.subscription import answer_rates, subscribe, subscribe_excitation

__all__ = [
    "AttitudeModel",
    "CoefficientSource",
    "Coefficients",
    "Excitation",
    "Fallback",
    "History",
    "Inversion",
    "MessageError",
    "Refusal",
    "answer_rates",
    "subscribe",
    "subscribe_excitation",
]
