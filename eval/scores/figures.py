"""From records of single pairs or objects to figures with denominators, failures and intervals over scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from scipy import stats
from scipy.special import logit

from eval.scores.average_precision import ap_of_rows
from eval.scores.reliability import calibration_error, error_by_chance

Record = dict[str, Any]  # one pair, object or scan pair; None stands for a failure
Column = Literal["paper", "published", "strict", ""]
COLUMNS: tuple[Column, ...] = ("paper", "published", "strict")
DRAWS = 500  # of the bootstrap over scenes
MEAN_DRAWS = 2000  # of the bootstrap of a mean


@dataclass(frozen=True, kw_only=True)
class Figure:
    """How one number of a table comes from records. `statistic` says what failures (None) are worth:

    `share`: of all records, those with `key` below `limit`; a failure is not.
    `at_least`: of all records, those with `key` at `limit` or more; a failure is not.
    `mean`: of the records that have a value. `median`: of all; a failure is worse than any value.
    `ratio`: the sum of `key` over the sum of `over`.
    `average_precision`: of the predictions of all scenes together; `key` holds the `ap_rows` of one.
    `calibration`: the expected calibration error of probabilities (`key`) of what is so or not (`over`: 1 or 0).
    `chance`: what that would be, by chance, if they were true.
    """

    name: str
    key: str
    statistic: Literal[
        "share", "at_least", "mean", "median", "ratio", "average_precision", "calibration", "chance"
    ]
    column: Column = ""
    unit: str = ""
    better: Literal["higher", "lower"] = "higher"
    limit: float = 0.0
    scale: float = 1.0
    over: str = ""
    successes: tuple[str, float] | None = None  # only records whose value of this key is below


def in_columns(figure: Figure) -> list[Figure]:
    """The figure once for each column: its key with the column's name after a dot."""
    return [replace(figure, key=f"{figure.key}.{c}", column=c) for c in COLUMNS]


@dataclass(frozen=True, kw_only=True)
class Row:
    """One figure of one method on one group of records: a line of results.json."""

    name: str
    value: float | None
    unit: str
    better: str
    count: int  # the denominator
    failures: int
    ci95: tuple[float, float] | None
    method: str
    column: str
    group: str
    scenes: int


def figure_row(
    figure: Figure, by_scene: Mapping[str, Sequence[Record]], method: str, group: str
) -> Row | None:
    """One row, or None where no record has the figure's key (it is not defined for this data)."""
    arrays = [a for a in (values_of(figure, records) for records in by_scene.values()) if len(a)]
    if not arrays:
        return None
    pooled = np.concatenate(arrays)
    value = reduce(figure, pooled)
    without = int(np.isnan(pooled[:, 0]).sum())
    counts = {"ratio": int(pooled[:, 1].sum()), "average_precision": without}
    return Row(
        name=figure.name,
        value=value * figure.scale if np.isfinite(value) else None,
        unit=figure.unit,
        better=figure.better,
        count=counts.get(figure.statistic, len(pooled)),
        failures=0 if figure.statistic == "average_precision" else without,
        ci95=interval(figure, arrays),
        method=method,
        column=figure.column,
        group=group,
        scenes=len(arrays),
    )


def values_of(figure: Figure, records: Sequence[Record]) -> np.ndarray:
    """(n, 2): the value (NaN: failure) and, of a ratio, what it is divided by. Of an average precision: `ap_rows`."""
    kept = [r for r in records if figure.key in r]
    if figure.statistic == "average_precision":
        return np.array([row for r in kept for row in r[figure.key]], float)
    if figure.successes:
        key, limit = figure.successes
        kept = [r for r in kept if r[key] is not None and r[key] < limit]
    rows = [(_number(r[figure.key]), float(r[figure.over]) if figure.over else 1.0) for r in kept]
    return np.array(rows, float).reshape(-1, 2)


def _number(value: float | bool | None) -> float:
    return float("nan") if value is None else float(value)


def parts(figure: Figure, rows: np.ndarray) -> tuple[float, float]:
    """Numerator and denominator of a statistic that is a quotient of sums: all but the median."""
    values = rows[:, 0]
    if figure.statistic == "share":
        return float((values < figure.limit).sum()), len(values)
    if figure.statistic == "at_least":
        return float((values >= figure.limit).sum()), len(values)
    if figure.statistic == "mean":
        return float(np.nansum(values)), float((~np.isnan(values)).sum())
    return float(np.nansum(values)), float(rows[:, 1].sum())


def reduce(figure: Figure, rows: np.ndarray) -> float:
    """The statistic of pooled rows; NaN of nothing."""
    if figure.statistic == "average_precision":
        return ap_of_rows(rows)
    if figure.statistic == "calibration":
        return calibration_error(logit(rows[:, 0]), rows[:, 1] > 0)
    if figure.statistic == "chance":
        return error_by_chance(logit(rows[:, 0]))
    if figure.statistic == "median":
        return _median(rows[:, 0], worst=np.inf if figure.better == "lower" else -np.inf)
    above, below = parts(figure, rows)
    return above / below if below else float("nan")


def _median(values: np.ndarray, worst: float) -> float:
    """The upper of the two middle values where one is a failure: half a failure is one."""
    filled = np.sort(np.where(np.isnan(values), worst, values))
    low, high = filled[(len(filled) - 1) // 2], filled[len(filled) // 2]
    return float((low + high) / 2) if np.isfinite(low) and np.isfinite(high) else worst


def interval(figure: Figure, arrays: Sequence[np.ndarray]) -> tuple[float, float] | None:
    """95 % interval by resampling whole scenes; None of one scene, of `chance`, or where a bound is a failure."""
    if len(arrays) < 2 or figure.statistic == "chance":
        return None
    index = np.random.default_rng(0).integers(0, len(arrays), (DRAWS, len(arrays)))
    if figure.statistic in ("median", "average_precision", "calibration"):
        draws = np.array([reduce(figure, np.concatenate([arrays[k] for k in row])) for row in index])
    else:
        above, below = np.array([parts(figure, a) for a in arrays]).T
        with np.errstate(invalid="ignore"):
            draws = above[index].sum(axis=1) / below[index].sum(axis=1)
    if not np.isfinite(draws).all():
        return None
    low, high = np.quantile(draws, [0.025, 0.975]) * figure.scale
    return float(low), float(high)


def mean_ci95(values: Sequence[float] | Float[np.ndarray, " n"]) -> tuple[float, float]:
    """95 % interval of the mean by resampling: the value itself of one, NaN of nothing."""
    data = np.asarray(values, float)
    if len(data) < 2:
        bound = float(data[0]) if len(data) else float("nan")
        return bound, bound
    rng = np.random.default_rng(0)
    found = stats.bootstrap((data,), np.mean, n_resamples=MEAN_DRAWS, method="percentile", rng=rng)
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def rows_of(
    figures: Sequence[Figure],
    records: Mapping[str, Sequence[Record]],
    groups: Sequence[str] = (),
) -> list[Row]:
    """Every figure of every method, over all records and by the keys named in `groups` (category, scan pair…)."""
    methods = dict.fromkeys(r["method"] for rows in records.values() for r in rows)
    found: list[Row] = []
    for method in methods:
        own = {s: [r for r in rows if r["method"] == method] for s, rows in records.items()}
        found += _rows(figures, own, method, "all")
        for key in groups:
            values = sorted({str(r[key]) for rows in own.values() for r in rows if r.get(key) is not None})
            for value in values:
                part = {s: [r for r in rows if str(r.get(key)) == value] for s, rows in own.items()}
                found += _rows(figures, part, method, f"{key} {value}")
    return found


def _rows(
    figures: Sequence[Figure], records: Mapping[str, Sequence[Record]], method: str, group: str
) -> list[Row]:
    rows = [figure_row(f, {s: r for s, r in records.items() if r}, method, group) for f in figures]
    return [r for r in rows if r is not None]
