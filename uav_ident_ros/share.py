# SPDX-License-Identifier: Apache-2.0
"""Where `config/` and `bags/` are: in the sources, or in share/ of an installation."""

from pathlib import Path

PACKAGE = "uav_ident_ros"


def shared(name: str) -> Path:
    """Return the path of a shared file or folder, such as ``bags/multisine``.

    Raises
    ------
    FileNotFoundError
        If it is neither in the sources nor installed.
    """
    here = Path(__file__).resolve()
    # beside the package in the sources; PREFIX/lib/python3.12/site-packages/uav_ident_ros in
    # an installation, with colcon's links too
    folders = [here.parents[1], *(top / "share" / PACKAGE for top in Path(__file__).parents)]
    for folder in folders:
        if (folder / name).exists():
            return folder / name
    raise FileNotFoundError(f"'{name}' is not installed with {PACKAGE}: build it with colcon anew")
