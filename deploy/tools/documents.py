"""Documents of the project: their list, and their fenced blocks with the marker before each.

A marker is an HTML comment on the line before a block:

    <!-- run -->                                 run; exit code 0
    <!-- run: exit 0 or 3 -->                    exit code 3 is a result too
    <!-- run: --frames 60 => --frames 5 -->      run with the left text replaced by the right
    <!-- run: background -->                     keeps running until the end of the page
    <!-- file: NAME -->                          the block is a file that later blocks read
    <!-- not run: REASON -->                     options, values and paths are checked, nothing runs
    <!-- not compared: REASON -->                an output of which nothing is the same in another run

Parts are separated by `;`. Blocks of `text`, `json`, `mermaid` and `rust` need none. A block of `text` after a block
that is run shows its output, which is compared by the rule of shown_output.py.
"""

import pathlib
import re
import subprocess
from dataclasses import dataclass, field

ROOT = pathlib.Path(__file__).resolve().parents[2]
WITHOUT_MARKER = {"text", "json", "mermaid", "rust"}
FIRST = ["README.md", "CONTRIBUTING.md", "ARCHITECTURE.md", "SECURITY.md", "deploy/docs/README.md",
         "deploy/docs/tutorials/first-run.md"]


def pages() -> list[pathlib.Path]:
    """Every document that is written for readers: no model cards, no change log, no folders of test data."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.md"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    left_out = ("deploy/weights/", "fuzz/", "tests/", "CHANGELOG.md")
    names = [name for name in names if not name.startswith(left_out) and (ROOT / name).exists()]
    order = {name: number for number, name in enumerate(FIRST)}
    return [ROOT / name for name in sorted(names, key=lambda name: (order.get(name, len(FIRST)), "/results" in name, name))]


@dataclass
class Block:
    """A fenced block."""

    page: pathlib.Path
    line: int
    language: str
    text: str
    marker: str
    replacements: list[tuple[str, str]] = field(default_factory=list)
    codes: tuple[int, ...] = (0,)
    background: bool = False
    # The output that the page shows after it.
    shown: str = ""

    @property
    def place(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    @property
    def is_run(self) -> bool:
        return re.fullmatch(r"run(:.*)?", self.marker) is not None

    @property
    def file(self) -> str | None:
        return self.marker.removeprefix("file:").strip() if self.marker.startswith("file:") else None

    def fault(self) -> str | None:
        """Why the marker is not accepted."""
        if self.language in WITHOUT_MARKER and not self.marker:
            return None
        if not self.marker:
            return f"block of {self.language or 'no language'} without a marker"
        if self.marker.startswith("not compared:") and self.language == "text":
            return None
        if self.marker.startswith("not run:") and len(self.marker) > len("not run: "):
            return None
        if self.file:
            return None
        if not self.is_run:
            return f"unknown marker {self.marker!r}"
        if self.language != "bash":
            return f"block of {self.language or 'no language'} cannot be run, only bash"
        for part in filter(None, (part.strip() for part in self.marker.removeprefix("run").lstrip(":").split(";"))):
            if part == "background":
                self.background = True
            elif part == "exit 0 or 3":
                self.codes = (0, 3)
            elif "=>" in part:
                old, new = (side.strip() for side in part.split("=>", 1))
                if old not in self.text:
                    return f"marker replaces {old!r}, which the block does not contain"
                self.replacements.append((old, new))
            else:
                return f"unknown part {part!r} of a marker"
        return None

    def command(self) -> str:
        """The text for bash: ends at the first command whose exit code is not accepted."""
        text = self.text
        for old, new in self.replacements:
            text = text.replace(old, new)
        accepted = " || ".join(f"[ $code = {code} ]" for code in self.codes)
        return f"trap 'code=$?; {accepted} || exit $code' ERR\n{text}"


def blocks(page: pathlib.Path) -> list[Block]:
    found, inside, before = [], None, ""
    for number, line in enumerate(page.read_text().splitlines(), start=1):
        fence = re.match(r"\s*```(\S*)", line)
        if fence and inside is None:
            comment = re.fullmatch(r"\s*<!-- (.*?) -->", before)
            inside = Block(page, number, fence[1], "", comment[1] if comment else "")
        elif fence:
            if inside.language == "text" and not inside.marker and found and found[-1].is_run:
                found[-1].shown = inside.text
            found.append(inside)
            inside = None
        elif inside is not None:
            inside.text += line + "\n"
        before = line
    return found
