# SPDX-License-Identifier: Apache-2.0
"""Parameter files, compared with rclpy, and coefficients files: a one-line error for each fault."""

import json
import math
import os
from datetime import UTC
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from programs import python

from uav_ident_ros.files import coefficients_file
from uav_ident_ros.files.coefficients_file import (
    CoefficientsFileError,
    Notes,
    load_coefficients,
    load_with_notes,
    save_coefficients,
)
from uav_ident_ros.files.parameter_file import ParameterFile, ParameterFileError, load_parameters
from uav_ident_ros.identification.estimate import CoefficientSet
from uav_ident_ros.identification.settings import MAX_DELAY, Settings, declarations
from uav_ident_ros.identification.structure import STRUCTURES

TRICKY = """\
# every kind of scalar that YAML readers disagree about
/**:
  ros__parameters:
    small: 1e-3
    whole: 20
    point: 20.
    bare_point: .5
    signed: [+5, -0, 007]
    octal: 010
    not_octal: 09
    hexadecimal: [0x1F, -0x10]
    hexadecimal_float: 0x1p3
    binary: 0b11
    underscore: 1_000
    sexagesimal: 1:30
    date: 2017-01-01
    huge_integer: 99999999999999999999
    huge: 1e999
    tiny: 1e-320
    smallest: -0x8000000000000000
    zero: [0.0, 0e5, -0.0]
    exponents: [1E5, 1e+3, 2.5e-7]
    not_numbers: [nan, .NaN, .nan, NAN]
    infinities: [-inf, .inf, +.Inf, -.INF, infinity]
    words: [TrUe, null_, "yes", '1.5', tRUE]
    yes: no
    bools: [y, Yes, on, TRUE, n, No, off, False]
    nothing: null
    tilde: ~
    quoted: '5'
    empty_word: ''
    tagged: !!str 5
    block: |
      5
    folded: >-
      12
    empty: []
    filter.cutoff: 12.0
    actuators:
      delay: 0.02
      mixing: {de: [1.0, 0.0], dr: [0.0, 1.0]}
      mixing.da: [0.0, 0.0]
      channels: [elevator, rudder]
    twice: 1
    twice: 2
    actuators.delay: 0.03
identifier:
  ros__parameters:
    whole: 21
    only_bare: 1
/*/identifier:
  ros__parameters: {one_level: 1}
/**/identifier:
  ros__parameters: {point: 22.0, any_level: true}
/drone1:
  identifier:
    ros__parameters: {nested_namespace: 1.5}
/drone1/identifier:
  ros__parameters: {qualified: 2.5}
/*:
  ros__parameters: {top_level: a}
/**:
  ros__parameters: {only_bare: 3}
someone_else:
  ros__parameters: {whole: 99}
"""

NODES = """
import json, sys, rclpy
from rclpy.node import Node
found = []
for path, namespace in json.load(sys.stdin):
    try:
        rclpy.init(args=["--ros-args", "--params-file", path])
        node = Node("identifier", namespace=namespace, enable_rosout=False)
        found.append({name: repr(p.value) for name, p in node._parameter_overrides.items()})
        node.destroy_node()
    except Exception:
        found.append(None)
    rclpy.try_shutdown()
print("FOUND " + json.dumps(found))
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "parameters.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def rclpy_nodes(*requested: tuple[Path, str]) -> list[dict[str, str] | None]:
    """Return the parameters of real nodes from a file, by namespace; None if rclpy refuses it."""
    pytest.importorskip("rclpy")
    given = json.dumps([(str(path), namespace) for path, namespace in requested])
    done = python("-c", NODES, input=given, check=True)
    return json.loads(done.stdout.split("FOUND ")[1])


def test_values_equal_those_of_rclpy(tmp_path: Path) -> None:
    path = write(tmp_path, TRICKY)
    namespaces = ("/", "/drone1", "/fleet/drone1")
    for namespace, live in zip(
        namespaces, rclpy_nodes(*((path, n) for n in namespaces)), strict=True
    ):
        mine = load_parameters(path, f"{namespace.rstrip('/')}/identifier")
        assert {name: repr(value) for name, value in mine.items()} == live, namespace


def test_a_parameter_that_is_given_twice_is_named_with_the_value_that_counts(
    tmp_path: Path,
) -> None:
    """As in rcl the last one counts; the same parameter in two sections is no doubt."""
    file = ParameterFile.read(write(tmp_path, TRICKY))
    twice, delay = file.doubts("/identifier")
    assert "'twice' more than once in section '/**': 2, the last, counts" in twice
    assert "'actuators.delay' more than once in section '/**': 0.03, the last" in delay
    twice_elsewhere = "/other:\n  ros__parameters:\n    a: 1\n    a: 2\n"
    assert not ParameterFile.read(write(tmp_path, twice_elsewhere)).doubts("/identifier")


REFUSED = [
    ("/**:\n  ros__parameters:\n    a:\n", "line 3: there is no value"),
    ("/**:\n  ros__parameters:\n    a: [1, 0.5]\n", "line 3: .*1 is an integer, 0.5 is a fl"),
    ("/**:\n  ros__parameters:\n    a: [[1.0], [0.5]]\n", "line 3: a list can hold plain"),
    ("/**:\n  ros__parameters:\n    a: {}\n    b: 1\n", "line 3: 'a' is an empty mapping"),
    ("/**:\n  ros__parameters:\n", r"'ros__parameters' is empty: '/\*\*:' or a node's name is"),
    ("/**:\n  ros__parameters: [1]\n", "'ros__parameters' holds a value"),
    ("a: 1\n", "line 1: 'a' holds a value"),
    ("/**:\n  ros__parameters:\n    a: 1\n  b: 2\n", "line 4: 'b' holds a value"),
    ("/**:\n  ros__parameters:\n    a: &q 1\n    b: *q\n", "line 4: ROS .* no.* aliases"),
    ("/**:\n  ros__parameters:\n    '': 1\n", "line 3: there is no key"),
    ("bad name:\n  ros__parameters:\n    a: 1\n", "'bad name' is no node name"),
    ("ros__parameters:\n  a: 1\n", "line 1: there is no node name before"),
    ("/**:\n  ros_parameters:\n    a: 1\n", "line 2: 'ros_parameters' has to be 'ros__parameters'"),
    ("/**:\n  ros__parameters:\n    a: {b: 1\n", r"expected ',' or '\}'"),
    ("/**:\n  ros__parameters:\n\ta: 1\n", "line 3: there is a tab: YAML is indented with"),
    ("[1, 2]\n", "line 1: the file holds a value"),
]


def test_files_refused_by_rcl_are_refused(tmp_path: Path) -> None:
    paths = []
    for number, (text, words) in enumerate(REFUSED):
        paths.append(tmp_path / f"{number}.yaml")
        paths[-1].write_text(text, encoding="utf-8")
        with pytest.raises(ParameterFileError, match=words) as caught:
            ParameterFile.read(paths[-1])
        assert str(paths[-1]) in str(caught.value)
        assert "\n" not in str(caught.value)
    assert rclpy_nodes(*((path, "/") for path in paths)) == [None] * len(paths)


def test_files_without_parameters_are_empty_and_non_text_is_refused(tmp_path: Path) -> None:
    for text in ("", "# nothing\n", "/**:\n  ros__parameters: {}\n"):
        assert load_parameters(write(tmp_path, text), "identifier") == {}
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "control").write_bytes(b"a: \x01\n")
    for name, words in (
        ("missing.yaml", r"missing.yaml': there is no such file"),
        ("", "directory"),
        ("binary", "UTF-8"),
        ("control", "special characters"),
    ):
        with pytest.raises(ParameterFileError, match=words):
            ParameterFile.read(tmp_path / name)


def test_parameters_of_every_node_are_omitted_and_the_others_valid(tmp_path: Path) -> None:
    text = (
        "/**:\n  ros__parameters:\n    use_sim_time: true\n    forgetting_time: 1e2\n"
        "    qos_overrides./imu/data.subscription.depth: 100\n"
        "    actuators: {channels: [2, 0, 1, 3], trim: []}\n"
    )
    values = load_parameters(write(tmp_path, text), "identifier")
    assert values.keys() == {"forgetting_time", "actuators.channels", "actuators.trim"}
    settings = Settings.from_values(values)
    assert settings.forgetting_time == 100.0
    assert settings.actuators.channels == (2, 0, 1, 3)
    assert settings.actuators.trim == ()


def example(structure: str = "baseline", t_ns: int = 1_700_000_000_123_456_789) -> CoefficientSet:
    rng = np.random.default_rng(1)
    mask = STRUCTURES[structure].mask
    values = np.where(
        mask, rng.normal(size=mask.shape) * 10.0 ** rng.integers(-9, 9, mask.shape), 0
    )
    return CoefficientSet(structure, values, np.where(mask, np.abs(values) / 7.0, 0.0), t_ns)


def saved(folder: Path) -> tuple[Path, str]:
    path = folder / "coefficients.yaml"
    save_coefficients(example(), path)
    return path, path.read_text(encoding="utf-8")


def test_any_yaml_reader_reads_numbers(tmp_path: Path) -> None:
    original = example()
    original.values[0, 0] = 1e-5  # Python writes 1e-05, a string in YAML 1.1
    original.sigma[0, 0] = np.nan
    save_coefficients(original, tmp_path / "coefficients.yaml")
    content = yaml.safe_load((tmp_path / "coefficients.yaml").read_text(encoding="utf-8"))
    assert content["coefficients"]["pdot/pq"] == {"value": 1e-5, "sigma": np.inf}
    assert list(content["coefficients"]) == list(STRUCTURES["baseline"].names)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("version: 1", "version: 2", "version 2 is not known, only 1 is"),
        ("uav_ident_ros/coefficients", "other", "the format is 'other'"),
        ("structure: baseline", "structure: base", "structure 'base' is unknown, known"),
        ("  pdot/da:", "  pdot/daa:", "unknown entry 'pdot/daa': did you mean 'pdot/da'"),
        ("  pdot/pq:", "  # pdot/pq:", "coefficients has no pdot/pq"),
        ("  pdot/qr:", "  pdot/pq:", "'pdot/pq' is there twice"),
        ("pdot/pq: {value:", "pdot/pq: {val:", "pdot/pq has an unknown entry 'val': did you mean"),
        ("pdot/pq: {value:", "pdot/pq: {value: .nan, x:", "unknown entry 'x'"),
        ("stamp: 1", "stamp: x1", "stamp is 'x1700000000.123456789', which is no number"),
        ("stamp: 1", "stamp: -1", "stamp is '-1.*': a stamp holds 0 to"),
        ("stamp: 1", "stamp: 1e999980 # ", "stamp is '1e999980': a stamp holds 0 to"),
        ("stamp: 1", "stamp: nan # ", "stamp is 'nan'"),
        ("stamp: ", "saved: yesterday\nstamp: ", "saved is 'yesterday', not a time like"),
        ("stamp: ", "saved: 2026-01-01\nstamp: ", "'2026-01-01', without a time zone"),
        ("stamp: ", "usable: maybe\nstamp: ", "usable is 'maybe', not true or false"),
        ("stamp: ", "learned_with: it\nstamp: ", "learned_with must be a mapping"),
        ("stamp: ", "servo_lag: 0.7\nstamp: ", r"servo_lag is 0\.7: allowed is 0 to 0\.5 s"),
        ("sigma: ", "sigma: -", "the sigma of pdot/pq is negative"),
        ("value: ", "value: x", "the value of pdot/pq is 'x"),
        ("value: ", "value: .nan, sigma: 1} # ", "not a finite number"),
        ("value: ", "value: 1e999, sigma: 1} # ", "not a finite number"),
        ("value: ", "value: true, sigma: 1} # ", "not a finite number"),
        ("coefficients:\n", "coefficients: 3\nmore:\n", "unknown entry 'more'"),
        ("{value", "{{value", "line [78]: "),
        ("format:", "form:", "unknown entry 'form': did you mean 'format'"),
    ],
)
def test_each_fault_has_its_one_line_error(old: str, new: str, words: str, tmp_path: Path) -> None:
    path, text = saved(tmp_path)
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(CoefficientsFileError, match=words) as caught:
        load_coefficients(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_wrong_structure_and_foreign_files_are_refused(tmp_path: Path) -> None:
    path, _ = saved(tmp_path)
    with pytest.raises(CoefficientsFileError, match="for structure 'baseline', but 'structure' is"):
        load_coefficients(path, "augmented")
    for content, words in (
        (b"", "must be a mapping"), (b"- 1\n", "must be a mapping"), (b"\xff\xff", "UTF-8"),
        (b"\0\1" * 500, "special characters"), (b"[" * 5000, "nested too deeply"),
        (b"#" * 2_000_000, "more than any such file"),
    ):  # fmt: skip
        path.write_bytes(content)
        with pytest.raises(CoefficientsFileError, match=words):
            load_coefficients(path)
    os.mkfifo(tmp_path / "pipe")
    for name, words in (("missing.yaml", "no such file"), ("pipe", "a pipe"), ("", "a folder")):
        with pytest.raises(CoefficientsFileError, match=words):
            load_coefficients(tmp_path / name)
    for name, words in (("pipe", "a pipe"), ("", "a folder")):  # as root /dev/null would go, too
        with pytest.raises(CoefficientsFileError, match=f"cannot write .*{words}"):
            save_coefficients(example(), tmp_path / name)
    assert (tmp_path / "pipe").is_fifo()


def test_a_missing_file_says_where_a_relative_path_counts_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A node that systemd or a launch file starts has another folder than the operator."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CoefficientsFileError, match=f"no such file or folder in '{tmp_path}': a"):
        load_coefficients("output/coefficients.yaml")
    with pytest.raises(CoefficientsFileError, match=r"no such file or folder$"):
        load_coefficients(tmp_path / "coefficients.yaml")


def test_a_non_finite_value_is_not_written(tmp_path: Path) -> None:
    path, before = saved(tmp_path)
    spoilt = example()
    spoilt.values[0, 0] = np.nan
    with pytest.raises(CoefficientsFileError, match="coefficient pdot/pq is nan"):
        save_coefficients(spoilt, path)
    assert path.read_text(encoding="utf-8") == before


def test_interrupted_write_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, before = saved(tmp_path)

    def no_space(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(coefficients_file.os, "fsync", no_space)
    with pytest.raises(CoefficientsFileError, match=r"cannot write .*No space left"):
        save_coefficients(example(t_ns=1), path)
    assert path.read_text(encoding="utf-8") == before
    assert os.listdir(tmp_path) == [path.name]


def test_a_missing_folder_is_refused_and_a_link_is_kept(tmp_path: Path) -> None:
    with pytest.raises(CoefficientsFileError, match="no such file or folder"):
        save_coefficients(example(), tmp_path / "missing" / "c.yaml")
    target, link = tmp_path / "target.yaml", tmp_path / "link.yaml"
    link.symlink_to(target)
    save_coefficients(example(), link)
    assert link.is_symlink()
    assert load_coefficients(target).t_ns == example().t_ns


sigmas = st.one_of(
    st.floats(min_value=0.0, allow_nan=False), st.just(math.inf), st.just(0.0), st.just(5e-324)
)


@st.composite
def coefficient_sets(draw: st.DrawFn) -> CoefficientSet:
    structure = STRUCTURES[draw(st.sampled_from(sorted(STRUCTURES)))]
    values, sigma = np.zeros(structure.mask.shape), np.zeros(structure.mask.shape)
    for index in structure.free:
        values[index] = draw(st.floats(allow_nan=False, allow_infinity=False))
        sigma[index] = draw(sigmas)
    return CoefficientSet(structure.name, values, sigma, draw(st.integers(0, 2**63 - 1)))


any_notes = st.builds(
    Notes,
    saved=st.none() | st.datetimes(timezones=st.just(UTC)),
    usable=st.none() | st.booleans(),
    delay=st.none() | st.floats(0.0, MAX_DELAY),
    learned_with=st.dictionaries(
        st.sampled_from([setting.name for setting in declarations()]),
        (st.text() | st.lists(st.floats(allow_nan=False))).map(json.dumps),
    ),
)


@given(saved=coefficient_sets(), notes=any_notes)
def test_saving_and_loading_coefficients_is_the_identity(
    tmp_path_factory: pytest.TempPathFactory, saved: CoefficientSet, notes: Notes
) -> None:
    path = tmp_path_factory.mktemp("saved") / "coefficients.yaml"
    save_coefficients(saved, path, notes)
    loaded, loaded_notes = load_with_notes(path, saved.structure)
    assert loaded.structure == saved.structure
    assert loaded.t_ns == saved.t_ns
    assert loaded.values.tobytes() == saved.values.tobytes()
    assert loaded.sigma.tobytes() == saved.sigma.tobytes()
    assert loaded_notes == notes
    before = path.read_bytes()
    save_coefficients(loaded, path, loaded_notes)
    assert path.read_bytes() == before
