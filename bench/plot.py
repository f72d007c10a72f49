"""Draws what a run has found: servers, and clients, each as PNG and SVG. Needs the package ``matplotlib``.

    python bench/plot.py RESULT FOLDER

Knows the file of results; measures nothing. The same file gives the same SVG, byte by byte.
"""

import json
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

OURS, BARE, FLOOR, OTHERS = "#1b6ca8", "#9fb8c8", "#c8c8c8", "#d98b3a"
SERVER_SHAPES = ("16 x 16 x 10", "16 x 1 x 10", "50 x 4 x 125")


def colour(name: str) -> str:
    """Ours, the limits, the others."""
    if "busway" in name:
        return OURS
    if "bare loop" in name:
        return BARE
    return FLOOR if "floor" in name else OTHERS


def bars(axes: Any, title: str, figures: Sequence[Mapping[str, Any]]) -> None:
    """One panel: transactions a second, the most at the top, from 0."""
    measured = sorted((one for one in figures if one.get("rate")), key=lambda one: one["rate"])
    names = [re.sub(r"^\s*\d+ x +\d+  ", "", one["name"]) for one in measured]
    rates = [one["rate"] for one in measured]
    axes.barh(range(len(names)), rates, color=[colour(name) for name in names], height=0.7)
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set_title(title, fontsize=10, loc="left")
    for place, rate in enumerate(rates):
        axes.text(rate, place, f" {rate:,.0f}", va="center", fontsize=7)
    axes.margins(x=0.2)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:,.0f} k")
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(axis="x", labelsize=7)


def drawn(panels: Mapping[str, Sequence[Mapping[str, Any]]], title: str, files: Sequence[Path]) -> None:
    """A figure with a row of panels."""
    import matplotlib as mpl

    mpl.use("Agg")
    mpl.rcParams["svg.hashsalt"] = "busway"
    mpl.rcParams["svg.fonttype"] = "none"
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(panels), figsize=(5 * len(panels), 3.6), squeeze=False)
    for each, (name, figures) in zip(axes[0], panels.items(), strict=True):
        bars(each, name, figures)
    figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    figure.tight_layout()
    for file in files:
        figure.savefig(file, dpi=110, metadata={"Date": None} if file.suffix == ".svg" else {"Software": None})
    pyplot.close(figure)


def spaced(text: str) -> str:
    return " ".join(text.split())


def server_panels(tables: Mapping[str, Any]) -> dict[str, list[Mapping[str, Any]]]:
    """One panel for each of the shapes."""
    figures = tables.get("server", {}).get("figures", [])
    panels = {shape: [one for one in figures if spaced(one["shape"]) == shape] for shape in SERVER_SHAPES}
    return {f"{shape} registers": found for shape, found in panels.items() if found}


def client_panels(tables: Mapping[str, Any]) -> dict[str, list[Mapping[str, Any]]]:
    """Batches, single requests, and lock-step, where connections are few."""
    figures = tables.get("client", {}).get("figures", [])
    wanted = (("execute_many", "16 x 16  "), ("await", "1 x 16  "), ("blocking", ""))
    panels = {
        f"{kind} {spaced(shape)}".strip(): [
            one for one in figures if one["shape"] == kind and one["name"].lstrip().startswith(shape)
        ]
        for kind, shape in wanted
    }
    return {title: found for title, found in panels.items() if found}


def main(result: Path, folder: Path) -> None:
    found = json.loads(result.read_text(encoding="utf-8"))
    folder.mkdir(parents=True, exist_ok=True)
    tables = found["tables"]
    for name, panels, what in (
        ("servers", server_panels(tables), "Servers: transactions per second (connections x in flight x registers)"),
        ("clients", client_panels(tables), "Clients: transactions per second (connections x in flight)"),
    ):
        if panels:
            drawn(panels, what, [folder / f"{name}.png", folder / f"{name}.svg"])


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
