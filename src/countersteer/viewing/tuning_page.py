"""The result of a fit and its reliability, as one self-contained HTML page."""

import base64
import io
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import reduce
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from countersteer.car.car import Car
from countersteer.car.parameter import Declaration, declarations
from countersteer.tuning.belief import WORDS as QUANTITIES
from countersteer.tuning.fit import HORIZON
from countersteer.viewing.page import filled
from countersteer.viewing.style import (
    INK,
    SIMULATED,
    SOFT,
    Prediction,
    draw_commands,
    draw_windows,
    dress,
    light,
    new_figure,
)
from countersteer.writing import write_whole

if TYPE_CHECKING:
    pass

Numbers = NDArray[np.float64]

KINDS = {  # of windows, with their description
    "fitted": "windows that were fitted",
    "held out": "of the same runs, not fitted",
    "validation": "of runs that were not fitted",
}
UNSEEN = ("validation", "held out")  # the harder test first
MEASURES = {
    "median_abs_error": "median absolute error at the windows’ ends",
    "rmse": "RMS over the windows",
}
MANY = 6  # lines; a longer list is folded
CORRELATED = 0.8

_HELD_OUT = light("held-out")
_WIDTH_IN, _STRIP_IN, _FOOT_IN, _DPI = 11.0, 1.35, 0.45, 120
_LONGEST = 40.0  # s, longest drawn part of a log
_MOST_WINDOWS = 40  # in a strip
_LIMIT, _BINS = 4.0, 32  # of histograms: range to either side, in scales, and number of bins


def write_tuning_page(
    path: Path, result: Mapping[str, Any], series: Sequence[Mapping[str, Any]]
) -> None:
    """Write the page of `tuning_page` to `path`. An existing file is replaced."""
    write_whole(path, tuning_page(result, series))


def tuning_page(result: Mapping[str, Any], series: Sequence[Mapping[str, Any]]) -> str:
    """The page of a tuning. It loads no other file.

    `result` is the JSON of `countersteer tune`. `warnings`, if given, say when not to believe the
    fit. `low` and `high` of a parameter, if given, are its likely range before the fit. Otherwise
    the range is a factor of e around a positive prior, and for other priors an interval (`_range`).
    `new_runs`, if given, says whether to learn the driver again. `correlations`, if given, are
    [i, j, r] with the indices of two parameters. `series` has one entry for each run: `quantities`,
    measured over the whole log and simulated in windows, and `commands`. NaN and None are unknown
    numbers. Text is shown as text, whatever it contains.
    """
    title = f"{result['car']}: fit of {result['fit']}"
    unfolded = [f"<li>{escape(line)}</li>" for line in result["masked"]]
    fields = {
        "title": escape(title),
        "numbers": _numbers(result),
        "unseen": _unseen(result["runs"]),
        "warnings": _warnings(result.get("warnings", [])),
        "headline": _headline(result),
        "errors": _errors(result),
        "next_log": _next_log(result["next_log"]),
        "parameters": _parameters(result["parameters"]),
        "correlations": _correlations(result),
        "residuals": _residuals(result["residuals"]),
        "sensors": _sensors(result.get("sensors", {})),
        "masked": _folded(unfolded, "Nothing: no fault was found in these logs."),
        "key": _key(),
        "runs": "".join(_run(run, result["runs"]) for run in series),
        "commands": escape(result["commands"]),
    }
    return filled("tuning_page_template.html", fields)


# -------------------------------------------------------------------------------------------------
# In words
# -------------------------------------------------------------------------------------------------


def _numbers(result: Mapping[str, Any]) -> str:
    """The figures beside the title."""
    parameters = result["parameters"]
    determined = sum(p["determined"] for p in parameters)
    shown = {
        "determined": f"{determined} of {len(parameters)}",
        "at a bound": str(sum(p["at_bound"] for p in parameters)),
        "runs": str(len({run["run"] for run in result["runs"]})),
        "fitted in": f"{result['seconds']:.0f} s",
    }
    return "".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in shown.items())


def _unseen(runs: Sequence[Mapping[str, Any]]) -> str:
    """The table of errors on logs, or parts of them, that were not fitted; a row for each."""
    found = []
    for kind in UNSEEN:
        for run in (run for run in runs if run["kind"] == kind):
            lively = run.get("transient", {})
            found.append((run["run"], f"{kind}, {_windows(run)}", _compared(run)))
            if _compared(lively):
                found.append(("– where something changes", _windows(lively), _compared(lively)))
    names = [name for name in QUANTITIES if any(name in compared for *_, compared in found)]
    if not names:
        return "<p>None: all that was given was fitted.</p>"
    rows = [
        f"<tr><th><b>{escape(title)}</b> <small>{about}</small></th>"
        + "".join(_error_cell(compared.get(name)) for name in names)
        + "</tr>"
        for title, about, compared in found
    ]
    words = (QUANTITIES[name] for name in names)
    heads = "".join(f"<th>{what}<small>{unit}</small></th>" for what, unit in words)
    return (
        '<div class="wide"><table class="errors"><thead><tr><th>median absolute error after '
        f"{HORIZON:g} s</th>{heads}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def _warnings(lines: Sequence[str]) -> str:
    """The reasons not to believe the fit."""
    items = [f'<li class="bad">{escape(line)}</li>' for line in lines]
    return _folded(
        items, "Nothing speaks against this fit. What no log holds, none can contradict."
    )


def _headline(result: Mapping[str, Any]) -> str:
    """The car's errors on data outside the fit, and its parameters that stay unknown."""
    said = [_said_of_surface(result["totals"], surface) for surface in result["surfaces"]]
    paragraphs = [f'<p class="lead">{words}</p>' for words in said if words]
    if paragraphs:
        paragraphs.append(
            '<p class="note">In brackets: the error of predicting that nothing changes.</p>'
        )
    else:
        paragraphs = [
            '<p class="lead">Nothing was held out. All errors below are of what was fitted, and '
            "say little about other logs.</p>"
        ]
    if "new_runs" in result:
        paragraphs.insert(0, f'<p class="lead">{escape(result["new_runs"]["verdict"])}</p>')
    open_, bound = (
        [escape(str(name)) for name in result[key]] for key in ("not_determined", "at_bounds")
    )
    paragraphs.append(
        f"<p><b>Not determined</b> by these logs, and hardly moved: {', '.join(open_)}.</p>"
        if open_
        else "<p>The logs determine every parameter that was fitted.</p>"
    )
    paragraphs.append(
        f'<p><b class="bad">At a bound</b> of the declared range: {", ".join(bound)}. The '
        "model makes up there for something that it lacks, or the range is too narrow.</p>"
        if bound
        else "<p>No parameter is at a bound.</p>"
    )
    return "".join(paragraphs)


def _said_of_surface(totals: Mapping[str, Any], surface: str) -> str:
    """Errors on a surface's windows outside the fit; empty if there are none."""
    for kind in UNSEEN:
        scored = totals.get(kind, {}).get(surface)
        if scored and _compared(scored):
            break
    else:
        return ""
    where = "In runs" if kind == "validation" else "In windows"
    words = [
        f"{where} that were not fitted, on <b>{escape(surface)}</b> ({_windows(scored)}), the "
        f"car is off at the median by {_list_of_errors(scored)}."
    ]
    lively = scored.get("transient")
    if lively and _compared(lively):
        words.append(f"Where something changes ({_windows(lively)}): {_list_of_errors(lively)}.")
    worse = [
        QUANTITIES.get(name, (name,))[0]
        for name, (error, still) in _compared(lively or scored).items()
        if error >= still
    ]
    if worse:
        words.append(
            '<span class="bad">No better than predicting that nothing changes: '
            f"{escape(', '.join(worse))}.</span>"
        )
    return " ".join(words)


def _compared(
    scored: Mapping[str, Any], measure: str = "median_abs_error"
) -> dict[str, tuple[float, float]]:
    """Error and error of persistence by quantity, where both are known; in the usual order."""
    errors, still = scored.get("errors") or {}, scored.get("persistence") or {}
    pairs = {
        name: (
            _float(errors.get(name, {}).get(measure)),
            _float(still.get(name, {}).get(measure)),
        )
        for name in [*QUANTITIES, *(name for name in errors if name not in QUANTITIES)]
    }
    return {name: pair for name, pair in pairs.items() if all(map(math.isfinite, pair))}


def _windows(scored: Mapping[str, Any]) -> str:
    count = scored["windows"]
    return f"{count} window" + ("" if count == 1 else "s")


def _list_of_errors(scored: Mapping[str, Any]) -> str:
    said = []
    for name, (error, still) in _compared(scored).items():
        what, unit = QUANTITIES.get(name, (escape(name), ""))
        said.append(f"<b>{_rough(error)}&nbsp;{unit}</b> in {what} ({_rough(still)})")
    return ", ".join(said)


def _next_log(text: str) -> str:
    """One line as a paragraph, several lines as a numbered list."""
    lines = [escape(line) for line in text.splitlines() if line.strip()]
    if len(lines) <= 1:
        return f"<p>{''.join(lines) or 'Not known.'}</p>"
    return f"<ol>{''.join(f'<li>{line}</li>' for line in lines)}</ol>"


def _folded(items: Sequence[str], none: str) -> str:
    """A list, folded if it is long."""
    if not items:
        return f"<p>{none}</p>"
    whole = f"<ul>{''.join(items)}</ul>"
    if len(items) <= MANY:
        return whole
    return f"<details><summary>{len(items)} entries</summary>{whole}</details>"


def _correlations(result: Mapping[str, Any]) -> str:
    """The pairs of parameters that these logs hardly separate."""
    paths = [_named(p) for p in result["parameters"]]
    pairs = sorted(result.get("correlations") or [], key=lambda pair: -abs(pair[2]))
    items = [
        f"<li>{escape(paths[i])} and {escape(paths[j])}: {_fixed(r, 2)}</li>"
        for i, j, r in pairs
        if abs(r) >= CORRELATED
    ]
    if not items:
        return ""
    return (
        "<section><h2>Hard to tell apart</h2>"
        '<p class="note">Correlations of what was found. Near 1 or −1, the logs tell a combination '
        "of the two better than either: do not read them one by one.</p>"
        f"{_folded(items, '')}</section>"
    )


def _named(parameter: Mapping[str, Any]) -> str:
    where = parameter["surface"] or parameter.get("run")
    return f"{parameter['path']} ({where})" if where else str(parameter["path"])


# -------------------------------------------------------------------------------------------------
# Tables
# -------------------------------------------------------------------------------------------------


def _errors(result: Mapping[str, Any]) -> str:
    """The table of errors at the windows' ends, and a folded one of RMS over the windows."""
    ends, over = (_error_table(result, measure) for measure in MEASURES)
    return (
        f"{ends}<details><summary>The same as {MEASURES['rmse']}</summary>{over}</details>"
        if ends
        else "<p>No window could be compared.</p>"
    )


def _error_table(result: Mapping[str, Any], measure: str) -> str:
    """A row for each quantity by surface, in all windows and transient ones; a column by kind."""
    totals = result["totals"]
    kinds = [kind for kind in KINDS if totals.get(kind)]
    rows = []
    for surface in result["surfaces"]:
        whole = {kind: totals[kind].get(surface) or {} for kind in kinds}
        lively = {kind: scored.get("transient") or {} for kind, scored in whole.items()}
        for words, scored in (("all windows", whole), ("where something changes", lively)):
            compared = {kind: _compared(scored[kind], measure) for kind in kinds}
            names = list(dict.fromkeys(name for kind in kinds for name in compared[kind]))
            if not names:
                continue
            counts = "".join(
                f"<td><small>{_windows(s) if s else ''}</small></td>" for s in scored.values()
            )
            rows.append(
                f'<tr class="group"><th>{escape(surface)} <small>{words}</small></th>{counts}</tr>'
            )
            for name in names:
                what, unit = QUANTITIES.get(name, (escape(name), ""))
                cells = "".join(_error_cell(compared[kind].get(name)) for kind in kinds)
                rows.append(f"<tr><th><b>{what}</b> <small>{unit}</small></th>{cells}</tr>")
    if not rows:
        return ""
    heads = "".join(f"<th>{kind}<small>{KINDS[kind]}</small></th>" for kind in kinds)
    return (
        f'<div class="wide"><table class="errors"><thead><tr><th>{MEASURES[measure]}</th>{heads}'
        f"</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def _error_cell(pair: tuple[float, float] | None) -> str:
    if pair is None:
        return "<td>–</td>"
    error, still = pair
    part = error / still if still > 0 else 1.0
    bad = ' class="bad"' if error >= still else ""
    return (
        f"<td><b{bad}>{error:.3f}</b> <small>{still:.3f}</small>"
        f'<span class="ratio"><i{bad} style="width:{100 * min(part, 1):.0f}%"></i></span></td>'
    )


def _parameters(parameters: Iterable[Mapping[str, Any]]) -> str:
    """The table of parameters: meaning, value, deviation and prior."""
    rows = []
    for p in parameters:
        value, deviation, prior = (_float(p[key]) for key in ("value", "deviation", "prior"))
        power, decimals = _digits(value, deviation)
        shown = {
            key: _fixed(_float(p[key]) / 10.0**power, decimals)
            for key in ("value", "deviation", "prior", "by_curvature", "by_halves")
        }
        times = f"×10<sup>{_fixed(power, 0)}</sup> " if power else ""
        declared = _declaration(p["path"])
        meaning = f'<small class="meaning">{escape(declared.meaning)}</small>' if declared else ""
        where = p["surface"] or p.get("run")
        surface = f"<small>{escape(where)}</small>" if where else ""
        path = re.sub(r"([._])", r"\1<wbr>", escape(p["path"]))
        flags = ("" if p["determined"] else ' <span class="flag warn">not determined</span>') + (
            ' <span class="flag bad">at a bound</span>' if p["at_bound"] else ""
        )
        rows.append(
            f"<tr><th><b>{path}</b>{flags}{surface}{meaning}</th>"
            f"<td><b>{shown['value']}</b> ± {shown['deviation']} "
            f"<small>{times}{escape(p['unit'])}</small></td>"
            f"<td>{_range(p, value, deviation, prior)}</td>"
            f"<td>{shown['prior']}</td><td>{shown['by_curvature']}</td>"
            f"<td>{shown['by_halves']}</td></tr>"
        )
    return (
        '<div class="wide"><table class="parameters"><thead><tr><th>parameter</th>'
        "<th>value ± deviation</th><th></th><th>prior</th><th>deviation<small>by curvature</small>"
        "</th><th>deviation<small>by halves</small></th></tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _declaration(path: str) -> Declaration | None:
    """The car's declaration of a parameter; None for other names, such as a sensor's delay."""
    *rooms, name = path.split(".")
    try:
        part = reduce(getattr, rooms, Car())
        return dict(declarations(type(part)).values()).get(name)
    except (AttributeError, TypeError):
        return None


def _range(p: Mapping[str, Any], value: float, deviation: float, prior: float) -> str:
    """A bar over the likely range before the fit, with the value found."""
    if not math.isfinite(value):
        return ""
    prior = prior if math.isfinite(prior) else value
    low, high = _float(p.get("low")), _float(p.get("high"))
    if not low < high:
        beside = 4.0 if p["unit"] == "deg" else max(abs(prior), abs(value), 1e-12)
        positive = prior > 0 and value > 0 and p["unit"] != "deg"
        low, high = (
            (prior / math.e, prior * math.e) if positive else (prior - beside, prior + beside)
        )
    low, high = min(low, value), max(high, value)
    logarithmic = low > 0
    deviation = deviation if math.isfinite(deviation) else high - low

    def place(number: float) -> float:
        if logarithmic:
            part = math.log(max(number, 1e-300) / low) / math.log(high / low)
        else:
            part = (number - low) / (high - low)
        return 6 + 158 * min(max(part, 0.0), 1.0)

    begin, end, dot = place(value - deviation), place(value + deviation), place(value)
    kind = " at-bound" if p["at_bound"] else "" if p["determined"] else " open"
    return (
        f'<svg class="range{kind}" viewBox="0 0 170 22" role="img" aria-label="value and deviation '
        f'between {low:.3g} and {high:.3g}"><line class="track" x1="6" x2="164" y1="11" y2="11"/>'
        f'<line class="prior" x1="{place(prior):.1f}" x2="{place(prior):.1f}" y1="3" y2="19"/>'
        f'<line class="deviation" x1="{begin:.1f}" x2="{end:.1f}" y1="11" y2="11"/>'
        f'<circle class="value" cx="{dot:.1f}" cy="11" r="4.5"/></svg>'
    )


# -------------------------------------------------------------------------------------------------
# Residuals
# -------------------------------------------------------------------------------------------------


def _residuals(residuals: Mapping[str, Mapping[str, Any]]) -> str:
    """A histogram for each channel."""
    figures = "".join(_histogram(name, channel) for name, channel in residuals.items())
    return f'<div class="residuals">{figures}</div>' if figures else "<p>None were kept.</p>"


def _histogram(name: str, channel: Mapping[str, Any]) -> str:
    """A channel's residuals over its scale, beside the normal density."""
    values = _finite(channel["values"])
    what, unit = QUANTITIES.get(name, (name, ""))
    caption = f"<b>{escape(what)}</b>"
    if not len(values):
        return f"<figure><figcaption>{caption}<p>none</p></figcaption></figure>"
    counts, edges = np.histogram(values, _BINS, (-_LIMIT, _LIMIT))
    density = counts / (len(values) * (edges[1] - edges[0]))
    grid = np.linspace(-_LIMIT, _LIMIT, 81)
    normal = np.exp(-(grid**2) / 2) / math.sqrt(2 * math.pi)
    top = max(float(density.max()), float(normal.max())) * 1.06
    width, height, foot = 260.0, 110.0, 16.0

    def across(x: float) -> float:
        return width * (x + _LIMIT) / (2 * _LIMIT)

    bars = "".join(
        f'<rect x="{across(edge) + 0.4:.1f}" y="{height * (1 - part / top):.1f}" '
        f'width="{width / _BINS - 0.8:.1f}" height="{height * part / top:.1f}"/>'
        for edge, part in zip(edges[:-1], density, strict=True)
        if part > 0
    )
    line = " ".join(
        f"{across(x):.1f},{height * (1 - y / top):.1f}" for x, y in zip(grid, normal, strict=True)
    )
    ticks = "".join(
        f'<text x="{across(x):.1f}" y="{height + foot - 3:.0f}">{_fixed(x, 0)}</text>'
        for x in (-3, -2, -1, 0, 1, 2, 3)
    )
    beyond = np.mean(np.abs(values) > _LIMIT)
    half = np.median(np.abs(values - np.median(values)))
    tail = f"; {100 * beyond:.1f} % lie beyond ±{_LIMIT:g}" if beyond > 0 else ""
    return (
        f'<figure><svg viewBox="0 0 {width:g} {height + foot:g}" role="img" '
        f'aria-label="histogram of {escape(what)}">{bars}<line x1="0" x2="{width:g}" '
        f'y1="{height:g}" y2="{height:g}"/><polyline points="{line}"/>{ticks}</svg><figcaption>'
        f"{caption}<p>{len(values)} values, 1 is {_float(channel['scale']):.3g} {unit}. Median "
        f"{_fixed(float(np.median(values)), 2)}, half within ±{half:.2f} of it{tail}.</p>"
        "</figcaption></figure>"
    )


# -------------------------------------------------------------------------------------------------
# Runs
# -------------------------------------------------------------------------------------------------


def _sensors(logs: Mapping[str, Any]) -> str:
    """What each log tells of its sensors, beside what is declared, and the warnings."""
    rows, warnings = [], []
    for name, told in logs.items():
        warnings += [f"<li>{escape(name)}: {escape(line)}</li>" for line in told["warnings"]]
        for one in told["estimates"]:
            if not one["determined"]:
                continue
            cells = (
                escape(name),
                escape(f"{one['sensor']}.{one['key']}"),
                f"{_fixed(one['estimated'], 4)} ± {_fixed(one['deviation'], 4)}",
                f"{_fixed(one['declared'], 4)} ({escape(one['declared_by'])})",
                escape(one["used"]),
            )
            rows.append(f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
    if not rows and not warnings:
        return "<p>The logs tell nothing of them.</p>"
    head = "".join(
        f"<th>{word}</th>" for word in ("log", "number", "the log tells", "declared", "used")
    )
    table = f'<div class="wide"><table><tr>{head}</tr>{"".join(rows)}</table></div>' if rows else ""
    return table + (_folded(warnings, "") if warnings else "")


def _key() -> str:
    """The meaning of the figures' colours."""
    colours = (
        ("measured", "measured"),
        ("simulated", "simulated, fitted"),
        ("held-out", "simulated, held out"),
    )
    said = (f'<b style="color:var(--{name})">{words}</b>' for name, words in colours)
    return ", ".join(said) + "."


def _run(run: Mapping[str, Any], scored: Iterable[Mapping[str, Any]]) -> str:
    """A run's figure under its name and errors."""
    lines = []
    for entry in scored:
        if entry["run"] != run["run"]:
            continue
        errors = "; ".join(
            f"{escape(QUANTITIES.get(name, (name,))[0])} {error:.3f} ({still:.3f})"
            for name, (error, still) in _compared(entry).items()
        )
        lines.append(f"<p>{escape(entry['kind'])}, {_windows(entry)}: {errors or 'no errors'}</p>")
    begin, end, whole = _stretch(run)
    if end - begin < whole - 1e-9:
        lines.append(
            f"<p>Drawn: the {end - begin:.0f} s of {whole:.0f} s in which most changes.</p>"
        )
    picture = base64.b64encode(_draw(run, begin, end)).decode()
    name = escape(run["run"])
    return (
        f"<figure><figcaption><b>{name}</b> · {escape(run['surface'])} · {escape(run['kind'])}"
        f'{"".join(lines)}</figcaption><div class="wide"><img alt="{name}: measured and simulated" '
        f'src="data:image/png;base64,{picture}"></div></figure>'
    )


def _stretch(run: Mapping[str, Any]) -> tuple[float, float, float]:
    """Start and end of the drawn part (s), and the length of the whole (s)."""
    channels = [(_array(q["time"]), _array(q["measured"])) for q in run["quantities"]]
    times = _finite(
        np.concatenate([*(time for time, _ in channels), _array(run["commands"]["time"])])
    )
    if not len(times):
        return 0.0, 1.0, 1.0
    first, last = float(times.min()), max(float(times.max()), float(times.min()) + 1e-3)
    if last - first <= _LONGEST:
        return first, last, last - first
    starts = np.array(
        [_array(w["time"])[0] for q in run["quantities"] for w in q["windows"] if len(w["time"])]
    )

    def changes(begin: float) -> float:
        spread = sum(
            _spread(measured[(time >= begin) & (time <= begin + _LONGEST)])
            / max(_spread(measured), 1e-9)
            for time, measured in channels
        )
        return float(spread * np.sum((starts >= begin) & (starts <= begin + _LONGEST)))

    begin = max(np.arange(first, last - _LONGEST, _LONGEST / 8).tolist(), key=changes)
    return begin, begin + _LONGEST, last - first


def _draw(run: Mapping[str, Any], begin: float, end: float) -> bytes:
    """The run as PNG: a strip for each quantity, and one for the commands."""
    strips = len(run["quantities"]) + 1
    height = strips * _STRIP_IN + _FOOT_IN
    figure, canvas = new_figure(_WIDTH_IN, height, _DPI)
    for k, quantity in enumerate([*run["quantities"], None]):
        bottom = (_FOOT_IN + (strips - 1 - k) * _STRIP_IN) / height
        axes = figure.add_axes((0.055, bottom, 0.89, (_STRIP_IN - 0.3) / height))
        axes.set_xlim(begin, end)
        dress(axes, 8.5)
        axes.tick_params(labelbottom=quantity is None)
        if quantity is None:
            commands = run["commands"]
            lines = {name: _array(values) for name, values in commands.items()}
            draw_commands(axes, {**lines, "time_s": lines["time"]}, lines["steering_deg"], 8.5)
            title = "commands"
        else:
            time, measured = _array(quantity["time"]), _array(quantity["measured"])
            draw_windows(axes, time, measured, _predictions(quantity, begin, end))
            title = ", ".join(QUANTITIES.get(quantity["name"], (str(quantity["name"]),)))
        # A dollar sign in a name starts no formula.
        axes.set_title(
            title, color=INK, size=9.5, weight="bold", loc="left", pad=4, parse_math=False
        )
        axes.locator_params(axis="y", nbins=4)
    axes.set_xlabel("time, s", color=SOFT, size=8.5)
    file = io.BytesIO()
    canvas.print_png(file)
    return file.getvalue()


def _predictions(quantity: Mapping[str, Any], begin: float, end: float) -> Iterator[Prediction]:
    """The drawn windows, few enough to remain distinct."""
    free = begin
    for window in sorted(quantity["windows"], key=lambda window: min(window["time"], default=0.0)):
        at, simulated = _array(window["time"]), _array(window["simulated"])
        if not len(at) or at[0] < free or at[-1] > end + 1e-9:
            continue
        free = max(float(at[-1]) - 1e-6, float(at[0]) + (end - begin) / _MOST_WINDOWS)
        yield Prediction(at, simulated, _HELD_OUT if window["held_out"] else SIMULATED)


# -------------------------------------------------------------------------------------------------
# Numbers
# -------------------------------------------------------------------------------------------------


def _float(value: Any) -> float:
    """A number; NaN for None."""
    return math.nan if value is None else float(value)


def _array(values: Any) -> Numbers:
    return np.asarray(values, dtype=np.float64)  # None becomes NaN


def _finite(values: Any) -> Numbers:
    values = _array(values)
    return values[np.isfinite(values)]


def _spread(values: Numbers) -> float:
    values = _finite(values)
    return float(np.std(values)) if len(values) > 1 else 0.0


def _digits(value: float, deviation: float) -> tuple[int, int]:
    """The power of ten to factor out of a small number, and decimals that show the deviation."""
    least = next((x for x in (deviation, abs(value) / 100) if math.isfinite(x) and x > 0), 1.0)
    # A deviation that is far larger than the value sets the power: 0.000 ± 0.027.
    largest = max(abs(value), deviation if math.isfinite(deviation) else 0.0)
    power = math.floor(math.log10(largest)) if 0 < largest < 1e-3 else 0
    return power, min(max(1 - math.floor(math.log10(least)) + power, 0), 6)


def _fixed(value: float, decimals: int) -> str:
    if not math.isfinite(value):
        return "–"
    return f"{round(value, decimals) + 0.0:.{decimals}f}".replace("-", "−")  # no minus zero


def _rough(value: float) -> str:
    """A number with two digits."""
    return _fixed(value, min(max(1 - math.floor(math.log10(value)), 0), 4) if value > 0 else 2)
