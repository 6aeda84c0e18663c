# SPDX-License-Identifier: Apache-2.0
"""Paths of `config/` and `bags/`, in the sources or in share/ of an installation."""

from pathlib import Path

PACKAGE = "uav_ident_ros"


def shared(name: str) -> Path:
    """Return the path of a shared file or folder, such as ``bags/multisine``.

    Raises
    ------
    FileNotFoundError
        If the path is neither in the sources nor installed.
    """
    here = Path(__file__).resolve()
    # in the sources beside the package; in an installation, colcon's links included, from
    # PREFIX/lib/python3.12/site-packages/uav_ident_ros
    folders = [here.parents[1], *(top / "share" / PACKAGE for top in Path(__file__).parents)]
    for folder in folders:
        if (folder / name).exists():
            return folder / name
    raise FileNotFoundError(f"'{name}' is not installed with {PACKAGE}: build it with colcon anew")
