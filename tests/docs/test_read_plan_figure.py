"""The figure of the read plan is the one that the planner's own figures give."""

import importlib.util
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_figure_is_up_to_date_and_the_plan_is_the_cheapest_of_its_rules() -> None:
    spec = importlib.util.spec_from_file_location("read_plan_figure", ROOT / "scripts" / "read_plan_figure.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    assert script.TARGET.read_text(encoding="utf-8") == script.figure()
    *others, (name, _, best) = script.rows()
    assert name == "the plan"
    assert all(best < milliseconds for _, _, milliseconds in others)
