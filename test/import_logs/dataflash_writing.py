# SPDX-License-Identifier: Apache-2.0
"""ArduPilot logs for the tests, as its documentation describes them; pymavlink reads them, too."""

import struct
from collections.abc import Iterable, Mapping
from pathlib import Path

FMT, HEADER = 0x80, b"\xa3\x95"

# Type, format characters, columns: as ArduPilot declares them.
FORMATS: dict[str, tuple[str, str]] = {
    "PARM": ("QNff", "TimeUS,Name,Value,Default"),
    "MSG": ("QZ", "TimeUS,Message"),
    "IMU": ("QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"),
    "GYR": ("QBQfff", "TimeUS,I,SampleUS,GyrX,GyrY,GyrZ"),
    "ACC": ("QBQfff", "TimeUS,I,SampleUS,AccX,AccY,AccZ"),
    "RCOU": ("QHHHHHHHHHHHHHH", "TimeUS," + ",".join(f"C{i}" for i in range(1, 15))),
    "AETR": ("Qfffffff", "TimeUS,Ail,Elev,Thr,Rudd,Flap,Steer,SS"),
    "RATE": ("Qffffffffffff", "TimeUS,RDes,R,ROut,PDes,P,POut,YDes,Y,YOut,ADes,A,AOut"),
    "ARSP": ("QBffcffBBfB", "TimeUS,I,Airspeed,DiffPress,Temp,RawPress,Offset,U,H,Hp,Pri"),
    "CTUN": ("Qccccffffffi", "TimeUS,NavRoll,Roll,NavPitch,Pitch,ThO,RdO,ThD,As,SAs,E2T,GU"),
    "ARM": ("QBIBB", "TimeUS,ArmState,ArmChecks,Forced,Method"),
    "EV": ("QB", "TimeUS,Id"),
    "STAT": ("QB", "TimeUS,isFlying"),
    "GPS": ("Qf", "TimeUS,Spd"),
    "MODE": ("QMBB", "TimeUS,Mode,ModeNum,Rsn"),
    "ATT": ("QccccCC", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"),
    "DSF": ("QIHIIII", "TimeUS,Dp,Blk,Bytes,FMn,FMx,FAv"),
}

_PINS = ",".join(f"Chan{i}" for i in range(1, 9))
OLD_FORMATS: dict[str, tuple[str, str]] = {
    "PARM": ("Nf", "Name,Value"),
    "MSG": ("Z", "Message"),
    "IMU": ("Iffffff", "TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "IMU2": ("Iffffff", "TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "RCOU": ("Ihhhhhhhh", f"TimeMS,{_PINS}"),
    "RATE": ("Iffffffffffff", "TimeMS,RDes,R,ROut,PDes,P,POut,YDes,Y,YOut,ADes,A,AOut"),
}
"""As of 2014: milliseconds, no instances, no units."""

STRUCTURE = {"n": "4s", "N": "16s", "Z": "64s", "M": "B", "c": "h", "C": "H", "e": "i", "E": "I"}
"""How a format character is packed, where not as `struct` has it; c, C, e, E are hundredths."""


class DataflashWriter:
    """Collects messages and writes them as one file."""

    def __init__(
        self,
        # Type, format characters and columns of every message
        formats: Mapping[str, tuple[str, str]] = FORMATS,
    ) -> None:
        self._formats = {"FMT": (FMT, "BBnNZ")}
        self._content = bytearray()
        self.add("FMT", FMT, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
        for number, (name, (kinds, columns)) in enumerate(formats.items(), 1):
            self._formats[name] = number, kinds
            size = len(self._packed(name, ()))
            self.add("FMT", number, size, name.encode(), kinds.encode(), columns.encode())

    def _packed(self, name: str, values: tuple[float | bytes, ...]) -> bytes:
        number, kinds = self._formats[name]
        packed = HEADER + bytes([number])
        for i, kind in enumerate(kinds):
            empty = b"" if kind in "nNZ" else 0
            value = values[i] if i < len(values) else empty
            if isinstance(value, int | float) and kind not in "fd":
                value = int(value)
            packed += struct.pack(f"<{STRUCTURE.get(kind, kind)}", value)
        return packed

    def add(self, name: str, *values: float | bytes) -> None:
        """Add one message; what is left out at its end is zero."""
        self._content += self._packed(name, values)

    def add_parameters(self, parameters: Mapping[str, float]) -> None:
        """Add the parameters, as at the start of a log."""
        stamp = (0,) if self._formats["PARM"][1].startswith("Q") else ()
        for name, value in parameters.items():
            self.add("PARM", *stamp, name.encode(), float(value))

    def add_rows(self, rows: Iterable[tuple[int, str, tuple[float, ...]]]) -> None:
        """Add messages in the order of their times (us)."""
        for t_us, name, values in sorted(rows, key=lambda row: row[0]):
            self.add(name, t_us, *values)

    def write(self, path: Path) -> Path:
        """Write the file."""
        path.write_bytes(self._content)
        return path
