# SPDX-License-Identifier: Apache-2.0
"""Colours, the same in all charts of the page and in the pictures."""

COLORS = {
    # Okabe and Ito's palette, distinct with any colour vision.
    "measured": "#75797d",
    "ahead": "#d55e00",
    "tick": "#0072b2",
    "truth": "#009e73",
    "fourth": "#a8588a",
    "muted": "#5b6168",
    "grid": "#dcdedf",
    "ink": "#1a1c1e",
    "waiting": "#bdbebf",
    "learning": "#e69f00",
    "converged": "#009e73",
    "paused": "#56b4e9",
    "fault": "#b00020",
}
"""Colours on a light page; the style sheet inverts them in dark mode."""

SERIES = ("tick", "ahead", "truth", "fourth")
"""Colours of several lines in a chart, of inputs or axes."""

DASHES = ("solid", "dashed", "dotdash", "dotted")
"""Dashes of these lines, for prints without colours."""

HUES = {
    "p": "#0072b2", "q": "#56b4e9", "r": "#009e73", "de": "#a8588a", "dr": "#8c564b",
    "da": "#cc79a7", "beta": "#8a8a00", "alpha": "#e69f00",
}  # fmt: skip
"""Colours of the regressors whose coefficients share a panel."""
