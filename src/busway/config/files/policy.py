"""Keys of access policies: who may connect, and rules for requests; a file of its own, or a section of another file.

Knows the keys; `busway.access` knows what they mean and what goes together.

::

    [policy]
    default = "read-only"
    allow = ["10.0.0.0/8"]

    [[policy.rule]]
    name = "setpoints"
    roles = ["operator"]
    functions = ["write"]
    addresses = "4x101-4x110"
    values = { min = 0, max = 1000 }

or in one word: ``policy = "read-only"``.
"""

from typing import Annotated, Any, Final, Literal

from pydantic import BeforeValidator, Field, model_validator

from ...access.addresses import AddressList
from ...access.rules import AccessRules, Action, Limits, Policy, Rule
from ...errors import ConfigError
from ...values.refusal import shown
from .lines import Path
from .schema import FileProblems, Section, parse_file


def _as_numbers(value: object) -> object:
    """Accept the numbers of an access rule written as a number, a text or a list of them."""
    values = value if isinstance(value, list) else [value]
    for each in values:
        if isinstance(each, bool) or not isinstance(each, int | str):
            raise ValueError(f"must be a number, a text such as '1-5', or a list of them, not {shown(each)}")
    return values


def _as_texts(value: object) -> object:
    return [value] if isinstance(value, str) else value


MOST_RULES: Final = 100_000
"""Rules of a policy. Reading so many takes some ten seconds, in a thread beside what runs."""

Numbers = Annotated[list[int | str], BeforeValidator(_as_numbers, json_schema_input_type=int | str | list[int | str])]
Texts = Annotated[list[str], BeforeValidator(_as_texts, json_schema_input_type=str | list[str])]
ActionWord = Literal["allow", "deny", "read-only"]


def parse_policy_file(text: str, name: str) -> AccessRules:
    """Parse and check a whole policy file. Raises `FileError` with all problems.

    Args:
        text: its content.
        name: its name, for the sentences.

    Raises:
        FileError: all that is wrong with it, each with file, line and key.
    """
    return parse_file(text, PolicyFile, name).policy.access_rules()


class ValuesSection(Section):
    """``values``: the range of values that may be written to each register of the rule."""

    min: int | None = None
    max: int | None = None
    signed: bool = False

    @model_validator(mode="after")
    def _check(self) -> "ValuesSection":
        try:
            self.limits()
        except ConfigError as error:
            raise ValueError(error.message) from None
        return self

    def limits(self) -> Limits:
        """Return the section as `Limits` of an access rule. Raises `ConfigError`."""
        least, most = (-0x8000, 0x7FFF) if self.signed else (0, 0xFFFF)
        return Limits(least if self.min is None else self.min, most if self.max is None else self.max, self.signed)


class RuleSection(Section):
    """``[[policy.rule]]``: one rule; keys that are left out match everything."""

    name: str = ""
    action: ActionWord = "allow"
    peers: list[str] | None = None
    roles: list[str] | None = None
    listeners: list[str] | None = Field(default=None, min_length=1)
    units: Numbers | None = None
    functions: Numbers | None = None
    table: Texts | None = None
    addresses: Numbers | None = None
    files: Numbers | None = None
    access: Literal["read", "write", "any"] = "any"
    values: ValuesSection | None = None
    rate: float | None = None
    code: Literal[1, 2] = 1

    @model_validator(mode="after")
    def _check(self) -> "RuleSection":
        try:
            self.rule()
        except ConfigError as error:
            path: Path = (error.key,) if error.key else ()
            raise FileProblems([(path, error.message)]) from None
        return self

    def rule(self) -> Rule:
        """Return the section as an access `Rule`. Raises `ConfigError` with the key at fault."""
        return Rule.of(
            name=self.name,
            action=self.action,
            peers=self.peers,
            roles=self.roles,
            listeners=self.listeners or (),
            units=self.units,
            functions=self.functions,
            table=self.table,
            addresses=self.addresses,
            files=self.files,
            access=self.access,
            values=None if self.values is None else self.values.limits(),
            rate=self.rate,
            code=self.code,
        )


class PolicySection(Section):
    """``[policy]``: address lists, the default, and rules in their order."""

    default: ActionWord
    secure: bool | None = None
    allow: list[str] = Field(default_factory=list)
    deny: list[str] = Field(default_factory=list)
    rule: list[RuleSection] = Field(default_factory=list)

    @model_validator(mode="before")
    @classmethod
    def _from_word(cls, value: Any) -> Any:  # what stands in the file, of any type
        """Accept ``policy = "read-only"`` as a policy of its default alone, and refuse too many rules early."""
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
        faults: list[tuple[Path, str]] = []
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
        """Return the section's lists of hosts that may connect. Raises `ConfigError` with the key at fault."""
        return AddressList(self.allow, self.deny, self.secure)

    def access_rules(self) -> AccessRules:
        """Return the policy and the address lists of the section together."""
        return AccessRules(self.policy(), self.addresses())


class PolicyFile(Section):
    """The checked contents of a file that holds only a policy."""

    policy: PolicySection
