"""Makes the receiver of commands that the key ``commands`` of a sink's table asks for.

Knows sections; connects to nothing.

1. Off unless the section has ``commands``. It names the points that may be written, and where their commands come from.
2. Commands come on topics of their own: a topic on which samples are sent is refused.
"""

from ....config.files.sinks import (
    CommandsSection,
    MqttSinkSection,
    NatsSinkSection,
    SinkSection,
    SparkplugSinkSection,
)
from ....errors import ConfigError
from ....options.sinks import MqttOptions, NatsOptions
from ..sinks.options import broker, nats_server
from .command_messages import CommandInput, InputRights, overlap


def make_input(section: SinkSection, sink: object = None) -> CommandInput | None:
    """Create the receiver of commands that a sink's table in the collector file asks for; nothing is connected.

    Args:
        section: the table of the sink.
        sink: the sink of this table. Commands by Sparkplug come over its connection: its attribute ``commands`` is set
            to the receiver. Other kinds of sinks are not used.

    Returns:
        The receiver; None if the table has no key ``commands``.

    Raises:
        ConfigError: the topic or subject of commands, the URL, a certificate, a password or a token cannot be used;
            names the key or the file.
        MissingExtra: a package that the receiver needs is not installed.
    """
    if isinstance(section, MqttSinkSection) and section.commands is not None:
        return _mqtt(section, _rights(section, section.commands.topic, "/", _samples_topic(section)))
    if isinstance(section, NatsSinkSection) and section.commands is not None:
        samples = section.built(NatsOptions).subject
        return _nats(section, _rights(section, section.commands.subject, ".", samples))
    if isinstance(section, SparkplugSinkSection) and section.commands is not None:
        return _sparkplug(section.commands, sink)
    return None


def _samples_topic(section: MqttSinkSection) -> str:
    options = section.built(MqttOptions)
    return f"{options.topic}/{{point}}" if options.per_point and "{point}" not in options.topic else options.topic


def _rights(section: MqttSinkSection | NatsSinkSection, template: str, separator: str, samples: str) -> InputRights:
    assert section.commands is not None
    levels = template.split(separator)
    plain = [each for each in levels if each not in ("{device}", "{point}")]
    where = "topic" if separator == "/" else "subject"
    if sorted(set(levels) - set(plain)) != ["{device}", "{point}"] or len(levels) != len(plain) + 2:
        raise _refusal(f"{where} has {{device}} and {{point}}, each once and as a level of its own")
    if not all(plain) or any(set(each) & set("{}+#*> \x00") for each in plain):
        raise _refusal(f"{where} has no wildcards, braces or empty levels, not {template!r}")
    if overlap(template, samples, separator):
        raise _refusal(f"{where} is one on which samples are sent: {samples}")
    commands = section.commands
    return InputRights(template, tuple(commands.points), commands.seconds, commands.role)


def _refusal(sentence: str) -> ConfigError:
    return ConfigError(sentence, key="commands")


def _mqtt(section: MqttSinkSection, rights: InputRights) -> CommandInput:
    from .mqtt import MqttCommands

    client_id = section.built(MqttOptions).client_id
    name = None if client_id is None else f"{client_id}-commands"
    return MqttCommands(**broker(section), rights=rights, client_id=name)


def _sparkplug(commands: CommandsSection, sink: object) -> CommandInput:
    from ..sinks.sparkplug import SparkplugSink
    from .sparkplug import PLACE, SparkplugCommands

    made = SparkplugCommands(InputRights(PLACE, tuple(commands.points), commands.seconds, commands.role))
    if isinstance(sink, SparkplugSink):
        sink.commands = made
    return made


def _nats(section: NatsSinkSection, rights: InputRights) -> CommandInput:
    from .nats import NatsCommands

    return NatsCommands(**nats_server(section), rights=rights)
