"""The page of a comparison: one HTML file that needs no server and asks for nothing from anywhere."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator
from html import escape
from importlib.metadata import version

from ropetrace.evaluation.compare import telling_frames
from ropetrace.evaluation.compare_pictures import color_of, error_chart, frame_picture
from ropetrace.evaluation.compare_tables import (
    Comparison,
    Table,
    case_table,
    disagreement_table,
    matrix_table,
    node_of,
    overall_table,
    symmetric_of,
)
from ropetrace.types import BadFrame, FloatArray

_STYLE = """
:root { color-scheme: light dark; --ground: #fff; --card: #f6f7f9; --text: #1c2128; --pale: #667080; --line: #d9dee5;
  --bad: #e5484d; --good: #1a8f4f; }
@media (prefers-color-scheme: dark) { :root { --ground: #0f1216; --card: #181c22; --text: #e6e9ee; --pale: #98a2b0;
  --line: #2d343d; --bad: #ff6369; --good: #4cc38a; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1180px; padding: 28px 20px 60px; background: var(--ground); color: var(--text);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 26px; margin: 0 0 4px; } h2 { font-size: 19px; margin: 36px 0 8px; } h3 { margin: 0; font-size: 17px; }
p { margin: 6px 0; max-width: 80ch; } .pale { color: var(--pale); font-size: 13.5px; }
.legend { position: sticky; top: 0; z-index: 1; display: flex; flex-wrap: wrap; gap: 6px 16px; padding: 9px 0;
  background: var(--ground); border-bottom: 1px solid var(--line); font-size: 14px; }
.legend i, th i { display: inline-block; width: 12px; height: 12px; border-radius: 3px; margin-right: 6px;
  vertical-align: -1px; } .legend i.truth { background: #fff; border: 1px solid #888; height: 5px;
  vertical-align: 3px; }
.scroll { overflow-x: auto; } .pair { display: flex; flex-wrap: wrap; gap: 0 48px; }
table { border-collapse: collapse; margin: 10px 0; font-variant-numeric: tabular-nums; font-size: 13.5px; }
th, td { padding: 4px 8px; text-align: right; border-bottom: 1px solid var(--line); }
thead th { color: var(--pale); font-weight: 600; vertical-align: bottom; }
th:first-child { text-align: left; white-space: nowrap; }
tbody th { font-weight: 600; } td.best { color: var(--good); font-weight: 700; }
td.heat { background: color-mix(in srgb, var(--bad) var(--heat), transparent); }
.case { background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: 16px 18px;
  margin: 16px 0; } .case header { display: flex; gap: 12px; align-items: baseline; flex-wrap: wrap; }
svg { width: 100%; height: auto; display: block; margin: 8px 0; } svg text { font-size: 12px; fill: var(--pale); }
svg polyline { fill: none; stroke-width: 1.8; stroke-linejoin: round; stroke-linecap: round; }
svg .grid { stroke: var(--line); } svg .hidden { fill: var(--pale); opacity: .14; }
.frames { display: grid; grid-template-columns: repeat(auto-fit, minmax(240px, 1fr)); gap: 12px; }
figure { margin: 0; max-width: 520px; } figure img { width: 100%; border-radius: 6px; display: block; }
figcaption { font-size: 13px; color: var(--pale); margin-top: 4px; } .failed { color: var(--bad); }
a { color: inherit; }
nav { display: flex; flex-wrap: wrap; gap: 4px 14px; font-size: 13.5px; margin: 10px 0; }
"""

_LARGEST_ERROR = 0.1
"""Coloured fully in a table, metres; 1 mm is not coloured at all."""

_FRAMES = 3


def page(comparison: Comparison) -> str:
    """The whole page."""
    legend = "".join(f"<span>{_chip(method)}{escape(method)}</span>" for method in comparison.methods)
    if comparison.with_truth:
        legend += '<span><i class="truth"></i>truth</span>'
    body = [
        f"<h1>{escape(comparison.title)}</h1>",
        f'<p class="pale">ropetrace {escape(version("ropetrace"))}. {escape(comparison.time_note)}</p>',
        f'<div class="legend">{legend}</div>',
        *_summary(comparison),
        "<h2>Case by case</h2>",
        "<nav>" + "".join(f'<a href="#{escape(name)}">{escape(name)}</a>' for name in comparison.cases) + "</nav>",
        '<p class="pale">Lines: '
        + ("symmetric mean error" if comparison.with_truth else "length of the curve")
        + ", with a gap where there is no estimate. Marks on top, a row a method: no estimate (full), degraded (pale). "
        "Grey ground: the share of the rope that is hidden. Pictures: the frames in which the methods differ most; "
        "where curves lie on each other, one shows as the border of the next.</p>",
        *(_case(comparison, name) for name in comparison.cases),
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"/>'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
        "style-src 'unsafe-inline'\"/>"
        '<meta name="viewport" content="width=device-width, initial-scale=1"/>'
        f"<title>{escape(comparison.title)}</title><style>{_STYLE}</style></head>\n<body>\n"
        + "\n".join(body)
        + "\n</body></html>\n"
    )


def _summary(comparison: Comparison) -> Iterator[str]:
    if comparison.with_truth:
        yield "<h2>All cases with truth</h2>"
        yield _html(overall_table(comparison))
        yield (
            '<p class="pale">Frames without an estimate count with the rope\'s length as their error. Symmetric, node, '
            "covered, tips, length and false OK are means over the cases; swaps, lost, degraded and failed are sums. "
            "Node: at equal arc length, which sees sliding along the rope and lost length, as symmetric does not.</p>"
        )
        yield '<div class="pair">'
        for title, figure in (("Symmetric mean error, mm", symmetric_of), ("Error at equal arc length, mm", node_of)):
            yield f"<div><h2>{title}</h2>{_html(matrix_table(comparison, 'case', figure))}</div>"
        yield "</div>"
    failures = comparison.failures()
    if failures:
        yield "<h2>Failures</h2>"
        yield "<ul>" + "".join(f'<li class="failed">{escape(failure)}</li>' for failure in failures) + "</ul>"


def _case(comparison: Comparison, name: str) -> str:
    case = comparison.cases[name]
    parts = [
        f'<section class="case" id="{escape(name)}"><header><h3>{escape(name)}</h3>'
        f'<span class="pale">{escape(case.description)}</span></header>',
        error_chart(dict(zip(comparison.methods, comparison.of_run(name), strict=True))),
        _html(case_table(comparison, name)),
    ]
    if name not in comparison.with_truth and len(comparison.methods) > 1:
        parts += ['<p class="pale">Mean distance between the methods:</p>', _html(disagreement_table(comparison, name))]
    figures = "".join(_figures(comparison, name))
    return "\n".join([*parts, f'<div class="frames">{figures}</div></section>'])


def _figures(comparison: Comparison, name: str) -> Iterator[str]:
    """The frames that tell most."""
    runs = dict(zip(comparison.methods, comparison.of_run(name), strict=True))
    first = next(iter(runs.values()))
    wanted = telling_frames(list(runs.values()), _FRAMES)
    for index, (event, _) in enumerate(comparison.cases[name].frames(max(wanted, default=-1) + 1)):
        if index not in wanted or isinstance(event, BadFrame):
            continue
        curves: dict[str, FloatArray] = {method: run.curve[index].astype(float) for method, run in runs.items()}
        data = base64.b64encode(frame_picture(event, curves, first.truth[index].astype(float))).decode()
        seconds = (event.stamp_ns - int(first.stamp_ns[0])) / 1e9
        missing = [method for method, run in runs.items() if not math.isfinite(run.length[index])]
        caption = f"frame {index}, {seconds:.2f} s"
        if missing:
            caption += f"; no estimate: {', '.join(missing)}"
        yield (
            f'<figure><img alt="{escape(name)}, {escape(caption)}" src="data:image/png;base64,{data}"/>'
            f"<figcaption>{escape(caption)}</figcaption></figure>"
        )


def _chip(method: str) -> str:
    return f'<i style="background:{color_of(method)}"></i>'


def _html(table: Table) -> str:
    """A table; where its numbers are known, the best of each row is set off and errors are coloured by their size."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in table.header)
    lines = []
    for place, row in enumerate(table.rows):
        numbers = [math.nan] * (len(row) - 1) if table.numbers is None else table.numbers[place]
        best = min((value for value in numbers if math.isfinite(value)), default=math.nan)
        cells = "".join(map(_cell, row[1:], numbers, (len(numbers) > 1 and value == best for value in numbers)))
        chip = _chip(row[0]) if table.header[0] in ("method", "mm apart") else ""
        lines.append(f"<tr><th>{chip}{escape(row[0])}</th>{cells}</tr>")
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead>\n<tbody>{"".join(lines)}</tbody></table></div>'


def _cell(text: str, number: float, best: bool) -> str:
    heat = 0.0 if not number > 1e-3 else min(math.log(number / 1e-3) / math.log(_LARGEST_ERROR / 1e-3), 1.0)
    names = " ".join(name for name, given in (("best", best), ("heat", heat > 0)) if given)
    attributes = (f' class="{names}"' if names else "") + (f' style="--heat:{45 * heat:.0f}%"' if heat else "")
    return f"<td{attributes}>{escape(text)}</td>"
