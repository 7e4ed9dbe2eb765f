"""The README's table of the configuration, made from config.toml.

`python tests/packaging/config_table.py` renews it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
CONFIG, README = ROOT / "config.toml", ROOT / "README.md"
BEGIN, END = "<!-- config.toml as a table -->", "<!-- end of config.toml -->"
KEY = re.compile(
    r"(?P<off># )?(?P<key>[a-z][a-z0-9_]*) = (?P<value>\"[^\"]*\"|\[[^\]]*\]|[^\s#]+)\s*(?:#\s*(?P<meaning>.*))?"
)
SECTION = re.compile(r"\[([\w.]+)\]")
RULE = re.compile(r"# ?-{3}")


def rows() -> Iterator[tuple[str, str, str]]:
    """Key with its section, the value as it is there, and what the file says of it, beside it or in the lines above."""
    section, above = "", []
    for line in CONFIG.read_text().splitlines():
        if found := SECTION.fullmatch(line.partition("#")[0].strip()):
            section, above = found[1], []
        elif found := KEY.fullmatch(line):
            meaning = " ".join(filter(None, [*above, found["meaning"]]))
            yield f"{section}.{found['key']}", "" if found["off"] else found["value"], meaning
            above = []
        elif line.startswith("# ") and not RULE.match(line):
            above.append(line.removeprefix("# "))
        else:
            above = []


def table() -> str:
    """All of it in Markdown; the right finger has the left one's keys."""
    lines = ["| key | default | meaning |", "|---|---|---|"]
    for key, value, meaning in rows():
        if key.startswith("right."):
            continue
        told = meaning.replace("|", "\\|")
        shown = f"`{value}`" if value else "left out"
        lines.append(f"| `{key}` | {shown} | {told} |")
    return "\n".join(lines)


def in_readme() -> str:
    """What the README has between the marks."""
    return README.read_text().partition(BEGIN)[2].partition(END)[0].strip()


def main() -> None:
    """Write the table into the README."""
    before, _, rest = README.read_text().partition(BEGIN)
    after = rest.partition(END)[2]
    README.write_text(f"{before}{BEGIN}\n\n{table()}\n\n{END}{after}")


if __name__ == "__main__":
    main()
