# SPDX-License-Identifier: Apache-2.0
"""ArduPilot logs for the tests, in the documented format; pymavlink reads them, too."""

import itertools
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

FMT, HEADER = 0x80, b"\xa3\x95"

# Type, format characters, columns: as ArduPilot declares them.
FORMATS: dict[str, tuple[str, str]] = {
    "PARM": ("QNff", "TimeUS,Name,Value,Default"),
    "MSG": ("QZ", "TimeUS,Message"),
    "IMU": ("QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"),
    "GYR": ("QBQfff", "TimeUS,I,SampleUS,GyrX,GyrY,GyrZ"),
    "ACC": ("QBQfff", "TimeUS,I,SampleUS,AccX,AccY,AccZ"),
    "RCOU": ("QHHHHHHHHHHHHHH", "TimeUS," + ",".join(f"C{i}" for i in range(1, 15))),
    "RCO2": ("QHHHH", "TimeUS,C15,C16,C17,C18"),
    "RCO3": ("QHH", "TimeUS,C1,C2"),
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
    "ARM": ("IBH", "TimeMS,ArmState,ArmChecks"),
    "GPS": ("BIHfI", "Status,TimeMS,Week,Spd,T"),
}
"""Formats of 2014: milliseconds, no instances, no units."""

STRUCTURE = {"n": "4s", "N": "16s", "Z": "64s", "M": "B", "c": "h", "C": "H", "e": "i", "E": "I"}
"""`struct` codes of the format characters that differ; c, C, e, E are hundredths."""


def servos(*functions: int, **others: float) -> dict[str, float]:
    """Return the parameters of pins with these functions, and others."""
    values: dict[str, float] = {}
    for i, function in enumerate(functions, 1):
        values |= {f"SERVO{i}_FUNCTION": function, f"SERVO{i}_MIN": 1100, f"SERVO{i}_MAX": 1900}
        values |= {f"SERVO{i}_TRIM": 1500, f"SERVO{i}_REVERSED": 0}
    return values | others


Rows = list[tuple[int, str, tuple[Any, ...]]]
"""Time (in the format's unit), type and values of messages; missing last values are zero."""


def write_dataflash(
    path: Path,
    rows: Rows,  # Written in the order of their times
    parameters: Mapping[str, float],  # Written first
    # Format characters and columns of every type
    formats: Mapping[str, tuple[str, str]] = FORMATS,
) -> Path:
    """Write a log."""
    known = {"FMT": (FMT, "BBnNZ", "Type,Length,Name,Format,Columns")}
    known |= {name: (i, *declared) for i, (name, declared) in enumerate(formats.items(), 1)}

    def packed(name: str, *values: Any) -> bytes:
        number, kinds, _ = known[name]
        result = HEADER + bytes([number])
        for kind, value in itertools.zip_longest(kinds, values):
            if kind in "nNZ":
                value = value or b""
            else:
                value = float(value or 0) if kind in "fd" else int(value or 0)
            result += struct.pack(f"<{STRUCTURE.get(kind, kind)}", value)
        return result

    content = [
        packed(
            "FMT", number, len(packed(name)), *(text.encode() for text in (name, kinds, columns))
        )
        for name, (number, kinds, columns) in known.items()
    ]
    first: Rows = [(0, "PARM", (name.encode(), value)) for name, value in parameters.items()]
    for t, name, values in first + sorted(rows, key=lambda row: row[0]):
        stamp = (t,) if known[name][2].startswith("Time") else ()
        content.append(packed(name, *stamp, *values))
    path.write_bytes(b"".join(content))
    return path
