"""Error of the readers of a checkpoint."""

FLOATS = {"F16": 2, "BF16": 2, "F32": 4, "F64": 8}
SIZES = FLOATS | {"I64": 8, "I32": 4, "I16": 2, "I8": 1, "U8": 1, "BOOL": 1}
EXPECTED = "expected is the state dictionary of a model, as torch.save(model.state_dict(), path) writes it"
MAX_FILE_BYTES = 4 << 30


class Refused(Exception):
    """The checkpoint or its configuration cannot be converted; the text begins with the file."""
