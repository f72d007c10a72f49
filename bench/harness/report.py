"""Tables and bars: what a table module hands back, how it is printed, how it is kept.

A bar is a wish of the project about one figure, most often a ratio of two contenders in the same run. It is reported as
`ok`, `missed` or `not measured` (a peer or a compiler is not there) and never hidden.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Literal

from harness.measure import Series, spread


@dataclass(frozen=True, slots=True)
class Bar:
    """One wish: `value` must be at least (or at most) `limit`; a value of None was not measured."""

    what: str
    value: float | None
    relation: Literal[">=", "<="]
    limit: float
    unit: str = "x"

    @property
    def verdict(self) -> str:
        if self.value is None:
            return "not measured"
        reached = self.value >= self.limit if self.relation == ">=" else self.value <= self.limit
        return "ok" if reached else "missed"

    def line(self) -> str:
        value = "–" if self.value is None else figure(self.value)
        sign = "≥" if self.relation == ">=" else "≤"
        return f"{self.verdict:<12}  {self.what:<66} {value:>9} {self.unit:<4} ({sign} {figure(self.limit)})"


@dataclass(slots=True)
class Table:
    """A printed table: `rows` hold text as shown, `figures` the numbers behind it for the file of results."""

    title: str
    columns: Sequence[str]
    rows: list[Sequence[str]] = field(default_factory=list)
    figures: list[dict[str, object]] = field(default_factory=list)
    bars: list[Bar] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def text(self) -> str:
        widths = [max(len(row[index]) for row in [self.columns, *self.rows]) for index in range(len(self.columns))]

        def line(cells: Sequence[str]) -> str:
            first, *others = (
                cell.rjust(width) if index else cell.ljust(width)
                for index, (cell, width) in enumerate(zip(cells, widths, strict=True))
            )
            return "  ".join([first, *others]).rstrip()

        ruler = "  ".join("-" * width for width in widths)
        parts = ["", f"== {self.title}", "", line(self.columns), ruler, *(line(row) for row in self.rows)]
        parts += [f"   {note}" for note in self.notes]
        if self.bars:
            parts += ["", *(bar.line() for bar in self.bars)]
        return "\n".join(parts)

    def kept(self) -> dict[str, object]:
        """What goes into the file of results."""
        return {
            "title": self.title,
            "columns": self.columns,
            "rows": self.rows,
            "figures": self.figures,
            "bars": [asdict(bar) | {"verdict": bar.verdict} for bar in self.bars],
            "notes": self.notes,
        }


RATE_COLUMNS = ("", "per second", "± %", "CPU µs each", "p50 µs", "p99 µs", "p99.9 µs")


def add_rates(table: Table, shape: str, series: Series) -> None:
    """Adds the row of one contender to a table with RATE_COLUMNS; `shape` says what was asked of it."""
    label = f"{shape}  {series.name}"
    if not series.samples:
        table.rows.append((label, "–", *[""] * (len(RATE_COLUMNS) - 2)))
        table.figures.append({"shape": shape, "name": series.name, "missing": series.missing})
        return
    quantities = ("cpu", "p50", "p99", "p999")
    off = spread(series.values("rate"))
    table.rows.append(
        (
            label,
            f"{series.median('rate'):,.0f}",
            "" if off is None else f"{off:.0f}",
            *("" if (value := series.median(quantity)) is None else figure(value) for quantity in quantities),
        )
    )
    table.figures.append(
        {"shape": shape, "name": series.name, "rounds": [asdict(sample) for sample in series.samples]}
        | {quantity: series.median(quantity) for quantity in ("rate", *quantities)}
    )


def figure(value: float) -> str:
    """A number with three digits that matter, thousands grouped."""
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"
