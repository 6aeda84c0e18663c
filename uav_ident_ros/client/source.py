# SPDX-License-Identifier: Apache-2.0
"""Source of a controller's coefficients: the newest, the last good or the author's own."""

from collections import deque
from dataclasses import replace
from enum import Enum
from typing import Generic, TypeVar

import numpy as np

from uav_ident_ros.client.coefficients import Coefficients, NamedMessage
from uav_ident_ros.client.model import AttitudeModel, Refusal
from uav_ident_ros.identification.structure import BoolArray
from uav_ident_ros.messages.types import NS_PER_S

LENGTH = 256
"""Values kept: 12 s of coefficients at 20 Hz, the longest `excitation.lead` at 200 Hz."""

Entry = TypeVar("Entry")


class History(Generic[Entry]):
    """The newest values of a topic by their stamps."""

    def __init__(self) -> None:
        self._items: deque[tuple[int, Entry]] = deque(maxlen=LENGTH)

    def add(self, t_ns: int, value: Entry) -> None:
        """Add a value: it hides earlier ones with a later stamp, as after a restart."""
        self._items.append((t_ns, value))

    def __len__(self) -> int:
        return len(self._items)

    def at(self, t_ns: int) -> Entry | None:
        """Return the newest value stamped at or before `t_ns`; None if there is none."""
        for stamp, value in reversed(self._items):
            if stamp <= t_ns:
                return value
        return None


MAX_AGE = 0.5
"""Age from which coefficients are stale, s: ten missed ticks at 20 Hz."""


class Fallback(Enum):
    """Replacement for the newest coefficients while they are stale or not usable.

    See "After a fault" in docs/controllers.md.
    """

    REFUSE = "refuse"
    LAST_GOOD = "last good"
    NOMINAL = "nominal"


class CoefficientSource:
    """Receives coefficients and provides the model to use.

    Unknown coefficients (see `Coefficients.known`) are never used, whatever the verdict. Those of
    the fallback replace them one by one; a coefficient unknown there, too, is left out.

    Parameters
    ----------
    fallback : Fallback
        The caller's choice; there is no default on purpose.
    nominal : Coefficients, optional
        The author's own set: for `Fallback.NOMINAL`, and for `Fallback.LAST_GOOD` before the
        first usable set.
    use_verdict : bool
        Whether ``verdict/usable`` must be 1. After a fault it lags behind the coefficients.
    max_age : float
        Age from which coefficients are stale, s of message time.
    delay : float
        Least age of the coefficients used, s. In lock-step with a simulation it makes the choice
        independent of the machine's speed; 0 in flight.

    Raises
    ------
    ValueError
        If the fallback is `Fallback.NOMINAL` and there is no nominal set.

    See Also
    --------
    uav_ident_ros.client.subscribe : Adds the messages of a topic.
    uav_ident_ros.client.AttitudeModel : The model that it provides.

    Examples
    --------
    >>> from uav_ident_ros.identification.structure import STRUCTURES
    >>> source, structure = CoefficientSource(Fallback.REFUSE), STRUCTURES["baseline"]
    >>> values = np.where(structure.mask, 1.0, 0.0)
    >>> source.add(Coefficients(structure, values, 0.1 * values, t_ns=1_000_000_000))
    >>> source.model(1_100_000_000).source
    'identified'
    >>> source.refusal(3_000_000_000)
    'the coefficients are more than 0.5 s old'
    """

    def __init__(
        self,
        fallback: Fallback,
        nominal: Coefficients | None = None,
        *,
        use_verdict: bool = True,
        max_age: float = MAX_AGE,
        delay: float = 0.0,
    ) -> None:
        if fallback is Fallback.NOMINAL and nominal is None:
            raise ValueError("Fallback.NOMINAL needs the nominal coefficients")
        self.fallback = fallback
        self._use_verdict = use_verdict
        self._max_age = max_age
        self._delay_ns = round(delay * NS_PER_S)
        self._history: History[Coefficients] = History()
        # the model of the fallback, and the newest usable set with its model
        self._spare: AttitudeModel | None = None
        if nominal is not None and fallback is not Fallback.REFUSE:
            self._spare = _model(nominal, source="nominal")
        self._good: tuple[Coefficients, AttitudeModel] | None = None

    def take(self, message: NamedMessage) -> Coefficients:
        """Add a message of ``~/coefficients_named``.

        Raises
        ------
        MessageError
            If it holds no coefficients; the earlier ones stay.
        """
        coefficients = Coefficients.from_message(message)
        self.add(coefficients)
        return coefficients

    def add(self, coefficients: Coefficients) -> None:
        """Add decoded coefficients."""
        self._history.add(coefficients.t_ns, coefficients)

    def newest(self, now_ns: int) -> Coefficients | None:
        """Return the newest coefficients at message time `now_ns`; None before the first."""
        return self._history.at(now_ns - self._delay_ns)

    def refusal(self, now_ns: int, row: int | None = None) -> str:
        """Return the reason not to use the newest coefficients; empty if there is none.

        Parameters
        ----------
        now_ns : int
            Message time, ns.
        row : int, optional
            One of pdot, qdot, rdot, to be judged by its own verdict.
        """
        newest = self.newest(now_ns)
        if newest is None:
            if self._history and self._history.at(now_ns) is None:
                return "the coefficients are of a later time: pass that of the newest Imu message"
            return "there are no coefficients yet"
        if newest.age(now_ns - self._delay_ns) > self._max_age:
            return f"the coefficients are more than {self._max_age:g} s old"
        usable = newest.usable if row is None else newest.usable_rows[row]
        if self._use_verdict and not usable:
            return "the identifier's verdict is 'not usable'"
        return ""

    def model(self, now_ns: int) -> AttitudeModel:
        """Return the model to use at message time `now_ns`.

        Raises
        ------
        Refusal
            If the newest coefficients cannot be used and there is no fallback.
        """
        newest, reason = self.newest(now_ns), self.refusal(now_ns)
        if newest is None or reason:
            spare = self._spare
            if spare is None:
                raise Refusal(reason)
            if newest is None or newest.flow is None:
                return spare
            at = spare.flow or newest.flow  # where its coefficients hold
            return replace(spare, flow=newest.flow._replace(airspeed=at.airspeed))
        if self._good is None or self._good[0] is not newest:
            self._good = newest, _model(newest, self._spare)
            if self.fallback is Fallback.LAST_GOOD:
                self._spare = replace(self._good[1], source="last good", replaced=())
        return self._good[1]


def _model(
    coefficients: Coefficients, spare: AttitudeModel | None = None, source: str = "identified"
) -> AttitudeModel:
    """Return the model of a set, its unknown coefficients replaced by those of a `spare` one."""
    structure, values, known = coefficients.structure, coefficients.values, coefficients.known
    replaced = np.zeros_like(known)
    if spare is not None and spare.structure is structure:
        replaced = ~known & spare.known
        values, known = np.where(replaced, spare.values, values), known | replaced

    def names(which: BoolArray) -> tuple[str, ...]:
        pairs = zip(structure.names, which[structure.mask], strict=True)
        return tuple(name for name, chosen in pairs if chosen)

    return AttitudeModel(
        structure=structure,
        flow=coefficients.flow,
        values=np.where(known, values, 0.0),
        known=known,
        t_ns=coefficients.t_ns,
        source=source,
        replaced=names(replaced),
        left_out=names(~known),
    )
