"""Keys of access policies: who may connect, and rules for requests; a file of its own, or a section of another file.

Knows the keys; `busway.access` knows what they mean and what goes together.

An example is in `docs/security.md`; ``policy = "read-only"`` is a policy in one word.
"""

from typing import Annotated, Any, Final, Literal

from pydantic import BeforeValidator, model_validator

from ...access.addresses import AddressList
from ...access.rules import RATES, AccessRules, Action, Limits, Policy, Rule
from ...errors import ConfigError
from ...options.declaration import Name
from ...values.unfit_values import shown
from .key_lines import KeyPath
from .section import NO_LIST, FileProblems, Section
from .toml_source import parse_file


def _as_numbers(value: object) -> object:
    """Return the numbers of an access rule, written as a number, a text or a list of these, as a list.

    Raises `ValueError` for anything else.
    """
    values = value if isinstance(value, list) else [value]
    for each in values:
        if isinstance(each, bool) or not isinstance(each, int | str):
            raise ValueError(f"must be a number, a text such as '1-5', or a list of them, not {shown(each)}")
    return values


def _as_texts(value: object) -> object:
    return [value] if isinstance(value, str) else value


MOST_RULES: Final = 100_000
"""Most rules of a policy. Reading so many takes some ten seconds, in a thread beside the program's others."""

NumbersField = Annotated[
    list[int | str], BeforeValidator(_as_numbers, json_schema_input_type=int | str | list[int | str])
]
Texts = Annotated[list[str], BeforeValidator(_as_texts, json_schema_input_type=str | list[str])]
ActionWord = Literal["allow", "deny", "read-only"]
Hosts = Annotated[list[str], 'addresses and networks that may connect: `"10.0.0.7"`, `"10.0.0.0/8"`, `"fe80::/64"`.']
RefusedHosts = Annotated[list[str], "those that may not, whatever `allow` says."]
Secure = Annotated[bool | None, "whether those in neither list are refused; None: if there is an `allow`."]


def parse_policy_file(text: str, name: str) -> AccessRules:
    """Parse and check the text of a policy file, and return its access rules.

    Args:
        text: the file's text.
        name: the file's name, for messages.

    Raises:
        FileError: the file is invalid; has all problems, each with file, line and key.
    """
    return parse_file(text, PolicyFile, name).policy.access_rules()


class ValuesSection(Section):
    """``values``: the range of values that may be written to each register of the rule."""

    min: Annotated[int | None, "the least value; None: the least that a register holds."] = None
    max: Annotated[int | None, "the greatest value; None: the greatest that a register holds."] = None
    signed: Annotated[bool, "whether registers are numbers with a sign."] = False

    @model_validator(mode="after")
    def _check(self) -> "ValuesSection":
        try:
            self.limits()
        except ConfigError as error:
            raise ValueError(error.message) from None
        return self

    def limits(self) -> Limits:
        """Return the section as `Limits` of an access rule; an end that is left out is that of a register.

        Raises:
            ConfigError: an end is no value of a register, or ``min`` is above ``max``.
        """
        least, most = (-0x8000, 0x7FFF) if self.signed else (0, 0xFFFF)
        return Limits(least if self.min is None else self.min, most if self.max is None else self.max, self.signed)


class RuleSection(Section):
    """``[[policy.rule]]``: one rule; keys that are left out match everything."""

    name: Annotated[str, "what logs call the rule; left out: `rule 1`, `rule 2` and so on."] = ""
    action: Annotated[ActionWord, "what is done; `read-only`: reads are permitted and writes denied."] = "allow"
    peers: Annotated[list[str] | None, "addresses and networks of clients; None: all."] = None
    roles: Annotated[
        list[str] | None, "roles of certificates; None: all. A client without a certificate is in no role."
    ] = None
    listeners: Annotated[
        list[str] | None,
        Name("at least one listener"),
        "where the request arrived: URLs as they were configured (`tcp://:502`) or as they are bound, or schemes,",
        '`["tls://"]`; None: anywhere.',
    ] = None
    units: Annotated[
        NumbersField | None,
        'units asked, `"1-5,7"`, and all that their device is listed as; None: all. A sole device answers to 0 and 255',
        "too.",
    ] = None
    functions: Annotated[
        NumbersField | None,
        'codes, `"8/1"` (sub-function), names, and the groups `read` (1–4, 20, 24), `write` (5, 6, 15, 16, 21–23),',
        "`diagnostics` (7, 8, 11, 12, 17); None: all.",
    ] = None
    table: Annotated[
        Texts | None, "items of a table: `holding`, `input`, `coil`, `discrete`, or a list; None: see `addresses`."
    ] = None
    addresses: Annotated[
        NumbersField | None,
        'items, `"4x101-4x110"`, `"holding:100-109"`, `"%MW100-%MW109"`; with a `table` also offsets `"100-109"`;',
        "None: all of the table, or any.",
    ] = None
    files: Annotated[NumbersField | None, 'records of functions 20 and 21, by number of the file, `"1-4"`.'] = None
    access: Annotated[
        Literal["read", "write", "any"],
        "reads or writes of items; a request that touches none is a write if read-only denies it.",
    ] = "any"
    values: Annotated[ValuesSection | None, "limits of what may be written to a holding register."] = None
    rate: Annotated[float | None, RATES, "requests a second, for each host; None: no limit."] = None
    code: Annotated[Literal[1, 2], "exception code of a refusal; 2 for a rule with items and without roles."] = 1

    @model_validator(mode="after")
    def _check(self) -> "RuleSection":
        try:
            self.rule()
        except ConfigError as error:
            path: KeyPath = (error.key,) if error.key else ()
            raise FileProblems([(path, error.message)]) from None
        return self

    def rule(self) -> Rule:
        """Return the section as an access `Rule`. Raises `ConfigError`, whose ``key`` is the key that is wrong."""
        given = {name: getattr(self, name) for name in self.model_fields_set}
        return Rule.of(**{**given, "values": None if self.values is None else self.values.limits()})


class PolicySection(Section):
    """``[policy]``: address lists, the default, and rules in their order."""

    default: Annotated[ActionWord, "what holds where no rule fits."]
    secure: Secure = None
    allow: Hosts = NO_LIST
    deny: RefusedHosts = NO_LIST
    rule: Annotated[list[RuleSection], "the rules, of which the first that fits decides."] = NO_LIST

    @model_validator(mode="before")
    @classmethod
    def _from_word(cls, value: Any) -> Any:  # the value in the file, of any type
        """Accept ``policy = "read-only"``: a word alone is the default of a policy without rules.

        Refuses too many rules early.
        """
        if isinstance(value, str):
            return {"default": value}
        rules = value.get("rule") if isinstance(value, dict) else None
        if isinstance(rules, list) and len(rules) > MOST_RULES:
            raise FileProblems(
                [(("rule", MOST_RULES), f"there are {len(rules)} rules, and {MOST_RULES} are the limit")]
            )
        return value

    @model_validator(mode="after")
    def _check(self) -> "PolicySection":
        faults: list[tuple[KeyPath, str]] = []
        try:
            self.addresses()
        except ConfigError as error:
            faults.append(((error.key,) if error.key else (), error.message))
        taken: dict[str, int] = {}
        for number, each in enumerate(self.rule):
            first = taken.setdefault(each.name or f"rule {number + 1}", number)
            if first != number:
                faults.append((("rule", number, "name"), f"rule {first + 1} has the same name"))
        if not faults:
            try:
                self.policy()
            except ConfigError as error:
                faults.append((("rule",), error.message))
        if faults:
            raise FileProblems(faults)
        return self

    def policy(self) -> Policy:
        """Return the section as an access `Policy`; it was checked when the file was read."""
        return Policy(tuple(each.rule() for each in self.rule), Action(self.default))

    def addresses(self) -> AddressList:
        """Return the lists of allowed and refused hosts. Raises `ConfigError` with the ``key`` that is wrong."""
        return AddressList(self.allow if "allow" in self.model_fields_set else None, self.deny, self.secure)

    def access_rules(self) -> AccessRules:
        """Return the policy and the address lists of the section together."""
        return AccessRules(self.policy(), self.addresses())


class PolicyFile(Section):
    """The checked contents of a file that holds only a policy."""

    policy: Annotated[PolicySection, "who may ask what."]
