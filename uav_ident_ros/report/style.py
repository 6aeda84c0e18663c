# SPDX-License-Identifier: Apache-2.0
"""The style sheet of the page: telephone, desk and paper, light and dark."""

from __future__ import annotations

from uav_ident_ros.report.drawing import COLORS

NARROW_BELOW = 700
"""Width of the window up to which the narrow charts are shown, CSS pixels."""


def style_sheet() -> str:
    """Return the style sheet."""
    light, dark = ("".join(f"--{name}:{pair[k]};" for name, pair in COLORS.items()) for k in (0, 1))
    return (
        f":root{{color-scheme:light dark;{light}}}\n"
        f"@media (prefers-color-scheme:dark){{:root{{{dark}}}}}\n"
        f"{_RULES}"
        f"@media (max-width:{NARROW_BELOW}px){{{_NARROW}}}\n"
        f"@media print{{:root{{color-scheme:light;{light}}}{_PRINT}}}\n"
    )


_RULES = """\
*{box-sizing:border-box}
html{-webkit-text-size-adjust:100%;scroll-behavior:smooth}
body{margin:0;background:var(--paper);color:var(--ink);
 font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif}
header,main,footer{max-width:66rem;margin:0 auto;padding:0 1.25rem}
header{padding-top:2rem}
h1{font-size:1.9rem;line-height:1.2;margin:0 0 .25rem;overflow-wrap:anywhere}
h2{font-size:1.35rem;line-height:1.25;margin:0 0 .5rem}
h3{font-size:1rem;margin:0 0 .25rem}
p{margin:.4rem 0;max-width:46rem}
a{color:var(--tick)}
code,.hash{font-family:ui-monospace,SFMono-Regular,Menlo,Consolas,monospace;font-size:.85em;
 overflow-wrap:anywhere}
section{margin:2.75rem 0}
.lead,figcaption,.note{color:var(--muted)}
.lead{margin:0}
figcaption,.note{font-size:.875rem;max-width:46rem}
nav ul{list-style:none;display:flex;flex-wrap:wrap;gap:.25rem 1.1rem;margin:1rem 0 0;padding:0}
.verdict{margin:1.25rem 0 0;padding:.9rem 1.1rem;border-left:.4rem solid var(--fault);
 background:var(--shade);border-radius:.25rem}
.verdict.usable{border-color:var(--third)}
.verdict p{margin:0}
.verdict strong{font-size:1.15rem}
.verdict h2{font-size:1rem;margin:.6rem 0 .1rem}
.verdict ul{margin:0;padding-left:1.2rem;max-width:46rem}
.verdict li{margin:.2rem 0}
.cards{display:grid;grid-template-columns:repeat(3,1fr);gap:1rem;margin:1rem 0;padding:0;
 list-style:none}
.cards li{background:var(--shade);border-radius:.25rem;padding:.75rem 1rem}
.cards .value{display:block;font-size:1.8rem;line-height:1.2;font-variant-numeric:tabular-nums}
.cards .beside{display:block;font-size:.875rem;color:var(--muted)}
.bar{position:relative;display:block;height:.5rem;margin:.4rem 0;border-radius:.25rem;
 background:var(--grid)}
.bar span{position:absolute;inset:0 auto 0 0;width:calc(var(--share)*1%);border-radius:.25rem;
 background:var(--tick)}
.bar i{position:absolute;top:-.2rem;bottom:-.2rem;left:calc(var(--hold)*1%);width:2px;
 background:var(--ink)}
.scroll{overflow-x:auto;margin:.75rem 0}
table{border-collapse:collapse;font-size:.9rem;font-variant-numeric:tabular-nums}
caption{text-align:left;font-weight:600;padding:.25rem 0;caption-side:top}
th,td{padding:.22rem .75rem .22rem 0;text-align:right;vertical-align:baseline;
 border-bottom:1px solid var(--grid)}
thead th{color:var(--muted);font-weight:600;white-space:nowrap;border-bottom:1px solid var(--muted)}
th:first-child,td.words,thead th.words{text-align:left}
tbody th{font-weight:400}
td.words{white-space:normal;overflow-wrap:anywhere;min-width:9rem}
tr.weak td,tr.weak th{color:var(--muted)}
table.correlations td{text-align:center;padding:.22rem .3rem;min-width:2.4rem;
 background:color-mix(in srgb,var(--ahead) calc(var(--share)*55%),transparent)}
table.correlations thead th{text-align:center;padding:.22rem .3rem}
table.correlations th:first-child{text-align:left;padding-right:.6rem}
figure{margin:1.5rem 0 2rem}
figure svg{display:block;width:100%;height:auto;overflow:visible;margin:.25rem 0}
figure svg *{stroke-linejoin:round;stroke-linecap:butt}
figure svg text{fill:var(--ink);font-family:inherit}
figure svg.narrow{display:none}
.legend{display:flex;flex-wrap:wrap;gap:.1rem 1rem;list-style:none;margin:.1rem 0;padding:0;
 font-size:.875rem}
.swatch{display:inline-block;width:1.2rem;height:.35rem;border-radius:.15rem;margin-right:.4rem;
 vertical-align:middle;background:var(--shade)}
.side{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,24rem),1fr));
 gap:0 2.5rem;align-items:start}
details{margin:.75rem 0}
summary{cursor:pointer}
footer{margin:3rem auto 2rem;font-size:.875rem;color:var(--muted)}
"""

_NARROW = """\
header,main,footer{padding-left:1rem;padding-right:1rem}
header{padding-top:1.25rem}
h1{font-size:1.45rem}
section{margin:2rem 0}
.cards{gap:.5rem}
.cards li{padding:.5rem .6rem}
.cards .value{font-size:1.3rem}
.cards .beside{font-size:.75rem}
th,td{padding-right:.4rem}
table{font-size:.8rem}
td.words{min-width:5.5rem}
figure svg.wide{display:none}
figure svg.narrow{display:block;max-width:30rem}
"""

_PRINT = """\
@page{size:A4;margin:14mm}
body{font-size:10pt;background:none}
.side{grid-template-columns:1fr 1fr}
header,main,footer{max-width:none;padding:0}
header{padding-top:0}
nav{display:none}
section{margin:1.2rem 0}
h2,h3,caption,thead{break-after:avoid}
figure,tr,.cards,.verdict,table.short,#delay,#origin{break-inside:avoid}
figure{margin:.6rem 0}
figure svg.wide{display:block}
figure svg.narrow{display:none}
.scroll{overflow:visible}
table{font-size:8.5pt}
th,td{padding-top:.1rem;padding-bottom:.1rem}
thead{display:table-header-group}
details::details-content{content-visibility:visible;block-size:auto}
summary{list-style:none}
*{-webkit-print-color-adjust:exact;print-color-adjust:exact}
"""
