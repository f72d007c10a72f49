"""No file imports itself by way of others, not even inside a function or for typing: a reader can begin at the bottom.

import-linter holds the rooms apart (pyproject.toml); this test looks at single files.
"""

import grimp

import busway


def circles(graph: grimp.ImportGraph) -> set[frozenset[str]]:
    """The sets of files that import each other in a circle."""
    reached = {module: graph.find_upstream_modules(module) for module in graph.modules}
    found = {
        frozenset({module, *(other for other in reached[module] if module in reached[other])})
        for module in graph.modules
    }
    return {one for one in found if len(one) > 1}


def test_files_import_each_other_in_no_circle() -> None:
    graph = grimp.build_graph(busway.__name__, cache_dir=None, exclude_type_checking_imports=False)
    assert len(graph.modules) > 200
    assert circles(graph) == set()


def test_circle_is_found_whatever_leads_into_it_and_out_of_it() -> None:
    graph = grimp.ImportGraph()
    for importer, imported in (("a", "b"), ("b", "c"), ("c", "b"), ("c", "d")):
        graph.add_import(importer=importer, imported=imported)
    assert circles(graph) == {frozenset({"b", "c"})}
