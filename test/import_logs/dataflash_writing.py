# SPDX-License-Identifier: Apache-2.0
"""ArduPilot logs for the tests, encoded by pymavlink: its formats, its own message writer."""

import struct
from collections.abc import Iterable, Mapping
from pathlib import Path

import pytest

# Type, format characters, columns: as ArduPilot declares them.
FORMATS: dict[str, tuple[str, str]] = {
    "PARM": ("QNff", "TimeUS,Name,Value,Default"),
    "MSG": ("QZ", "TimeUS,Message"),
    "UNIT": ("QbZ", "TimeUS,Id,Label"),
    "MULT": ("Qbd", "TimeUS,Id,Mult"),
    "FMTU": ("QBNN", "TimeUS,FmtType,UnitIds,MultIds"),
    "IMU": ("QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"),
    "GYR": ("QBQfff", "TimeUS,I,SampleUS,GyrX,GyrY,GyrZ"),
    "ACC": ("QBQfff", "TimeUS,I,SampleUS,AccX,AccY,AccZ"),
    "RCOU": ("QHHHHHHHHHHHHHH", "TimeUS," + ",".join(f"C{i}" for i in range(1, 15))),
    "AETR": ("Qfffffff", "TimeUS,Ail,Elev,Thr,Rudd,Flap,Steer,SS"),
    "RATE": ("Qffffffffffff", "TimeUS,RDes,R,ROut,PDes,P,POut,YDes,Y,YOut,ADes,A,AOut"),
    "ARSP": ("QBffcffBBfB", "TimeUS,I,Airspeed,DiffPress,Temp,RawPress,Offset,U,H,Hp,Pri"),
    "CTUN": ("Qccccffffffi", "TimeUS,NavRoll,Roll,NavPitch,Pitch,ThO,RdO,ThD,As,SAs,E2T,GU"),
    "ARM": ("QBIBB", "TimeUS,ArmState,ArmChecks,Forced,Method"),
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

INSTANCES = {"IMU": "s#EEEooo--O--zz", "GYR": "s#sEEE", "ACC": "s#sooo"}
"""Units of the messages with a field of their instance."""

Row = tuple[str, tuple[float, ...]]


class DataflashWriter:
    """Collects messages and writes them as one file."""

    def __init__(
        self,
        # Where a file with nothing but its own format is put first: the library's writer is part of
        # its reader, which needs one
        folder: Path,
        # Type, format characters and columns of every message
        formats: Mapping[str, tuple[str, str]] = FORMATS,
    ) -> None:
        reader_module = pytest.importorskip("pymavlink.DFReader", reason="pymavlink is missing")
        self._format_class = reader_module.DFFormat
        seed = folder / "seed.bin"
        header = struct.pack(
            "<BBBBB4s16s64s", 0xA3, 0x95, 0x80, 0x80, 89, b"FMT", b"BBnNZ",
            b"Type,Length,Name,Format,Columns",
        )  # fmt: skip
        seed.write_bytes(header * 2)
        self._writer = reader_module.DFReader_binary(str(seed))
        self._formats = {}
        self._chunks = [self._writer.make_format_msgbuf(self._writer.formats[0x80])]
        for name, (characters, columns) in formats.items():
            size = 3 + struct.calcsize(self._structure(characters))
            declared = self._writer.add_format(
                self._format_class(0, name, size, characters, columns)
            )
            self._formats[name] = declared
            self._chunks.append(self._writer.make_format_msgbuf(declared))
        for name, units in INSTANCES.items() if "FMTU" in formats else ():
            self.add("FMTU", 0, self._formats[name].type, units.encode(), b"F".ljust(16, b"-"))

    def _structure(self, characters: str) -> str:
        return str(self._format_class(0, "X", 0, characters, "").msg_struct)

    def add(self, name: str, *values: float | bytes) -> None:
        """Add one message; what is left out at its end is zero."""
        declared = self._formats[name]
        missing = len(declared.columns) - len(values)
        self._chunks.append(self._writer.make_msgbuf(declared, [*values, *[0] * missing]))

    def add_parameters(self, parameters: Mapping[str, float]) -> None:
        """Add the parameters, as at the start of a log."""
        for name, value in parameters.items():
            if "TimeUS" in self._formats["PARM"].columns:
                self.add("PARM", 0, name.encode(), float(value), float("nan"))
            else:
                self.add("PARM", name.encode(), float(value))

    def add_rows(self, rows: Iterable[tuple[int, str, tuple[float, ...]]]) -> None:
        """Add messages in the order of their times (us)."""
        for t_us, name, values in sorted(rows, key=lambda row: row[0]):
            self.add(name, t_us, *values)

    def write(self, path: Path) -> Path:
        """Write the file."""
        self._writer.close()
        path.write_bytes(b"".join(self._chunks))
        return path
