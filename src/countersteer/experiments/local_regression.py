"""Linear regression in regions: a line over x in each region of v.

The bounds of k regions are those of least squares (by dynamic programming over quantiles of v).
Cross-validation chooses k. It is the smallest k whose squared error on held-out turns is within one
standard error of the least (Hastie, Tibshirani and Friedman, The Elements of Statistical Learning,
7.10). Predictions interpolate the lines between the regions' medians of v, as in later use.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

LEAST = 15  # fewest points for a line
MOST = 6  # regions
CUTS = 24  # quantiles of v at which a bound may lie
FOLDS = 10


class Line(NamedTuple):
    """y = offset + slope x in one region; errors are standard errors."""

    low: float  # of v
    middle: float
    high: float
    points: int
    offset: float
    slope: float
    offset_error: float
    slope_error: float
    deviation: float  # of the residuals
    explained: float  # share of the variance


class Local(NamedTuple):
    """The chosen regions, and the errors behind the choice."""

    lines: tuple[Line, ...]
    error: dict[int, float]  # cross-validated rms of y, by number of regions
    error_deviation: dict[int, float]  # standard error of its square


def fit(v: np.ndarray, x: np.ndarray, y: np.ndarray) -> Local:
    """Choose regions and fit their lines. Needs `LEAST` points or more, in any order."""
    fold = np.random.default_rng(0).permutation(len(v)) % FOLDS
    most = min(MOST, len(v) // LEAST)
    error, deviation = {}, {}
    for count in range(1, most + 1):
        squares = np.full(len(v), math.nan)
        for held in range(FOLDS):
            out = fold == held
            bounds = _bounds(v[~out], x[~out], y[~out], count)
            if bounds is not None:
                lines = regress(v[~out], x[~out], y[~out], bounds)
                squares[out] = (y[out] - predicted(lines, v[out], x[out])) ** 2
        if np.all(np.isfinite(squares)):
            error[count] = float(np.sqrt(np.mean(squares)))
            deviation[count] = float(np.std(squares) / math.sqrt(len(v)))
    best = min(error, key=lambda count: error[count])
    enough = next(k for k in error if error[k] ** 2 <= error[best] ** 2 + deviation[best])
    bounds = _bounds(v, x, y, enough)
    return Local(regress(v, x, y, bounds if bounds is not None else []), error, deviation)


def bounds_of(local: Local) -> list[float]:
    """The speeds between the regions."""
    return [line.low for line in local.lines[1:]]


def regress(v: np.ndarray, x: np.ndarray, y: np.ndarray, bounds: list[float]) -> tuple[Line, ...]:
    """A line in each of the regions between the bounds."""
    region = np.searchsorted(bounds, v, side="right")
    lines = []
    for number in range(len(bounds) + 1):
        own = region == number
        vs, xs, ys = v[own], x[own], y[own]
        spread = max(float(np.sum((xs - xs.mean()) ** 2)), 1e-12)
        slope = float(np.sum((xs - xs.mean()) * (ys - ys.mean()))) / spread
        offset = float(ys.mean() - slope * xs.mean())
        left = ys - offset - slope * xs
        deviation = math.sqrt(float(np.sum(left**2)) / max(len(xs) - 2, 1))
        total = float(np.sum((ys - ys.mean()) ** 2))
        lines.append(
            Line(
                float(bounds[number - 1] if number else vs.min()),
                float(np.median(vs)),
                float(bounds[number] if number < len(bounds) else vs.max()),
                len(xs),
                offset,
                slope,
                deviation * math.sqrt(1 / len(xs) + float(xs.mean()) ** 2 / spread),
                deviation / math.sqrt(spread),
                deviation,
                1 - float(np.sum(left**2)) / total if total else 0.0,
            )
        )
    return tuple(lines)


def predicted(lines: tuple[Line, ...], v: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The prediction of y by the lines, interpolated between the regions' middles."""
    middles = [line.middle for line in lines]
    offset = np.interp(v, middles, [line.offset for line in lines])
    slope = np.interp(v, middles, [line.slope for line in lines])
    return offset + slope * x


def _bounds(v: np.ndarray, x: np.ndarray, y: np.ndarray, count: int) -> list[float] | None:
    """The bounds of `count` regions with the least sum of squares; None for too few points."""
    order = np.argsort(v, kind="stable")
    v, x, y = v[order], x[order], y[order]
    cuts = np.unique(np.round(np.linspace(0, len(v), CUTS + 1)).astype(int))
    columns = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    sums = np.concatenate([np.zeros((6, 1)), np.cumsum(columns, axis=1)], axis=1)[:, cuts]

    def cost(a: int, b: int) -> float:
        n, sx, sy, sxx, sxy, syy = sums[:, b] - sums[:, a]
        if n < LEAST:
            return math.inf
        spread = max(sxx - sx * sx / n, 1e-12)
        return max(syy - sy * sy / n - (sxy - sx * sy / n) ** 2 / spread, 0.0)

    ends = range(len(cuts))
    least = {0: (0.0, [0])}  # by the last cut: cost, and the cuts so far
    for _ in range(count):
        step: dict[int, tuple[float, list[int]]] = {}
        for b in ends[1:]:
            ways = [(least[a][0] + cost(a, b), a) for a in least if a < b]
            total, a = min(ways, default=(math.inf, 0))
            if total < math.inf:
                step[b] = (total, [*least[a][1], b])
        least = step
    if ends[-1] not in least:
        return None
    return [float((v[cuts[c] - 1] + v[cuts[c]]) / 2) for c in least[ends[-1]][1][1:-1]]


def in_regions(lines: Sequence[Line], v: np.ndarray) -> np.ndarray:
    """The index of each point's region."""
    return np.searchsorted([line.low for line in lines[1:]], v, side="right")


def paint_stops(
    figure: Any,
    time: Sequence[Line],
    angle: Sequence[Line],
    speed: np.ndarray,
    rate: np.ndarray,
    times: np.ndarray,
    angles: np.ndarray,
) -> None:
    """Draw time and angle to the stop over the yaw rate, with a colour and a line for each region.

    Arguments are in SI units and rad, the drawing is in degrees.
    """
    import matplotlib

    axes = figure.subplots(1, 2, sharex=True)
    colours = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.85, len(angle)))
    region = in_regions(angle, speed)
    for ax, lines, values, factor, label in (
        (axes[0], time, times, 1.0, "time to stop, s"),
        (axes[1], angle, angles, math.degrees(1), "angle turned until stopped, °"),
    ):
        for number, (line, colour) in enumerate(zip(lines, colours, strict=True)):
            own = region == number
            span = np.array([rate[own].min(), rate[own].max()])
            ax.plot(np.degrees(rate[own]), factor * values[own], ".", color=colour, ms=4, alpha=0.4)
            ax.plot(
                np.degrees(span),
                factor * (line.offset + line.slope * span),
                color=colour,
                lw=2,
                label=f"{line.low:.2f} to {line.high:.2f} m/s ({line.points})",
            )
        ax.set_xlabel("yaw rate at the kill, °/s")
        ax.set_ylabel(label)
    axes[1].legend(frameon=False, fontsize=8, title="forward speed (turns)", title_fontsize=8)
