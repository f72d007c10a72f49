"""The table of rights on the page of NATS servers is that of the data from which the servers' files are made."""

from pathlib import Path

from busway.apps.fleet.server_rights import rights_table

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "nats-servers-of-a-fleet.md"


def test_the_page_has_the_rights_that_the_files_grant() -> None:
    _, _, rest = PAGE.read_text(encoding="utf-8").partition("<!-- rights -->\n\n")
    table, _, _ = rest.partition("\n<!-- end of rights -->")
    assert table == rights_table("hall"), f"replace the table by\n\n{rights_table('hall')}"
