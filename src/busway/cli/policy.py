"""``busway policy``: tells what a policy permits, and lists its rules, without a server.

1. ``test`` decides as a server does: first whether the host may connect, then by the rules. If the decision depends on
   the old value of a register (function 22 under limits), it is that of a gateway, which cannot read the register.
2. Exit code 0: allowed; 4: refused.
3. The file is a policy file, or a configuration or gateway file that has a policy.
4. ``check`` prints rules on stdout, and on stderr a warning for each rule that can never decide.
"""

import re
import sys
from typing import TYPE_CHECKING, Any

import typer

from ..codes import ExceptionCode, Table, exception_meaning
from ..errors import ConfigError, InvalidRequest
from ..values import parse_address, parse_bit, value_type
from .arguments import JSON, whole_number
from .exits import ExitCode
from .files import read_text
from .output import print_aligned, print_json

if TYPE_CHECKING:
    from ..access.access_request import AccessRequest
    from ..access.rule_evaluation import Decision
    from ..access.rules import AccessRules, Rule
    from ..pdu.functions import AnyRequest

EXAMPLES = """\b
Examples:
  busway policy check policy.toml
  busway policy test policy.toml --peer 10.0.0.7 --request "write 4x100 5"
  busway policy test policy.toml --peer 10.0.0.7 --role Operator --request "read 4x1 10" --request "write 0x1 on"
  busway policy test plant.toml --peer fe80::1 --unit 3 --request "08 00 01 00 00"

A request is: read ADDRESS [COUNT], write ADDRESS VALUE..., mask ADDRESS AND OR, or a PDU in hexadecimal.
"""

_TABLE_LETTERS = {
    Table.COILS: "0x",
    Table.DISCRETE_INPUTS: "1x",
    Table.INPUT_REGISTERS: "3x",
    Table.HOLDING_REGISTERS: "4x",
}
_HEXADECIMAL = re.compile(r"(?:[0-9a-fA-F]{2}[\s:,-]*)+")


def policy(
    action: str = typer.Argument(..., metavar="ACTION", help="test or check."),
    file: str = typer.Argument(..., metavar="FILE", help="A policy file, or a configuration file, in TOML."),
    peer: str | None = typer.Option(None, "--peer", metavar="HOST", help="test: address of the client, 10.0.0.7."),
    role: str | None = typer.Option(None, "--role", metavar="ROLE", help="test: role of its certificate."),
    listener: str | None = typer.Option(None, "--listener", metavar="URL", help="test: listener that it came by."),
    unit: str = typer.Option("1", "-u", "--unit", metavar="U", help="test: the unit asked, 0…255: 1."),
    requests: list[str] | None = typer.Option(
        None, "--request", metavar="TEXT", help='test: what it asks, "write 4x100 5"; several times if need be.'
    ),
    as_json: bool = JSON,
) -> int:
    """Say what a policy permits."""
    if action not in ("test", "check"):
        raise ConfigError(f"must be test or check, not {action!r}", key="ACTION")
    if action == "check":
        for name, given in (("--peer", peer), ("--role", role), ("--listener", listener), ("--request", requests)):
            if given:
                raise ConfigError("is for test", key=name)
        rules = _access_rules(file)
        _show_rules(rules, as_json=as_json)
        _warn_of_unreached(rules, file)
        return ExitCode.DONE
    if peer is None:
        raise ConfigError("test needs the address of a client, 10.0.0.7", key="--peer")
    if not requests:
        raise ConfigError('test needs a request, "read 4x1 10"', key="--request")
    number = whole_number(unit, "--unit", 0, 255)
    host = _checked_host(peer)
    asked = [(text, _parsed_request(text)) for text in requests]
    rules = _access_rules(file)
    from ..access.access_request import AccessRequest
    from ..access.rules import listener_name

    where = "" if listener is None else listener_name(listener)
    code = ExitCode.DONE
    for text, request in asked:
        access_request = AccessRequest.of(request, unit=number, peer=host, role=role, listener=where)
        if not _answer(rules, access_request, host, text, as_json=as_json):
            code = ExitCode.REFUSED
    return code


def _access_rules(file: str) -> "AccessRules":
    """Return the address lists and rules of a policy file, or those in a configuration or gateway file.

    Raises:
        ConfigError: the file cannot be read, is invalid, or has no policy.
    """
    text = read_text(file)
    from ..config.files.gateway import is_gateway
    from ..config.files.policy import parse_policy_file
    from ..config.files.toml_source import read_source

    sections = set(read_source(text, file).data)
    if sections <= {"policy"}:
        return parse_policy_file(text, file)
    if is_gateway(sections):
        from ..apps.gateway.configuration import parse_gateway

        access = parse_gateway(text, file).access
    else:
        from ..apps.service.configuration import parse_configuration

        access = parse_configuration(text, file).access
    if access is None:
        raise ConfigError("there is no policy in it", file=file)
    return access


def _checked_host(text: str) -> str:
    """Return the host given by ``--peer``, without brackets and port; an IPv4-mapped address becomes the IPv4 address.

    An IPv6 address stays as it is written; rules compare it by number.

    Raises:
        ConfigError: the text is not a numeric address of one host, with or without a port.
    """
    from ..options.networks import Networks, host_of_peer

    host = host_of_peer(text)
    if "/" in host:
        raise ConfigError(f"one address is needed, not {text!r}", key="--peer")
    Networks([host], key="--peer")
    return host


def _parsed_request(text: str) -> "AnyRequest":
    from ..pdu.functions import STANDARD

    words = text.split()
    if words and words[0] in _REQUESTS:
        try:
            return _REQUESTS[words[0]](words[1:])
        except InvalidRequest as error:
            raise ConfigError(f"{text!r}: {error}", key="--request") from error
    if not _HEXADECIMAL.fullmatch(text.strip()):
        raise ConfigError(
            f'{text!r} is neither "read 4x1 10", "write 4x1 5", "mask 4x1 0xFF00 0x0001" nor a PDU in hexadecimal',
            key="--request",
        )
    pdu = bytes.fromhex(re.sub(r"[\s:,-]", "", text))
    if not 1 <= pdu[0] <= 127 or len(pdu) > 253:
        raise ConfigError(f"{text!r} is no request: 1…253 bytes that begin with a function 1…127", key="--request")
    return STANDARD.decode_request(pdu)


def _read_request(words: list[str]) -> "AnyRequest":
    from ..client.operations import read_values

    if not 1 <= len(words) <= 2:
        raise InvalidRequest("an address and perhaps a count are needed")
    count = whole_number(words[1], "--request", 1, 2000) if len(words) == 2 else 1
    (request,) = next(read_values(parse_address(words[0]), None, "ABCD", count, False))
    return request


def _write_request(words: list[str]) -> "AnyRequest":
    from ..client.operations import write_values

    if len(words) < 2:
        raise InvalidRequest("an address and a value are needed")
    place = parse_address(words[0])
    values: list[Any]
    if place.bit is not None or (place.table is not None and place.table.holds_bits):
        values = [parse_bit(word) for word in words[1:]]
        (request,) = next(write_values(place, values if place.bit is None else values[0], None, "ABCD", "auto"))
        return request
    kind = "int16" if any(word.startswith("-") for word in words[1:]) else "uint16"
    form = value_type(kind)
    (request,) = next(write_values(place, [form.parse(word) for word in words[1:]], kind, "ABCD", "auto"))
    return request


def _mask_request(words: list[str]) -> "AnyRequest":
    from ..pdu.write_items import MaskWriteRegister

    if len(words) != 3:
        raise InvalidRequest("an address, the AND mask and the OR mask are needed")
    place = parse_address(words[0], table=Table.HOLDING_REGISTERS)
    and_mask, or_mask = (whole_number(word, "--request", 0, 0xFFFF) for word in words[1:])
    return MaskWriteRegister(place.offset, and_mask, or_mask)


_REQUESTS = {"read": _read_request, "write": _write_request, "mask": _mask_request}


def _answer(rules: "AccessRules", access_request: "AccessRequest", host: str, text: str, *, as_json: bool) -> bool:
    """Print whether a policy permits a request, and why; return True if it does.

    Args:
        rules: the address lists and rules of the policy.
        access_request: the request, with its client, unit and listener.
        host: address of the client.
        text: the request as on the command line.
        as_json: whether to print a JSON object.
    """
    if not rules.addresses(host):
        why = rules.addresses.why(host)
        if as_json:
            print_json({"request": text, "allowed": False, "connected": False, "code": None, "rule": None, "why": why})
        else:
            print(f"refused: {host} may not connect: {why}")
        return False
    from ..access.rule_evaluation import decision_of

    decision = decision_of(rules.policy, access_request)
    if as_json:
        print_json(
            {
                "request": text,
                "allowed": decision.allowed,
                "connected": True,
                "code": decision.code or None,
                "rule": decision.rule_name,
                "why": decision.reason,
            }
        )
    else:
        print(_sentence(decision, text))
    return decision.allowed


def _sentence(decision: "Decision", text: str) -> str:
    by = decision.rule_name if decision.rule is None else repr(decision.rule_name)
    if decision.allowed:
        rates = "".join(f", at most {rule.rate:g} a second by {rule.name!r}" for rule in decision.rates)
        return f"allowed: {text}: by {by}{rates}"
    meaning = exception_meaning(decision.code).partition(":")[0]
    return f"refused: {text}: by {by}: {decision.reason}; exception {decision.code:02X} ({meaning})"


def _show_rules(rules: "AccessRules", *, as_json: bool) -> None:
    """Print the address lists of a policy, its rules in their order, and the default."""
    rows = [(rule.name, rule.action.value, _facts(rule)) for rule in rules.policy.rules]
    rows.append(("default", rules.policy.default.value, {}))
    access = rules.addresses
    if as_json:
        print_json({"allow": list(access.allow), "deny": list(access.deny), "secure": access.secure})
        for name, action, facts in rows:
            print_json({"rule": name, "action": action, **facts})
        return
    lists = [("deny", access.deny), ("allow", access.allow)]
    lines = [(word, ", ".join(entries)) for word, entries in lists if entries]
    print_aligned([*lines, ("others", "may not connect" if access.secure else "may connect")])
    print()
    print_aligned(
        [(name, action, "; ".join(f"{key} {value}" for key, value in facts.items())) for name, action, facts in rows]
    )


def _warn_of_unreached(rules: "AccessRules", file: str) -> None:
    """Print a warning on stderr for each rule that can never decide, with its line."""
    from ..config.files.toml_source import read_source
    from ..config.preflight import check_unreached_rules
    from ..config.report import ConfigurationReport

    report = ConfigurationReport(read_source(read_text(file), file))
    check_unreached_rules(rules.policy.rules, report)
    for warning in report.warnings:
        print(warning, file=sys.stderr)


def _facts(rule: "Rule") -> dict[str, str]:
    """Return the keys of an access rule with their values as texts, in the notation of policy files.

    Name and action are left out, and so are keys that the rule does not have or that have their default.
    """
    found: dict[str, str] = {}
    if rule.peers is not None:
        found["peers"] = ", ".join(rule.peers)
    if rule.roles is not None:
        found["roles"] = ", ".join(sorted(rule.roles))
    if rule.listeners:
        found["listeners"] = ", ".join(rule.listeners)
    if rule.units is not None:
        found["units"] = _numbers(rule.units)
    if rule.functions is not None:
        found["functions"] = ", ".join(
            f"{code}" if sub_code is None else f"{code}/{sub_code}"
            for code, sub_code in sorted(rule.functions, key=lambda one: (one[0], one[1] or 0))
        )
    items = [_items(_TABLE_LETTERS[table], first, end) for table, ranges in rule.items.items() for first, end in ranges]
    if items:
        found["addresses"] = ", ".join(items)
    if rule.files:
        found["files"] = ", ".join(f"{first}-{end - 1}" if end - first > 1 else f"{first}" for first, end in rule.files)
    if rule.access.value != "any":
        found["access"] = rule.access.value
    if rule.limits is not None:
        found["values"] = f"{rule.limits.low}…{rule.limits.high}"
    if rule.rate is not None:
        found["rate"] = f"{rule.rate:g}/s"
    if rule.code != ExceptionCode.ILLEGAL_FUNCTION:
        found["code"] = f"{rule.code}"
    return found


def _items(prefix: str, first: int, end: int) -> str:
    last = min(end, 0x10000)
    return f"{prefix}{first + 1}" if last - first == 1 else f"{prefix}{first + 1}-{prefix}{last}"


def _numbers(numbers: frozenset[int]) -> str:
    """Return numbers as text, ascending and with ranges: ``1-5, 7``."""
    from ..access.notation import merged

    ranges = merged((number, number + 1) for number in numbers)
    return ", ".join(f"{first}-{end - 1}" if end - first > 1 else f"{first}" for first, end in ranges)
