"""Reader of the configuration beside a checkpoint, entry by entry: errors name missing and invalid entries."""

import json

from opencood_refused import Refused

EXPECTED = "expected is the config.yaml that lies beside a checkpoint of OpenCOOD, or the same as JSON"
REQUIRED = object()


def read_config(path, checkpoint, metadata):
    """The configuration file, or the header of a safetensors file."""
    if path is None:
        if not isinstance(metadata, dict) or "config" not in metadata:
            raise Refused(f"{checkpoint}: no configuration lies in it; --config names the config.yaml beside it")
        label, values = f"{checkpoint}: config in its header", parsed_json(checkpoint, metadata["config"])
    else:
        label, values = f"{path}", parsed(path)
    if not isinstance(values, dict) or not values:
        what = "empty" if not values else f"of type {type(values).__name__}"
        raise Refused(f"{label}: the configuration is {what}; {EXPECTED}")
    return Section(values, f"{label}:", "")


def parsed(path):
    try:
        text = path.read_bytes().decode()
    except UnicodeDecodeError as error:
        raise Refused(f"{path}: no text ({error}); {EXPECTED}") from error
    return parsed_json(path, text) if path.suffix == ".json" else parsed_yaml(path, text)


def parsed_json(path, text):
    try:
        return json.loads(text)
    except (ValueError, TypeError, RecursionError) as error:
        raise Refused(f"{path}: no JSON ({error}); {EXPECTED}") from error


def parsed_yaml(path, text):
    try:
        import yaml
    except ImportError as error:
        raise Refused(f"{path}: reading YAML needs PyYAML (pip install pyyaml); JSON does not") from error

    class Loader(yaml.SafeLoader):
        pass

    # The files hold numpy scalars where their writer computed them; only their plain values matter here.
    Loader.add_multi_constructor("tag:yaml.org,2002:python/", lambda loader, suffix, node: None)
    Loader.add_constructor("tag:yaml.org,2002:python/tuple", lambda loader, node: loader.construct_sequence(node, True))
    try:
        return yaml.load(text, Loader=Loader)
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None) or error
        line = f" at line {mark.line + 1}" if mark else ""
        reason = " ".join(str(problem).split())
        raise Refused(f"{path}: broken YAML{line} ({reason}); {EXPECTED}") from error


class Section:
    """A part of a configuration with its path."""

    def __init__(self, values, label, name):
        self.values, self.label, self.name = values, label, name

    def refuse(self, key, problem):
        return Refused(f"{self.label} {self.name}{key} {problem}")

    def has(self, key):
        return self.values.get(key) is not None

    def get(self, key, expected, is_right, default=REQUIRED):
        """The entry of a key; `default` where it is absent or empty."""
        value = self.values.get(key)
        if value is None and default is not REQUIRED:
            return default
        if value is None:
            missing = "is empty" if key in self.values else "is missing"
            keys = ", ".join(str(key)[:40] for key in list(self.values)[:12])
            raise self.refuse(key, f"{missing}, expected is {expected}; the entries there are {keys}")
        if not is_right(value):
            raise self.refuse(key, f"is {shortened(value)}, expected is {expected}")
        return value

    def section(self, key, default=REQUIRED):
        """A part of this part; with a default of None, nothing where it is absent."""
        values = self.get(key, "a group of entries", lambda value: isinstance(value, dict), default)
        return values if values is default else Section(values, self.label, f"{self.name}{key}.")

    def text(self, key, default=REQUIRED):
        return self.get(key, "a name", lambda value: isinstance(value, str), default)

    def choice(self, key, choices, default=REQUIRED):
        """The value in `choices` for an entry."""
        names = " or ".join(choices)
        return choices[self.get(key, names, lambda value: isinstance(value, str) and value in choices, default)]

    def flag(self, key, default=REQUIRED):
        return self.get(key, "true or false", lambda value: isinstance(value, bool), default)

    def integer(self, key, default=REQUIRED):
        return self.get(key, "a whole number", is_integer, default)

    def number(self, key, default=REQUIRED):
        value = self.get(key, "a number", is_number, default)
        return value if value is default else float(value)

    def integers(self, key):
        return self.get(key, "a list of whole numbers", lambda value: is_list(value, is_integer))

    def numbers(self, key, count=None, default=REQUIRED):
        expected = "a list of numbers" if count is None else f"a list of {count} numbers"
        is_right = lambda value: is_list(value, is_number) and count in (None, len(value))  # noqa: E731
        values = self.get(key, expected, is_right, default)
        return [float(value) for value in values]


def is_integer(value):
    return type(value) is int and abs(value) < 1 << 31


def is_number(value):
    return type(value) in (int, float) and abs(value) < 1e9


def is_list(value, is_right):
    return isinstance(value, list) and bool(value) and all(is_right(item) for item in value)


def shortened(value):
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
