"""Draw docs/figures/read-plan.svg: six values of a meter, and the reads by three rules, with what they cost."""

from pathlib import Path

from busway.apps.collector.cost import baud_cost
from busway.apps.collector.plan import PlainItem, ReadRules, plan_reads
from busway.codes import Table

TARGET = Path(__file__).parents[1] / "docs" / "figures" / "read-plan.svg"
REGISTER = 15
LEFT, TOP, ROW = 170, 52, 46
STARTS = (0, 2, 4, 10, 42, 44)
WIDTH = 2


def rows() -> list[tuple[str, list[tuple[int, int]], float]]:
    """A rule, its reads as first register and number, and milliseconds at 9600 baud."""
    cost = baud_cost(9600)
    items = [PlainItem(Table.INPUT_REGISTERS, start, WIDTH, start) for start in STARTS]
    plan = plan_reads(items, ReadRules(bridge=True), cost)
    by_rule = [
        ("one read each", [(start, WIDTH) for start in STARTS]),
        ("what touches", [(0, 6), (10, 2), (42, 4)]),
        ("all with one read", [(0, 46)]),
        ("the plan", [(read.start, read.width) for read in plan.reads]),
    ]
    return [
        (name, reads, 1000 * sum(cost.of(Table.INPUT_REGISTERS, width) for _, width in reads))
        for name, reads in by_rule
    ]


def figure() -> str:
    """The figure as SVG."""
    lines = rows()
    width, height = LEFT + 46 * REGISTER + 110, TOP + ROW * (len(lines) + 1)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}"',
        'font-family="sans-serif" font-size="14">',
        "<title>Reads of six values by four rules, and what they cost at 9600 baud</title>",
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
        f'<text x="10" y="{TOP - 14}" fill="#333">registers</text>',
    ]
    for register in range(46):
        wanted = any(start <= register < start + WIDTH for start in STARTS)
        fill = "#2f6f9f" if wanted else "#e6e6e6"
        x = LEFT + register * REGISTER
        parts.append(f'<rect x="{x}" y="{TOP - 28}" width="{REGISTER - 2}" height="18" fill="{fill}"/>')
        if register % 10 == 0:
            parts.append(f'<text x="{x}" y="{TOP - 32}" font-size="11" fill="#666">{register}</text>')
    for number, (name, reads, milliseconds) in enumerate(lines):
        y = TOP + ROW * number + 12
        best = number == len(lines) - 1
        weight, stroke = ("bold", "#b3541e") if best else ("normal", "#666")
        parts.append(f'<text x="10" y="{y + 17}" fill="#333" font-weight="{weight}">{name}</text>')
        for start, count in reads:
            x, span = LEFT + start * REGISTER, count * REGISTER - 2
            parts.append(f'<rect x="{x}" y="{y}" width="{span}" height="24" rx="4" fill="none"')
            parts.append(f'stroke="{stroke}" stroke-width="2"/>')
        parts.append(f'<text x="{width - 95}" y="{y + 17}" fill="#333">{milliseconds:.0f} ms</text>')
    return "\n".join([*parts, "</svg>", ""])


if __name__ == "__main__":
    TARGET.write_text(figure(), encoding="utf-8")
