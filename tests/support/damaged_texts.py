"""What happens to files that people write: lines that are lost or doubled, wrong values, typing errors, half a file."""

import random
import re

VALUES = (
    "1", "-1", "65536", "3.5", "nan", "inf", "true", '"x"', '""', "[]", "[[]]", "{}", "{ a = 1 }", "[1, 2]", "[true]",
    "1979-05-27", "07:32:00", "'''x'''", '"4x1"', '"0x1.3"', "[[0, 0]]", "1e400", "0xFFFFFFFFFFFFFFFFFF"
)  # fmt: skip


def after_accidents(text: str, random_source: random.Random) -> str:
    """The text after one to three accidents."""
    for _ in range(random_source.randint(1, 3)):
        lines = text.split("\n")
        at = random_source.randrange(len(lines))
        place = random_source.randrange(len(text))
        accident = random_source.randrange(8)
        if accident == 0:
            del lines[at]
        elif accident == 1:
            lines.insert(at, lines[random_source.randrange(len(lines))])
        elif accident == 2:
            lines[at] = re.sub(r"= .*", f"= {random_source.choice(VALUES)}", lines[at])
        elif accident == 3:
            lines[at] = re.sub(r"\d+", lambda match: str(int(match[0]) * 1000 - 7), lines[at])
        elif accident == 4:
            lines[at] = lines[at].replace("a", "e", 1)
        text = "\n".join(lines)
        if accident == 5:
            text = text[:place] + text[place + 1 :]
        elif accident == 6:
            text = text[:place] + random_source.choice('"[]{}=,.#\n\\\x00\t0x-é') + text[place:]
        elif accident == 7:
            text = text[:place]
    return text
