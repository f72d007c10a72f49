"""`busway policy`: what is permitted, the rule that permits it, and which rules there are, without a server."""

import json

import pytest

POLICY = """\
[policy]
default = "deny"
allow = ["10.0.0.0/8", "fe80::/10"]
deny = ["10.6.6.6"]

[[policy.rule]]
name = "interlocks"
action = "deny"
addresses = "4x101-4x110"
code = 2

[[policy.rule]]
name = "operators"
roles = ["operator"]
units = "1-5,7"
functions = ["read", "write", "8/1"]
values = { max = 1000 }
rate = 20

[[policy.rule]]
name = "near"
listeners = ["tls://"]
action = "read-only"
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "policy.toml"
    path.write_text(POLICY)
    return str(path)


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (
            ["--peer", "10.0.0.7", "--role", "operator", "--request", "write 4x100 5"],
            0,
            "allowed: write 4x100 5: by 'operators', at most 20 a second by 'operators'\n",
        ),
        (
            ["--peer", "10.0.0.7", "--request", "write 4x100 5"],
            4,
            "refused: write 4x100 5: by default: it is not permitted; exception 01 (illegal function)\n",
        ),
        (
            ["--peer", "10.0.0.7", "--listener", "tls://0.0.0.0", "--request", "write 4x100 5"],
            4,
            "refused: write 4x100 5: by 'near': writing is not permitted; exception 01 (illegal function)\n",
        ),
        (
            ["--peer", "10.0.0.7", "--listener", "tls://", "--request", "read 4x95 10"],
            4,
            "refused: read 4x95 10: by 'interlocks': it is not permitted; exception 02 (illegal data address)\n",
        ),
        (
            ["--peer", "10.0.0.7", "--listener", "tls://", "--request", "read 4x95"],
            0,
            "allowed: read 4x95: by 'near'\n",
        ),
        (
            ["--peer", "::ffff:10.6.6.6", "--request", "read 4x1"],
            4,
            "refused: 10.6.6.6 may not connect: denied by 10.6.6.6\n",
        ),
        (
            ["--peer", "192.168.0.1", "--request", "read 4x1"],
            4,
            "refused: 192.168.0.1 may not connect: not listed, in secure mode\n",
        ),
        (
            ["--peer", "fe80::1%eth0", "--role", "operator", "--unit", "6", "--request", "read 4x1"],
            4,
            "refused: read 4x1: by default: it is not permitted; exception 01 (illegal function)\n",
        ),
        (
            ["--peer", "10.0.0.7", "--role", "operator", "--request", "08 00 01 00 00"],
            0,
            "allowed: 08 00 01 00 00: by 'operators', at most 20 a second by 'operators'\n",
        ),
        (
            ["--peer", "10.0.0.7", "--role", "operator", "--request", "write 4x1 1001 5"],
            4,
            "refused: write 4x1 1001 5: by 'operators': a value outside 0…1000; exception 01 (illegal function)\n",
        ),
        (
            ["--peer", "10.0.0.7", "--role", "operator", "--request", "mask 4x1 0xFF00 1"],
            4,
            "refused: mask 4x1 0xFF00 1: by 'operators': the masks may give a value outside 0…1000;"
            " exception 01 (illegal function)\n",
        ),
    ],
)
@pytest.mark.clause("T15", "M6")
def test_a_request_is_judged_as_a_server_would(run, file, arguments, code, said):
    result = run("policy", "test", file, *arguments)
    assert (result.code, result.out) == (code, said)


def test_several_requests_are_refused_if_one_is(run, file):
    who = ["--peer", "10.0.0.7", "--role", "operator"]
    requests = ["write 0x1 on off", "write 4x1.3 on", "write 4x7 -5", "0600630005", "read 1x1 2000"]
    result = run("policy", "test", file, *who, *(word for each in requests for word in ("--request", each)))
    assert [line.split(":")[0] for line in result.out.splitlines()] == [
        "allowed",
        "refused",
        "refused",
        "allowed",
        "allowed",
    ]
    assert result.code == 4


def test_answers_as_json(run, file):
    result = run(
        "policy", "test", file, "--peer", "10.0.0.7", "--request", "read 4x101", "--request", "read 4x1", "--json"
    )
    assert [json.loads(line) for line in result.out.splitlines()] == [
        {
            "request": "read 4x101",
            "allowed": False,
            "connected": True,
            "code": 2,
            "rule": "interlocks",
            "why": "it is not permitted",
        },
        {
            "request": "read 4x1",
            "allowed": False,
            "connected": True,
            "code": 1,
            "rule": "default",
            "why": "it is not permitted",
        },
    ]
    result = run("policy", "test", file, "--peer", "11.0.0.7", "--request", "read 4x101", "--json")
    assert json.loads(result.out)["connected"] is False


def test_check_shows_the_rules_as_they_were_understood(run, file):
    result = run("policy", "check", file)
    assert result.code == 0
    assert result.out == (
        "deny    10.6.6.6\n"
        "allow   10.0.0.0/8, fe80::/10\n"
        "others  may not connect\n"
        "\n"
        "interlocks  deny       addresses 4x101-4x110; code 2\n"
        "operators   allow      roles operator; units 1-5, 7;"
        " functions 1, 2, 3, 4, 5, 6, 8/1, 15, 16, 20, 21, 22, 23, 24; values 0…1000; rate 20/s\n"
        "near        read-only  listeners tls://\n"
        "default     deny\n"
    )


def test_check_as_json(run, file):
    lines = [json.loads(line) for line in run("policy", "check", file, "--json").out.splitlines()]
    assert lines[0] == {"allow": ["10.0.0.0/8", "fe80::/10"], "deny": ["10.6.6.6"], "secure": True}
    assert lines[1] == {"rule": "interlocks", "action": "deny", "addresses": "4x101-4x110", "code": "2"}
    assert lines[-1] == {"rule": "default", "action": "deny"}


def test_other_facts_of_rules_are_shown_in_their_notation(run, tmp_path):
    path = tmp_path / "p.toml"
    path.write_text(
        '[policy]\ndefault = "allow"\n'
        '[[policy.rule]]\npeers = ["::1"]\ntable = "coil"\nfiles = "1-4,9"\naccess = "write"\n'
        '[[policy.rule]]\naddresses = "3x7"\n'
    )
    out = run("policy", "check", str(path)).out
    assert "rule 1   allow  peers ::1; addresses 0x1-0x65536; files 1-4, 9; access write\n" in out
    assert "rule 2   allow  addresses 3x7\n" in out


def test_a_configuration_file_with_a_policy_will_do(run, tmp_path):
    path = tmp_path / "plant.toml"
    path.write_text('policy = "read-only"\n[[unit]]\nunit = 1\nholding_registers = 10\n')
    assert run("policy", "test", str(path), "--peer", "10.0.0.7", "--request", "read 4x1").code == 0
    assert run("policy", "test", str(path), "--peer", "10.0.0.7", "--request", "write 4x1 1").code == 4
    path.write_text("[[unit]]\nunit = 1\nholding_registers = 10\n")
    result = run("policy", "check", str(path))
    assert (result.code, result.err) == (2, f"{path}: there is no policy in it\n")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["prove", "FILE"], "ACTION: must be test or check, not 'prove'"),
        (["test", "FILE", "--request", "read 4x1"], "--peer: test needs the address of a client"),
        (["test", "FILE", "--peer", "10.0.0.7"], "--request: test needs a request"),
        (["test", "FILE", "--peer", "host", "--request", "read 4x1"], "--peer: 'host' is no address"),
        (["test", "FILE", "--peer", "10.0.0.0/8", "--request", "read 4x1"], "--peer: one address is needed"),
        (["test", "FILE", "--peer", "10.0.0.7", "--request", "reed 4x1"], "--request: 'reed 4x1' is neither"),
        (
            ["test", "FILE", "--peer", "10.0.0.7", "--request", "read"],
            "--request: 'read': an address and perhaps a count",
        ),
        (["test", "FILE", "--peer", "10.0.0.7", "--request", "read 4x1 126"], "--request: 'read 4x1 126': "),
        (
            ["test", "FILE", "--peer", "10.0.0.7", "--request", "write 4x1"],
            "--request: 'write 4x1': an address and a value",
        ),
        (["test", "FILE", "--peer", "10.0.0.7", "--request", "write 3x1 5"], "--request: 'write 3x1 5': "),
        (
            ["test", "FILE", "--peer", "10.0.0.7", "--request", "mask 4x1 5"],
            "--request: 'mask 4x1 5': an address, the AND",
        ),
        (["test", "FILE", "--peer", "10.0.0.7", "--request", "83 01"], "--request: '83 01' is no request"),
        (
            ["test", "FILE", "--peer", "10.0.0.7", "--request", "read 4x1", "--unit", "256"],
            "--unit: a whole number 0…255",
        ),
        (
            ["test", "FILE", "--peer", "10.0.0.7", "--request", "read 4x1", "--listener", "x"],
            "listeners: 'x' is no endpoint",
        ),
        (["check", "FILE", "--peer", "10.0.0.7"], "--peer: is for test"),
    ],
)
def test_wrong_use_is_one_sentence(run, file, arguments, said):
    result = run("policy", *(file if each == "FILE" else each for each in arguments))
    assert result.code == 2
    assert result.err.startswith(f"busway: {said}")
    assert result.err.count("\n") == 1


def test_a_file_that_is_wrong_is_said_with_its_line(run, tmp_path):
    path = tmp_path / "p.toml"
    path.write_text('[policy]\ndefault = "deny"\n[[policy.rule]]\nunits = 999\n')
    result = run("policy", "check", str(path))
    assert (result.code, result.err) == (2, f"{path}:4: policy.rule[0].units: a unit is 0…255, not 999\n")


def test_check_warns_of_rules_that_an_earlier_rule_hides(run, tmp_path):
    path = tmp_path / "policy.toml"
    hidden = '[[policy.rule]]\nname = "interlock"\naction = "deny"\naddresses = "4x101-4x110"\n'
    path.write_text('[policy]\ndefault = "deny"\n\n[[policy.rule]]\nname = "readers"\n\n' + hidden)
    result = run("policy", "check", str(path))
    assert result.code == 0
    assert "interlock  deny   addresses 4x101-4x110" in result.out
    assert result.err == (
        f"{path}:7: policy.rule[1]: warning: 'interlock' never decides: 'readers' before it takes all its requests\n"
    )


def test_check_warns_of_twenty_hidden_rules_and_counts_the_others(run, tmp_path):
    path = tmp_path / "policy.toml"
    path.write_text('[policy]\ndefault = "deny"\n' + "[[policy.rule]]\n" * 31)
    lines = run("policy", "check", str(path)).err.splitlines()
    assert len(lines) == 21
    assert lines[-1] == f"{path}:24: policy.rule[21]: warning: 10 rules from here on never decide"
