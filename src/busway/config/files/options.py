"""Keys of a file that are options of a component: made from its parameter class, so that none can be forgotten.

Knows parameter classes (frozen dataclasses) and pydantic; knows no particular class.

1. A key has the name and the type of the option; where the option may have no value, the text ``none`` says so.
2. What a value must be is judged by the class itself, when all of its keys are there.
"""

from collections.abc import Callable, Mapping
from dataclasses import fields
from enum import Enum
from types import NoneType
from typing import Annotated, Any, ClassVar, Literal, TypeVar, get_args, get_type_hints

from pydantic import BeforeValidator, Field, create_model, model_validator

from ...errors import ConfigError
from ...options.text import NONE, build_parameters, option_names
from .schema import FileProblems, Section

Kind = TypeVar("Kind", bound="OptionSection")


def _none(value: object) -> object:
    return None if value == NONE else value


def _or_none(kind: Any) -> Any:  # a type, and the annotated type that pydantic is given
    return Annotated[kind | None, BeforeValidator(_none, json_schema_input_type=kind | Literal["none"])]


SecondsOrNone = Annotated[float | None, BeforeValidator(_none, json_schema_input_type=float | Literal["none"])]
CountOrNone = Annotated[int | None, BeforeValidator(_none, json_schema_input_type=int | Literal["none"])]
TextOrNone = Annotated[str | None, BeforeValidator(_none, json_schema_input_type=str)]
"""Types of keys that may also be ``none``."""


class OptionSection(Section):
    """A section whose keys are options of components, beside what else it declares."""

    kinds: ClassVar[tuple[type[Any], ...]] = ()  # parameter classes, which share no base
    """The classes that judge the values."""
    judged: ClassVar[bool] = True
    """Whether they judge what this section says by itself."""

    def options(self) -> dict[str, Any]:  # of several types
        """The options that are set here, by name."""
        known = {name for kind in self.kinds for name in option_names(kind)}
        return {name: value for name, value in self if name in known and name in self.model_fields_set}

    @model_validator(mode="after")
    def _judge(self) -> "OptionSection":
        options = self.options()
        for kind in self.kinds if self.judged else ():
            build(kind, {name: value for name, value in options.items() if name in option_names(kind)})
        return self


def build(kind: type[Any], options: Mapping[str, Any]) -> None:
    """Let a parameter class judge options; what it refuses becomes a fault of the key."""
    try:
        build_parameters(kind, options)
    except ConfigError as error:
        raise FileProblems([((error.key,) if error.key else (), error.message)]) from None


def with_options_of(*kinds: type[Any], without: frozenset[str] = frozenset()) -> Callable[[type[Kind]], type[Kind]]:
    """A decorator: the section gets a key for each option of the parameter classes.

    Args:
        kinds: the classes.
        without: options that have no effect here, and so are no keys.
    """

    def extended(section: type[Kind]) -> type[Kind]:
        keys: dict[str, Any] = {}  # pairs of type and default, as pydantic takes them
        for kind in kinds:
            hints = get_type_hints(kind)
            for option in fields(kind):
                if option.name not in without and option.name not in section.model_fields:
                    keys[option.name] = (_annotation(hints[option.name]), Field(default=None))
        made = create_model(
            section.__name__, __base__=section, __module__=section.__module__, __doc__=section.__doc__, **keys
        )
        made.kinds = (*section.kinds, *kinds)
        return made

    return extended


def _annotation(hint: Any) -> Any:  # both are types as annotations have them
    """The type of a key for the type of an option."""
    kinds = get_args(hint) if NoneType in get_args(hint) else (hint,)
    kind = next(one for one in kinds if one is not NoneType)
    if isinstance(kind, type) and issubclass(kind, Enum):
        kind = Literal[tuple(one.value for one in kind)]
    elif hasattr(kind, "parse"):
        kind = list[str]
    return _or_none(kind) if NoneType in kinds else kind
