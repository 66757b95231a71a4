"""Files of the safetensors format: length of the header, header, data."""

import json
import math
import struct

from opencood_refused import EXPECTED, SIZES, Refused


def read_safetensors(path):
    """Name -> (dtype, shape, little-endian bytes) of every tensor, and the texts of the header."""
    data = path.read_bytes()
    if len(data) < 8:
        raise Refused(f"{path}: {len(data)} bytes are no safetensors file; {EXPECTED}")
    (length,) = struct.unpack("<Q", data[:8])
    if length > len(data) - 8:
        raise Refused(f"{path}: its header claims {length} of {len(data)} bytes: cut off, or no safetensors file")
    try:
        header = json.loads(data[8 : 8 + length])
        metadata = header.pop("__metadata__", {})
        # Archives that hold more than weights have these under w.*.
        weights = {name[2:]: entry for name, entry in header.items() if name.startswith("w.")}
        body = memoryview(data)[8 + length :]
        tensors = {name: entry_of(entry, body) for name, entry in (weights or header).items()}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise Refused(f"{path}: the header is not one of a safetensors file ({error})") from error
    return tensors, metadata


def entry_of(entry, body):
    (begin, end), dtype, shape = entry["data_offsets"], entry["dtype"], entry["shape"]
    if not 0 <= begin <= end <= len(body) or end - begin != math.prod(shape) * SIZES[dtype]:
        raise ValueError(f"a tensor of {dtype} {shape} at bytes {begin} to {end} of {len(body)}")
    return dtype, shape, bytes(body[begin:end])


def write_safetensors(path, tensors, header):
    """Writes tensors as read_safetensors gives them, and texts or JSON into the header."""
    entries, offset = {}, 0
    for name in sorted(tensors):
        dtype, shape, raw = tensors[name]
        entries[name] = {"dtype": dtype, "shape": shape, "data_offsets": [offset, offset + len(raw)]}
        offset += len(raw)
    texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in header.items()}
    text = json.dumps({"__metadata__": texts} | entries).encode()
    text += b" " * (-len(text) % 8)
    with path.open("wb") as file:
        file.write(struct.pack("<Q", len(text)) + text)
        for name in sorted(tensors):
            file.write(tensors[name][2])
