"""Keys of files that set options: generated from the declarations of the options.

Knows declared options (`busway.options.declaration`) and pydantic; knows no particular option.

1. A key has the name and the type of the option; for an option that can be None, the text ``none`` means None.
2. Each key is checked by its declaration; the parameter class checks what goes together when all of its keys are there.
3. An option that a section and its own URL give with different values is refused: one of the two would be lost
   (`differing_from_url`).
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from enum import Enum
from functools import reduce
from operator import or_
from typing import Annotated, Any, ClassVar, Literal, TypeVar, get_origin

from pydantic import BeforeValidator, create_model, model_validator

from ...errors import ConfigError
from ...options.accepted_options import AcceptedOptions, aliases
from ...options.declaration import NONE, REQUIRED, Option, declared
from ...options.endpoints import Endpoint
from ...options.presets import OPTION, preset_of
from ...options.text import build_parameters, option_value
from ...values.unfit_values import shown
from .key_lines import KeyPath
from .section import FileProblems, Section

SectionKind = TypeVar("SectionKind", bound="OptionSection")
Parameters = TypeVar("Parameters")


def _none(value: object) -> object:
    return None if value == NONE else value


def _or_none(kind: Any) -> Any:  # a type, and the annotated type that pydantic is given
    return Annotated[kind | None, BeforeValidator(_none, json_schema_input_type=kind | Literal["none"])]


class OptionSection(Section):
    """Base of file sections some of whose keys are options, declared in parameter classes of `busway.options`.

    A subclass gets the keys by the decorator `with_options_of`. When a section is read, each parameter class checks its
    options together, except those in ``checked_later``.
    """

    kinds: ClassVar[tuple[type[Any], ...]] = ()  # parameter classes, which share no base
    """The parameter classes whose options are keys of the section."""
    checked_later: ClassVar[tuple[type[Any], ...]] = ()
    """Those of ``kinds`` whose options are checked together later, when the section is combined with others."""

    def options(self) -> dict[str, Any]:  # of several types
        """Return the options of ``kinds`` that this section sets, by name; not those that it leaves out."""
        return self.options_of(*self.kinds)

    def options_of(self, *kinds: type[Any]) -> dict[str, Any]:  # parameter classes, and values of several types
        """Return the options of the given parameter classes that this section sets, by name."""
        known = {name for kind in kinds for name in declared(kind)}
        return {name: value for name, value in self if name in known and name in self.model_fields_set}

    def built(self, kind: type[Parameters]) -> Parameters:
        """Return an object of a parameter class with the options that this section sets; the others have defaults.

        Raises `ConfigError` for an invalid option only if the class is in ``checked_later``: others were checked when
        the section was read.
        """
        return build_parameters(kind, self.options_of(kind))

    @model_validator(mode="after")
    def _check_options(self) -> "OptionSection":
        now = [kind for kind in self.kinds if kind not in self.checked_later]
        faults: list[tuple[KeyPath, str]] = []
        for kind in now:
            known = declared(kind)
            for name, value in self.options_of(kind).items():
                try:
                    known[name].check_number(value)
                except ConfigError as error:
                    faults.append(((name,), error.message))
        if faults:
            raise FileProblems(faults)
        for kind in now:
            build(kind, self.options_of(kind))
        return self


def build(kind: type[Any], options: Mapping[str, Any]) -> None:
    """Check whether options are valid together, by creating an object of their parameter class; returns nothing.

    Raises:
        FileProblems: an option is invalid; the problem has its key.
    """
    try:
        build_parameters(kind, options)
    except ConfigError as error:
        raise FileProblems([((error.key,) if error.key else (), error.message)]) from None


def differing_from_url(section: OptionSection, endpoint: Endpoint) -> Iterator[tuple[KeyPath, str]]:
    """Yield a problem, as path and sentence, for each option that a section and its URL give with different values.

    In the URL the option may have another name, such as ``baudrate``. A text there that cannot be a value differs.

    Args:
        section: the section.
        endpoint: its URL, parsed.
    """
    if not endpoint.options:
        return
    known = {name: option for kind in section.kinds for name, option in declared(kind).items()}
    for given, text in endpoint.options.items():
        name = aliases().get(given, given)
        if name not in section.model_fields_set or not (name in known or name == OPTION):
            continue
        try:
            own, in_url = (_value(known.get(name), value) for value in (getattr(section, name), text))
            is_same = own == in_url
        except ConfigError:
            is_same = False
        if not is_same:
            yield (name,), f"has another value in url (?{given}=): leave one of the two out"


def _value(option: Option | None, value: object) -> object:
    """Return the value of an option, given as in a file or as text; without ``option``, of ``preset``."""
    return preset_of(value) if option is None else option_value(option, value)


def with_options_of(
    *kinds: type[Any], role: str = "", without: Iterable[str] = ()
) -> Callable[[type[SectionKind]], type[SectionKind]]:
    """Class decorator that adds a key to a file section for each option of the parameter classes.

    A key that the section has already stays as it is. The decorator returns a new subclass of the same name.

    Args:
        kinds: the parameter classes.
        role: ``client`` or ``server``: only options that have an effect for it are keys; empty for all.
        without: names of options that have no effect here, and so are no keys.
    """

    def extended(section: type[SectionKind]) -> type[SectionKind]:
        keys: dict[str, Any] = {}  # pairs of type and default, as pydantic takes them
        for option in AcceptedOptions.of(*kinds, role=role).options.values():
            if option.name not in without and option.name not in section.model_fields:
                keys[option.name] = (_annotation(option), ... if option.default is REQUIRED else None)
        made = create_model(
            section.__name__, __base__=section, __module__=section.__module__, __doc__=section.__doc__, **keys
        )
        made.kinds = (*section.kinds, *kinds)
        return made

    return extended


def _annotation(option: Option) -> Any:  # a type as annotations have it
    """Return the type that the key of an option has in the file's schema."""
    kind = reduce(or_, [_plain(kind) for kind in option.kinds])
    if len(option.kinds) > 1:
        return Annotated[kind, BeforeValidator(_one_of(option), json_schema_input_type=kind), option]
    return Annotated[_or_none(kind) if option.is_optional else kind, option]


def _plain(kind: Any) -> Any:  # both are types as annotations have them
    if get_origin(kind) is tuple:
        return list[str]
    if issubclass(kind, Enum):
        return Literal[tuple(one.value for one in kind)]
    return getattr(kind, "written_as", list[str] if hasattr(kind, "parse") else kind)


def _one_of(option: Option) -> Callable[[object], object]:
    """Return a validator for an option whose value is a number or one of some words; its error says what is allowed."""

    def report(value: object) -> object:
        if value in option.choices or (isinstance(value, int | float) and not isinstance(value, bool)):
            return value
        raise ValueError(f"must be {option.expected}, not {shown(value)}")

    return report
