# SPDX-License-Identifier: Apache-2.0
"""Import common to all autopilots: choice of the messages, and findings about the log.

The table of each autopilot (`px4.yaml`, `ardupilot.yaml`) names the messages and fields of rates,
forces, estimates and flight state. Its module derives an `Import`, which maps commands to inputs.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
import yaml

from uav_ident_ros.identification.frames import quaternions
from uav_ident_ros.identification.samples import NS
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.flight_log import (
    Channel,
    Choice,
    FlightLog,
    effect_of,
)
from uav_ident_ros.import_logs.log import Findings, Log, LogStream, Messages
from uav_ident_ros.import_logs.stamps import (
    Stretches,
    coverage,
    hold,
    inside,
    interpolate,
    intervals,
)

ENOUGH_RATE = 20.0
"""Lowest sample rate of the rates and of the commands that suffices for identification, Hz. PX4
commands the motors at several hundred Hz and logs them at 10 Hz by default, which is too slow."""

ENOUGH_COVERAGE = 0.9
"""Lowest coverage of the flight, relative to the best, of messages that are taken: some topics are
logged for a part of the flight alone."""

AS_FAST = 0.9
"""Share of the highest rate that counts as that rate: messages of one loop differ by a sample."""

Actuators = tuple[LogStream, list[Channel]]
"""Raw values of the commands, and the channel of each column."""

Usable = dict[str, Messages]
"""Messages by kind, the preferred first."""


@cache
def table(name: str) -> dict[Any, Any]:
    """Return the table of this name, a YAML file of this folder."""
    file = resources.files(__package__).joinpath(f"{name}.yaml")
    return dict(yaml.safe_load(file.read_text(encoding="utf-8")))


def kinds(known: Mapping[str, Any]) -> set[str]:
    """Return the kinds of messages in an autopilot's table."""
    named = [known["rates"], known["force"], known["controls"]]
    return {kind for part in (*named, *known["streams"].values(), *known["flight"].values())
            for kind in part}  # fmt: skip


@dataclass
class Import:
    """Import of one log."""

    log: Log
    table: Mapping[Any, Any]  # Meaning of this autopilot's messages and parameters
    choice: Choice  # Messages chosen by the user
    flown: Stretches | None = None  # Stretches in the air, or armed; None if not logged
    advised: int = 0  # Bits of the logging parameter that the findings advise to set

    @property
    def findings(self) -> Findings:
        """Findings about the log."""
        return self.log.findings

    # --- specific to each autopilot ---------------------------------------------------------------

    def readers(self) -> Mapping[str, Callable[[Messages], Actuators]]:
        """Return a reader for each kind of commands, nearest to the actuators first."""
        raise NotImplementedError

    def hovers(self, commands: LogStream) -> bool:
        """Return whether the commands are those of a multirotor, or of a VTOL's hover."""
        raise NotImplementedError

    def messages(self, name: str, instance: int) -> Messages | None:
        """Return the rates or commands of a kind and instance, if there are any."""
        return self.log.messages(name, instance)

    def explained(self, usable: Usable) -> Usable:
        """Return the commands whose effects the log gives; all if it gives none."""
        return usable

    def turn(self, kind: str, messages: Messages, measured: FloatArray) -> None:
        """Turn rates and specific force (k, 6) of a kind of messages into body axes."""

    # --- which messages ---------------------------------------------------------------------------

    def refuse_others(self, found: Mapping[str, Any]) -> None:
        """Raise `ImportLogError` if `found`, values by key of the table, is of another vehicle."""
        for source, vehicles in self.table["not_aircraft"].items():
            if (vehicle := vehicles.get(value := found.get(source))) is not None:
                raise self.log.refusal(
                    f" is of {vehicle} ({source} {value}): the model is that of an aircraft's "
                    "attitude"
                )

    def _find(self, what: str, fields: Mapping[str, Collection[str]]) -> Usable:
        """Return the rates or actuators that the user chose, or those of all suitable kinds.

        `fields` has the supported kinds, the preferred first, and the fields that each needs.
        """
        wanted: str | None = getattr(self.choice, f"{what}_topic")
        instance: int = getattr(self.choice, f"{what}_instance")
        if wanted is not None and wanted not in fields:
            raise self.log.refusal(
                f": '{wanted}' are no messages of {what}: there are {', '.join(fields)}"
            )
        looked_for = [wanted] if wanted else list(fields)
        there = {name: self.messages(name, instance) for name in looked_for}
        found = {name: m for name, m in there.items() if m and m.has(*fields[name])}
        if not found:
            which = f", instance {instance}" if instance else ""
            there_are = ", ".join(sorted(self.log.kinds)) or "no messages at all"
            cure = self._to_log_faster(looked_for[0]) if what == "rates" else ""
            raise self.log.refusal(
                f" has no {what} ({', '.join(looked_for)}{which}); it has {there_are}{cure}"
            )
        return found

    def _choose(self, usable: Usable) -> str:
        """Return the kind to take: the first that is fast enough and covers the flight.

        If none is fast enough, the first that is as fast as any that covers it. The findings list
        the kinds, and the reason to reject each that is nearer to the sensor or the actuators.
        """
        names = list(usable)
        stamps = {name: messages.stamp_ns for name, messages in usable.items()}
        rates = {name: messages.rate for name, messages in usable.items()}
        every = np.concatenate([*stamps.values()])
        flown = self.flown or [(int(every.min()), int(every.max()))]
        shares = {name: coverage(t_ns, flown) for name, t_ns in stamps.items()}
        fast = [name for name in names if rates[name] >= ENOUGH_RATE]
        enough = ENOUGH_COVERAGE * max(shares[name] for name in fast or names)
        whole = [name for name in fast or names if shares[name] >= enough]
        enough_rate = ENOUGH_RATE if fast else AS_FAST * max(rates[name] for name in whole)
        chosen = next(name for name in whole if rates[name] >= enough_rate)
        if len(names) > 1:
            listed = [f"{n} at {rates[n]:.4g} Hz over {100.0 * shares[n]:.0f} %" for n in names]
            self.findings.read.append(
                f"{chosen} is taken; of the flight there is {', '.join(listed)}"
            )
        before_mixer = self.table["before_mixer"]
        for name in names[: names.index(chosen)]:
            reason = f"covers {100.0 * shares[name]:.0f} % of the flight only"
            if rates[name] < ENOUGH_RATE and shares[name] >= enough:
                reason = f"is logged at {rates[name]:.3g} Hz only{self._to_log_faster(name)}"
            loss = ", before the mixer, and does not show saturation"
            tail = loss if chosen in before_mixer and name not in before_mixer else ""
            self.findings.lost.append(
                f"{name} {reason}; {chosen} is at {rates[chosen]:.3g} Hz{tail}"
            )
        self._note(chosen, usable[chosen].name)
        if rates[chosen] < ENOUGH_RATE:
            self.findings.lost.append(
                f"{chosen} has {rates[chosen]:.3g} Hz only: {ENOUGH_RATE:g} Hz are needed"
                f"{self._to_log_faster(chosen)}"
            )
        return chosen

    def _to_log_faster(self, name: str) -> str:
        """Return the logging option for the full rate of a kind of messages, in parentheses."""
        parameter = self.table["logging"]["parameter"]
        option = next((o for o in self.table["logging"]["options"] if name in o["messages"]), None)
        if option is None:
            return f" ({parameter})"
        instead = option.get("in place of", {}).get(name)
        tail = f", which logs {instead} in its place" if instead else ""
        if parameter not in self.log.parameters:
            return f" ({parameter}: switch on bit {option['bit']}, '{option['name']}'){tail}"
        value = int(self.log.parameters[parameter])
        if value >> option["bit"] & 1:
            return f" ({parameter} {value}, although it has '{option['name']}'){tail}"
        self.advised |= 1 << option["bit"]  # with those advised before
        return f" ({parameter} {value}: make it {value | self.advised}, '{option['name']}'){tail}"

    def _note(self, what: str, name: str) -> None:
        """Add the table's notes on chosen messages, or on those of a stream, to the findings."""
        for kind, text in self.table["notes"].get(what, {}).items():
            getattr(self.findings, kind).append(text.format(name=name))
        if filtered := self.table["low_pass"].get(what):
            cutoffs = {name: self.log.parameter(name) for name in filtered["parameters"]}
            known = next((f" at {hz:g} Hz ({name})" for name, hz in cutoffs.items() if hz), "")
            self.findings.lost.append(
                f"{what} is low-passed{known} by the autopilot: it comes late, which counts as a "
                f"further delay of the inputs{filtered['more']}"
            )

    # --- flight, rates, commands ------------------------------------------------------------------

    def _take_flight(self) -> None:
        """Find the stretches in the air; if the log lacks them, those with armed motors."""
        for state, sources in self.table["flight"].items():
            found = self._stretches(sources)
            if found is None or (self.flown is not None and found[1]):
                continue
            source, self.flown = found
            if self.flown:
                seconds = sum(end - start for start, end in self.flown) * NS
                self.findings.read.append(
                    f"{state} for {seconds:.1f} s in {len(self.flown)} stretch(es) ({source})"
                )
            else:
                self.findings.lost.append(
                    f"the vehicle was never {state} ({source}): this log gives no model; if it did "
                    "fly, empty 'armed.type'"
                )
        if self.flown is None:
            self.findings.assumed.append(self.table["always_flies"])

    def _stretches(self, sources: Mapping[str, Any]) -> tuple[str, Stretches] | None:
        """Return source and stretches of a state; None if the log lacks it."""
        for name, entry in sources.items():
            messages = self.log.messages(name)
            if messages is None or not messages.has(entry["field"]):
                continue
            values, source = messages.columns[entry["field"]], f"{name}.{entry['field']}"
            t_ns, active = messages.stamp_ns, np.isin(values, entry["begin"])
            if "end" in entry:
                known, source = active | np.isin(values, entry["end"]), name
                # Before the first change the state was the opposite.
                t_ns, active = np.append(0, t_ns[known]), active[known]
                active = np.append(~active[:1], active)
            if len(active):
                t_ns[0] = self.log.start_ns
                return source, intervals(t_ns, active, self.log.end_ns)
        return None

    def _rates(self) -> LogStream:
        """Read the rates that the user chose, or the first that are fast enough, or the fastest."""
        fields = self.table["rates"]
        usable = self._find("rates", fields)
        name = self._choose(usable)
        messages = usable[name]
        measured = np.hstack([messages.values(*fields[name]), self._force(name, messages)])
        if turned := self.table["orientation"]["turned"].get(name):
            self.note_orientation(turned)
        self.turn(name, messages, measured)
        sensor = self.table["gyros"].get(name, name)
        if len(instances := self.log.instances(sensor)) > 1:
            self.findings.read.append(f"instances {instances} of {sensor} (--rates-instance)")
        return LogStream(messages.name, messages.sample_ns, measured)

    def _actuators(self) -> Actuators:
        """Read the commands that the user chose, or the best of those with known effects."""
        readers = self.readers()
        demands = {name: self.table["controls"].get(name, {}).items() for name in readers}
        acting = {name: [f for f, entry in fields if any(effect_of(entry))]
                  for name, fields in demands.items()}  # fmt: skip
        usable = self._find("actuators", acting)
        name = self._choose(self.explained(usable))
        commands, channels = readers[name](usable[name])
        self.findings.read.append(f"actuators: {commands.source}{self.table['stamped']}")
        if usable[name].has("timestamp_sample"):
            delays = usable[name].stamp_ns - usable[name].sample_ns
            self.findings.read.append(
                "commands count from their publication (timestamp), in the median "
                f"{np.median(delays) * 1e-6:.2f} ms after the gyro sample they answer "
                "(timestamp_sample)"
            )
        if not any(any(channel.effect) for channel in channels):
            raise self.log.refusal(f": {self.table['unexplained'].format(source=commands.source)}")
        return commands, channels

    def demands(self, messages: Messages) -> Actuators:
        """Read the commands before the mixer; the table has the channel of each field."""
        known = self.table["controls"][messages.name.partition("[")[0]]
        there = [field for field in known if messages.has(field)]
        channels = []
        for field in there:
            name, effect = known[field]["name"], effect_of(known[field])
            scale = 1.0 / known[field].get("unit", 1.0)
            channels.append(Channel(name, effect, f"{messages.name}.{field}", scale))
        return messages.stream(*there), channels

    def note_orientation(self, consequence: str) -> list[float] | None:
        """Return roll, pitch, yaw of the board, deg, None if unknown; add them to the findings.

        `consequence` gives their use on the rates.
        """
        parameter = self.table["orientation"]["parameter"]
        number = int(self.log.parameter(parameter))
        angles: list[float] | None = table("rotations").get(number)
        fine = [self.log.parameter(name) for name in self.table["orientation"]["fine"]]
        turns = f"rotation {number}"
        if angles is not None:
            named = zip(("roll", "pitch", "yaw"), angles, strict=True)
            turns = " ".join(f"{axis} {angle:g} deg" for axis, angle in named if angle) or "none"
        if any(fine):
            turns += ", fine offsets {:.2f} {:.2f} {:.2f} deg".format(*fine)
        if parameter in self.log.parameters:
            self.findings.read.append(
                f"board orientation: {parameter} {number}, {turns}; {consequence}"
            )
        else:
            self.findings.assumed.append(
                f"the log has no {parameter}: rotation none ({consequence})"
            )
        return angles

    def _force(self, kind: str, rates: Messages) -> FloatArray:
        """Return the specific force of the rates' messages or of other fast ones, else NaN."""
        forces = self.table["force"]
        if kind in forces and rates.has(*forces[kind]):
            return rates.values(*forces[kind])
        for name, fields in forces.items():
            there = self.choice.rates_instance in self.log.instances(name)
            messages = self.log.messages(name, self.choice.rates_instance if there else 0)
            if messages and messages.has(*fields) and messages.rate >= ENOUGH_RATE:
                self.findings.read.append(
                    f"specific force: {messages.name}, interpolated to the stamps of the rates"
                )
                return interpolate(rates.sample_ns, messages.sample_ns, messages.values(*fields))
        self.findings.lost.append("there is no accelerometer at a useful rate: ay and az are zero")
        return np.full((len(rates.stamp_ns), 3), np.nan)

    # --- the rest ---------------------------------------------------------------------------------

    def flight_log(self) -> FlightLog:
        """Return the log, with all that the table lists."""
        self._take_flight()
        streams = {"rates": self._rates()}
        commands, channels = self._actuators()
        streams |= {"actuators": commands} | self._estimates()
        self.findings.read.append(
            "stamps are the autopilot's time since its start, not the time of day"
        )
        known = self.table["parameters"]
        imported = tuple(known["imported"])
        self.findings.lost += [
            f"{name} became {value:g} at {t:.1f} s: the first value is used"
            for t, name, value in self.log.changes
            if name.startswith(imported)
        ]
        return FlightLog(
            self.log,
            streams,
            tuple(channels),
            convention=self.table["convention"],
            lever_arm=self._lever_arm(),
            flown=self.flown,
            hovers=self.hovers(commands),
            ground_speed=self._ground_speed(),
            parameters={
                name: value
                for name, value in sorted(self.log.parameters.items())
                if name.startswith((*imported, *known["explaining"]))
            },
        )

    def _first(self, name: str) -> LogStream | None:
        """Return a stream, (k, C), from the first of its kinds of messages with finite values."""
        for kind, fields in self.table["streams"][name].items():
            messages = self.log.messages(kind)
            if messages and messages.has(*fields):
                values = messages.values(*fields)
                if np.isfinite(values).any():
                    self._note(name, messages.name)
                    return LogStream(kind, messages.sample_ns, values)
        return None

    def _estimates(self) -> dict[str, LogStream]:
        """Return the autopilot's airspeed, attitude, rate setpoint and mode, where logged."""
        streams = {}
        if airspeed := self._first("airspeed"):
            speed = (airspeed.values * self._airspeed_ratio(airspeed))[:, 0]
            streams["airspeed"] = replace(airspeed, values=speed)
        if attitude := self._first("attitude"):
            values = attitude.values
            if values.shape[1] == 3:  # roll, pitch, yaw, deg
                values = quaternions(*np.radians(values).T)
            streams["attitude"] = replace(attitude, values=values)
        if setpoint := self._first("setpoint"):
            rates = self.table["setpoint_unit"] * setpoint.values
            streams["setpoint"] = replace(setpoint, values=rates)
        if mode := self._first("mode"):
            ((field,),) = self.table["streams"]["mode"].values()
            numbers = mode.values[:, 0].astype(int)
            changed = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 1))
            names = self.table["modes"]
            modes = np.array([names.get(int(n), f"{field} {n}") for n in numbers[changed]])
            self.findings.read.append(
                f"mode: {mode.source}.{field}: {', '.join(dict.fromkeys(modes))}"
            )
            streams["mode"] = LogStream(mode.source, mode.t_ns[changed], modes)
        return streams

    def _airspeed_ratio(self, airspeed: LogStream) -> FloatArray:
        """Return the ratio of true to indicated airspeed (k, 1); 1 where it is not logged."""
        if not self.table["streams"]["airspeed_ratio"]:
            return np.ones((1, 1))
        if (ratios := self._first("airspeed_ratio")) is None:
            self.findings.assumed.append(
                f"{airspeed.source} is indicated airspeed; without a ratio it is taken as true"
            )
            return np.ones((1, 1))
        ratio = hold(airspeed.t_ns, ratios.t_ns, ratios.values)
        return np.where(np.isfinite(ratio), ratio, 1.0)

    def _lever_arm(self) -> tuple[float, float, float]:
        prefix = self.table["parameters"]["lever_arm"].format(self.choice.rates_instance + 1)
        x, y, z = (self.log.parameter(f"{prefix}{axis}") for axis in "XYZ")
        if any((x, y, z)):
            self.findings.read.append(f"accelerometer at {x:g} {y:g} {z:g} m ({prefix}X, Y, Z)")
        else:
            origin = f" ({prefix}* 0)" if prefix else ""
            self.findings.assumed.append(f"the accelerometer is at the centre of gravity{origin}")
        return x, y, z

    def _ground_speed(self) -> float:
        """Return the median ground speed in flight, m/s; 0 if unknown."""
        if (ground := self._first("ground_speed")) is None:
            return 0.0
        if self.flown:
            ground = ground.chosen(inside(ground.t_ns, self.flown))
        speed = ground.values[np.isfinite(ground.values)]
        return float(np.median(speed)) if len(speed) else 0.0
