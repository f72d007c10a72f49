"""Gateway files: what they may say, what does not go together, each with its line."""

import random
from pathlib import Path

import pytest
from damaged_texts import after_accidents

from busway.apps.gateway.configuration import parse_gateway
from busway.codes import Table
from busway.config.files.file_error import FileError
from busway.config.files.gateway import GatewayFile
from busway.config.files.toml_source import parse_with_source
from busway.errors import ConfigError

GOOD = (Path(__file__).parent / "gateway.toml").read_text(encoding="utf-8")
MUTATIONS = 150

LISTENER = '[[listener]]\nurl = "tcp://127.0.0.1:5020"\n'
LINE = '[[link]]\nname = "hall"\nurl = "tcp://10.0.0.5"\n'
ROUTE = "[[route]]\n"


def problems_of(text: str) -> list[str]:
    """The sentences about a file that cannot be used."""
    with pytest.raises(FileError) as caught:
        parse_with_source(text, GatewayFile, "x.toml")
    return str(caught.value).splitlines()


def test_listeners_lines_and_routes_are_read() -> None:
    file, _ = parse_with_source(GOOD, GatewayFile, "gateway.toml")
    assert [listener.title for listener in file.listener] == ["scada", "plc"]
    assert [line.name for line in file.link] == ["hall", "inverter"]
    assert file.link[0].options() == {"timeout": 0.5, "unit_switch_gap": 0.01}
    assert file.route[1].asked_units() == {1, 2, 4, 5, 6, 7, 8, 9, 10}
    assert file.route[0].asked_functions() == {5, 6, 15, 16, 21, 22, 23}
    assert file.route[2].asked_addresses() == (Table.HOLDING_REGISTERS, 0, 100)
    assert file.gateway.options() == {"own_unit": 254, "drain": 2.5}


def test_a_listener_without_a_name_is_called_by_its_url() -> None:
    file, _ = parse_with_source(LISTENER + LINE, GatewayFile, "x.toml")
    assert file.listener[0].title == "tcp://127.0.0.1:5020"


def test_a_rule_of_the_policy_names_listeners_as_a_route_does_or_by_urls() -> None:
    policy = '[policy]\ndefault = "deny"\n[[policy.rule]]\nlisteners = ["office", "tls://"]\n'
    office = LISTENER + 'name = "office"\n'
    file, _ = parse_with_source(office + LINE + policy, GatewayFile, "x.toml")
    assert file.policy is not None
    (rule,) = file.policy.policy().rules
    assert rule.listeners == ("tcp://127.0.0.1:5020", "tls://")
    (sentence,) = problems_of(office.replace("office", "yard") + LINE + policy)
    assert sentence.startswith("x.toml:10: policy.rule[0].listeners: 'office' is no endpoint")


@pytest.mark.parametrize(
    ("text", "sentences"),
    [
        ("", ["x.toml:1: link: is missing", "x.toml:1: listener: is missing"]),
        (LISTENER, ["x.toml:1: link: is missing"]),
        (LISTENER + LINE + LINE.replace("hall", "other"), ["x.toml:1: route: is missing: there are 2 links"]),
        (
            LISTENER + LINE + ROUTE + 'link = "yard"\n',
            ["x.toml:7: route[0].link: there is no link 'yard', but hall"],
        ),
        (
            LISTENER + LINE + ROUTE + 'link = "hall"\nlisteners = ["office"]\n',
            ["x.toml:8: route[0].listeners[0]: there is no listener 'office', but tcp://127.0.0.1:5020"],
        ),
        (
            LISTENER + LINE + LINE,
            ["x.toml:1: route: is missing: there are 2 links", "x.toml:7: link[1].name: 'hall' is there"],
        ),
        (
            LISTENER + LINE + ROUTE + 'link = "hall"\nrefuse = 3\n',
            ["x.toml:6: route[0]: needs exactly one of link, refuse and drop, and has link and refuse"],
        ),
        (
            LISTENER + LINE + ROUTE + "drop = true\nshift = 5\n",
            ["x.toml:8: route[0].shift: has no effect where nothing is forwarded"],
        ),
        (
            LISTENER + LINE + ROUTE + 'link = "hall"\nunits = "5-3"\n',
            ["x.toml:8: route[0].units: "],
        ),
        (
            LISTENER + LINE + ROUTE + 'link = "hall"\nfunctions = []\n',
            ["x.toml:8: route[0].functions: is empty, so the route would take no request"],
        ),
        (
            LISTENER + LINE + ROUTE + 'link = "hall"\ntable = "holding"\n',
            ["x.toml:6: route[0].addresses: is missing: a table is named, and no addresses of it"],
        ),
        (
            LISTENER + LISTENER + LINE,
            ["x.toml:3: listener[1].name: ", "x.toml:4: listener[1].url: tcp://127.0.0.1:5020 is taken by"],
        ),
        (
            LISTENER + LINE.replace("link", "line"),
            ["x.toml:3: line: unknown key; is it link?"],
        ),
        (
            LISTENER + LINE + ROUTE + 'line = "hall"\n',
            ["x.toml:7: route[0].line: unknown key; is it link?"],
        ),
        (LISTENER + LINE + "deadline = 3\n", ["x.toml:6: link[0].deadline: has no effect on a link of a gateway"]),
        (
            LISTENER + LINE + "[server]\nunlisted = 'silence'\n",
            ["x.toml:7: server.unlisted: has no effect: a gateway has"],
        ),
        (LISTENER + LINE + "[server]\nshared_slots = true\n", ["x.toml:7: server.shared_slots: has no effect: each"]),
        (
            LISTENER + "answer_half_closed = true\n" + LINE + "[server]\nanswer_half_closed = true\n",
            [
                "x.toml:3: listener[0].answer_half_closed: has no effect: a client that ends its half",
                "x.toml:8: server.answer_half_closed: has no effect: a client that ends its half",
            ],
        ),
        (LISTENER + LINE + "[[unit]]\nunit = 1\n", ["x.toml:6: unit: a gateway has no units of its own"]),
        (
            '[[listener]]\nurl = "rtu:///dev/x"\nname = "plc"\nsilent_broadcasts = true\n' + LINE,
            ["x.toml:4: listener[0].silent_broadcasts: has no effect on a serial line"],
        ),
        (LISTENER + LINE + "[gateway]\nown_unit = 0\n", ["x.toml:7: gateway.own_unit: must be 1…255, not 0"]),
    ],
)
def test_what_cannot_be_is_said_with_its_line(text: str, sentences: list[str]) -> None:
    found = problems_of(text)
    assert len(found) == len(sentences)
    for line, sentence in zip(found, sentences, strict=True):
        assert line.startswith(sentence)


@pytest.mark.clause("T33")
@pytest.mark.parametrize("seed", range(MUTATIONS))
def test_a_damaged_file_gives_sentences_and_never_a_traceback(seed: int) -> None:
    text = after_accidents(GOOD, random.Random(seed))
    problems: tuple[ConfigError, ...] = ()
    try:
        problems = parse_gateway(text, "x.toml").warnings
    except FileError as error:
        problems = error.problems
    for problem in problems:
        assert problem.file == "x.toml"
        assert problem.line is not None
        assert 1 <= problem.line <= text.count("\n") + 1
        assert "\n" not in str(problem)


def test_the_good_file_is_good() -> None:
    assert len(parse_gateway(GOOD, "x.toml").routes) == 4
