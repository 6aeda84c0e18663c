# SPDX-License-Identifier: Apache-2.0
"""Aircraft files: their contents, and the errors of wrong files."""

import shutil
from pathlib import Path

import pytest

from uav_ident_ros.simulation.aircraft import Aircraft
from uav_ident_ros.simulation.airframe import MODELS, airframe, airframe_names
from uav_ident_ros.simulation.flight import SimulationError

TEXT = """\
description: mine
model: c172p
speed: 50.0
altitude: 1000.0
autopilot: {roll_gain: 0.1, pitch_gain: 0.2}
excitation: {de: 0.08, dth: 0.1}
"""


def test_every_airframe_file_loads_with_name_and_excitation() -> None:
    assert {"c172p", "pa28", "T37", "A4", "J3Cub", "OV10", "ultra_stick_25e"} <= set(
        airframe_names()
    )
    for name in airframe_names():
        found = airframe(name)
        assert found.name == name and found.description
        assert set(found.excitation) == {"de", "dr", "da", "dth"}


def test_an_airframe_can_be_the_path_of_a_user_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(TEXT)
    found = airframe(str(path))
    assert (found.name, found.model, found.speed) == ("mine", "c172p", 50.0)
    assert found.autopilot.pitch_gain == 0.2
    # a ROS parameter of type double refuses an integer
    path.write_text(TEXT.replace("speed: 50.0", "speed: 50"))
    assert all(type(airframe(str(path), speed).speed) is float for speed in (None, 45))


def test_another_speed_scales_gains_and_surface_excitation() -> None:
    usual, fast = airframe("c172p"), airframe("c172p", 2.0 * airframe("c172p").speed)
    assert fast.autopilot.roll_gain == pytest.approx(0.25 * usual.autopilot.roll_gain)
    assert fast.excitation["de"] == pytest.approx(0.25 * usual.excitation["de"])
    assert fast.excitation["dth"] == usual.excitation["dth"]
    with pytest.raises(SimulationError, match="speed is -1"):
        airframe("c172p", -1.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (TEXT.replace("speed", "sped"), "unknown entry 'sped': did you mean 'speed'"),
        (TEXT.replace("roll_gain", "rol_gain"), "autopilot has an unknown entry 'rol_gain': did"),
        (TEXT.replace("model: c172p\n", ""), "mine.yaml' has no model"),
        (TEXT.replace("50.0", "-3.0"), "speed is -3.0"),
        (TEXT.replace("50.0", "fast"), "speed is fast"),
        (TEXT.replace("model: c172p", "model: 737"), "model is the number 737: write it in quotes"),
        (TEXT.replace("{roll_gain: 0.1, pitch_gain: 0.2}", "3"), "autopilot must be a mapping"),
        (TEXT.replace("pitch_gain: 0.2", "pitch_gain: low"), "pitch_gain is 'low': a finite"),
        (TEXT.replace("{de: 0.08, dth: 0.1}", "0.1"), "excitation must be a mapping with de, dr"),
        (TEXT.replace("dth: 0.1", "flap: 0.1"), "excitation has an unknown entry 'flap'"),
        (TEXT + "speed: 60.0\n", "line 7: 'speed' is there twice: keep one of the two"),
        ("[1, 2]", "no entries like 'model: c172p'"),
        ("a: [", r"mine.yaml': line 1: "),
        (b"\xff\xfe", "it is not text in UTF-8"),
        (None, "there is no such file or folder"),
    ],
)
def test_a_wrong_file_is_named_with_the_correct_value(
    tmp_path: Path, text: str | bytes | None, words: str
) -> None:
    path = tmp_path / "mine.yaml"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(SimulationError, match=words) as raised:
        airframe(str(path))
    assert str(path) in str(raised.value)


def test_a_jsbsim_aircraft_writes_no_output_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "jet.yaml"
    path.write_text(TEXT.replace("c172p", "global5000").replace("50.0", "200.0"))
    monkeypatch.chdir(tmp_path)
    Aircraft(str(path), 100.0).step()
    assert list(tmp_path.iterdir()) == [path]


def test_a_model_may_be_a_folder_beside_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shipped = MODELS / "ultra_stick_25e"
    folder = Path(shutil.copytree(shipped, tmp_path / "models" / "mine"))
    heavy = (folder / f"{shipped.name}.xml").rename(folder / "mine.xml")
    text, mass = heavy.read_text(encoding="utf-8"), '<emptywt unit="KG">1.959'
    assert text.count(mass) == 1
    heavy.write_text(text.replace(mass, '<emptywt unit="KG">2.5'), encoding="utf-8")
    Path("mine.yaml").write_text(TEXT.replace("c172p", "models/mine").replace("50.0", "20.0"))
    assert Aircraft("mine.yaml", 100.0).fdm["inertia/mass-slugs"] * 14.5939 == pytest.approx(2.5)
    # a folder without a model of its name is no model
    Path("c172p").mkdir()
    Path("plain.yaml").write_text(TEXT)
    assert airframe("plain.yaml").model == "c172p"
    Path("wrong.yaml").write_text(TEXT.replace("c172p", "models/c172p"))
    with pytest.raises(SimulationError, match=r"no aircraft 'models/c172p', .* a folder beside"):
        Aircraft("wrong.yaml", 100.0)


def test_an_aircraft_that_jsbsim_cannot_fly_is_named(tmp_path: Path) -> None:
    path = tmp_path / "turboprop.yaml"
    path.write_text(TEXT.replace("c172p", "fokker50"))
    with pytest.raises(SimulationError, match=r"'fokker50': .*throttle"):
        Aircraft(str(path), 100.0)
