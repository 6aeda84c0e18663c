# SPDX-License-Identifier: Apache-2.0
"""`report.html`: what a flight has shown, on one page that needs nothing but a browser."""

from importlib import import_module
from typing import Any


class PictureError(Exception):
    """A package that draws is missing; the message names it."""


def drawing(name: str) -> Any:
    """Return a module of this folder, which may need what not every machine has.

    Raises
    ------
    PictureError
        If a package that it draws with is missing.
    """
    try:
        return import_module(f"{__name__}.{name}")
    except ImportError as error:
        packages = "pip install bokeh jinja2 matplotlib"
        raise PictureError(
            f"pictures and pages need their packages ({packages}): {error}"
        ) from None
