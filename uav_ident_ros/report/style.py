# SPDX-License-Identifier: Apache-2.0
"""Colours and what they mean, the same in every chart of the page and in the pictures."""

COLORS = {
    # Okabe and Ito's palette, told apart with any colour vision.
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
"""Colours on light paper; at night the style sheet turns them over."""

SERIES = ("tick", "ahead", "truth", "fourth")
"""Colours of lines side by side, of inputs or axes."""

DASHES = ("solid", "dashed", "dotdash", "dotted")
"""Their dashes: print may have no colours."""

REGRESSORS = {
    "p": "#0072b2", "q": "#56b4e9", "r": "#009e73", "de": "#a8588a", "dr": "#8c564b",
    "da": "#cc79a7", "beta": "#8a8a00", "alpha": "#e69f00",
}  # fmt: skip
"""Regressors whose coefficients share a panel, each in one colour throughout."""
