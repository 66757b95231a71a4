"""Outputs that documents show, compared with what the commands print.

Every line that is shown has to be printed, in this order; between them may be others. Two lines are alike if their words
are, whatever the blanks between them. In a word, `...` stands for anything. Numbers are compared, except

- those of time and speed, which depend on the machine: before `s`, `ms`, `min`, `h`, `%` or a unit per second;
- all, with their units of size, where the document runs the command in a shorter form. Lines that begin with another
  word than all that are printed may be missing then: a shorter run has fewer methods.
"""

import re

NUMBER = r"[-+]?\d[\d.,]*"
OF_THE_MACHINE = rf"{NUMBER}(?= ?((s|ms|min|h)\b|%|\w+/s\b))"


def normal(line: str, is_shortened: bool) -> str:
    line = " ".join(line.split())
    if not is_shortened:
        return re.sub(OF_THE_MACHINE, "#", line)
    line = re.sub(rf"(?<![\w@.-]){NUMBER}", "#", line)
    return re.sub(r"# (B|kB|MB|GB)\b", "# B", line)


def is_like(shown: str, printed: str) -> bool:
    pattern = ".*".join(re.escape(part) for part in shown.split("..."))
    return re.fullmatch(pattern, printed) is not None


def differences(shown: str, printed: str, is_shortened: bool) -> list[str]:
    """The lines of `shown` that are not among those of `printed`."""
    lines = [normal(line, is_shortened) for line in printed.splitlines()]
    first_words = {line.split(" ")[0] for line in lines}
    wrong, place, compared = [], 0, False
    for line in filter(None, (normal(line, is_shortened) for line in shown.splitlines())):
        if is_shortened and line.split(" ")[0] not in first_words:
            continue
        compared = True
        found = next((n for n in range(place, len(lines)) if is_like(line, lines[n])), None)
        if found is None:
            wrong.append(f"not printed: {line}")
        else:
            place = found + 1
    return wrong if compared or not shown else ["none of the lines that are shown is printed"]
