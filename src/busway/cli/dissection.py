"""Prints a dissected frame: as lines, one for each field, or as a JSON object.

Knows dissections; does not know where frames come from.
"""

from ..observe.dissect import Dissection

_BYTES_PER_LINE = 16


def show_dissection(dissection: Dissection) -> None:
    """Print a dissected frame on stdout.

    First the title, and whether the frame answers the request before it; then the fields with offset, bytes (16 on a
    line) and value; then what is wrong.
    """
    print(dissection.title + (", answers the request before it" if dissection.answers else ""))
    names = max((len(part.name) for part in dissection.parts), default=0)
    widest = max((min(len(part.data), _BYTES_PER_LINE) for part in dissection.parts), default=0)
    for part in dissection.parts:
        chunks = [part.data[at : at + _BYTES_PER_LINE] for at in range(0, len(part.data), _BYTES_PER_LINE)] or [b""]
        said = "  ".join(each for each in (part.text, f"! {part.problem}" if part.problem else "") if each)
        line = f"  {part.offset:3}  {chunks[0].hex(' '):{3 * widest}} {part.name:{names}}  {said}"
        print(line.rstrip())
        for number, chunk in enumerate(chunks[1:], start=1):
            print(f"  {part.offset + number * _BYTES_PER_LINE:3}  {chunk.hex(' ')}")
    said_already = {f"{part.name}: {part.problem}" for part in dissection.parts}
    for problem in dissection.problems:
        if problem not in said_already:
            print(f"  ! {problem}")


def dissection_json(dissection: Dissection) -> dict[str, object]:
    """Return a dissected frame as a dictionary for JSON: framing, direction, title, fields and problems.

    ``answers`` tells whether it is the reply to the frame before it. Bytes are hexadecimal texts.
    """
    return {
        "framing": dissection.framing.value,
        "direction": dissection.direction.value,
        "title": dissection.title,
        "answers": dissection.answers,
        "fields": [
            {
                "offset": part.offset,
                "bytes": part.data.hex(),
                "name": part.name,
                "value": part.text,
                "problem": part.problem,
            }
            for part in dissection.parts
        ],
        "problems": list(dissection.problems),
    }
