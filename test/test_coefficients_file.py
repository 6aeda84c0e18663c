# SPDX-License-Identifier: Apache-2.0
"""Coefficients files: exact round trip, atomic writing, and one clear line for each fault."""

import os
from pathlib import Path

import numpy as np
import pytest
import yaml

from uav_ident_ros.files import coefficients_file
from uav_ident_ros.files.coefficients_file import (
    CoefficientsFileError,
    load_coefficients,
    save_coefficients,
)
from uav_ident_ros.identification.estimate import CoefficientSet
from uav_ident_ros.identification.structure import STRUCTURES


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


def test_any_yaml_reader_sees_numbers(tmp_path: Path) -> None:
    original = example()
    original.values[0, 0] = 1e-5  # Python writes 1e-05, which YAML 1.1 takes for a word
    save_coefficients(original, tmp_path / "coefficients.yaml")
    content = yaml.safe_load((tmp_path / "coefficients.yaml").read_text(encoding="utf-8"))
    assert content["coefficients"]["pdot/pq"]["value"] == 1e-5
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
def test_each_fault_has_its_line(old: str, new: str, words: str, tmp_path: Path) -> None:
    path, text = saved(tmp_path)
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(CoefficientsFileError, match=words) as caught:
        load_coefficients(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_wrong_structure_empty_missing_and_binary(tmp_path: Path) -> None:
    path, _ = saved(tmp_path)
    with pytest.raises(CoefficientsFileError, match="for structure 'baseline', but 'structure' is"):
        load_coefficients(path, "augmented")
    for content, words in (
        (b"", "it is empty"), (b"- 1\n", "must be a mapping"), (b"\xff\xff", "UTF-8")
    ):  # fmt: skip
        path.write_bytes(content)
        with pytest.raises(CoefficientsFileError, match=words):
            load_coefficients(path)
    with pytest.raises(CoefficientsFileError, match="no such file"):
        load_coefficients(tmp_path / "missing.yaml")


def test_value_that_is_not_finite_is_not_written(tmp_path: Path) -> None:
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


def test_missing_folder_and_link(tmp_path: Path) -> None:
    with pytest.raises(CoefficientsFileError, match="no such file or folder"):
        save_coefficients(example(), tmp_path / "missing" / "c.yaml")
    target, link = tmp_path / "target.yaml", tmp_path / "link.yaml"
    link.symlink_to(target)
    save_coefficients(example(), link)
    assert link.is_symlink()
    assert load_coefficients(target).t_ns == example().t_ns
