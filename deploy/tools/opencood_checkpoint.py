"""Tensors of a checkpoint file, read without running anything that the file names.

A `.pth` file is a pickle: to load one is to run what it asks for. Here every class and function of a pickle is an inert
stub, but for the few that a tensor is made of; so a whole pickled model can be read for its tensors too. Nothing but the
standard library is needed.
"""

import io
import json
import math
import pickle
import struct
import zipfile
import zlib
from collections import OrderedDict, namedtuple

FLOATS = {"F16": 2, "BF16": 2, "F32": 4, "F64": 8}
SIZES = FLOATS | {"I64": 8, "I32": 4, "I16": 2, "I8": 1, "U8": 1, "BOOL": 1}
STORAGES = {
    "FloatStorage": "F32", "DoubleStorage": "F64", "HalfStorage": "F16", "BFloat16Storage": "BF16", "LongStorage": "I64",
    "IntStorage": "I32", "ShortStorage": "I16", "CharStorage": "I8", "ByteStorage": "U8", "BoolStorage": "BOOL",
}  # fmt: skip
# Keys under which training loops keep the state dictionary, the likeliest first.
STATE_KEYS = ("model_state_dict", "state_dict", "model_state", "model", "net", "network", "weights")
# What wraps a model puts its own name before every tensor's.
WRAPPERS = ("module.", "_orig_mod.")
EXPECTED = "expected is the state dictionary of a model, as torch.save(model.state_dict(), path) writes it"
# The first pickle of a file that torch wrote before version 1.6.
LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
MAX_FILE_BYTES = 4 << 30
MAX_PICKLE_BYTES = 64 << 20
MAX_DEPTH = 64

DtypeOfStorage = namedtuple("DtypeOfStorage", "dtype")
Lazy = namedtuple("Lazy", "storage offset size stride")


class Refused(Exception):
    """The checkpoint or its configuration cannot be converted; the text begins with the file."""


class Storage:
    """Values of one type; `raw` is set once they are read."""

    def __init__(self, dtype, count, raw=b""):
        self.dtype, self.count, self.raw = dtype, count, raw

    def __setstate__(self, state):
        raise pickle.UnpicklingError("a storage with a state of its own")


class State(OrderedDict):
    """A dictionary whose attributes, which torch keeps versions in, nobody reads."""

    def __setstate__(self, _state):
        pass


class Stub:
    """An object of a class that is not known here: keeps its attributes and does nothing."""

    def __new__(cls, *_arguments, **_named):
        return object.__new__(cls)

    def __init__(self, *_arguments, **_named):
        self.attributes = {}

    def __setstate__(self, state):
        self.attributes = state if isinstance(state, dict) else {}

    def __setitem__(self, _key, _value):
        pass

    def append(self, _item):
        """As a list that nobody reads."""

    def extend(self, _items):
        """As a list that nobody reads."""

    def add(self, _item):
        """As a set that nobody reads."""


def read_checkpoint(path):
    """Name -> (dtype, shape, little-endian bytes) of every tensor, the texts of the header, and what it was read out of."""
    size = path.stat().st_size
    with path.open("rb") as file:
        begin = file.read(512)
    what = not_a_checkpoint(begin, size)
    if what is not None:
        raise Refused(f"{path}: {what}; {EXPECTED}, or a safetensors file")
    if is_safetensors(begin):
        return (*read_safetensors(path), None)
    loaded = read_zip(path) if begin.startswith(b"PK") else read_legacy(path, size)
    state, source = state_dictionary(path, loaded)
    return materialized(path, state), {}, source


def not_a_checkpoint(begin, size):
    """What a file is that is no checkpoint at all, by its first bytes."""
    if size == 0:
        return "an empty file"
    if size > MAX_FILE_BYTES:
        return f"{size} bytes, at most {MAX_FILE_BYTES} are read"
    if begin.startswith(b"version https://git-lfs"):
        return "a Git LFS pointer instead of the file it stands for (`git lfs pull` fetches that)"
    if begin.lstrip()[:5].lower() in (b"<!doc", b"<html"):
        return "a web page"
    if is_safetensors(begin) or begin.startswith((b"PK\x03\x04", b"\x80")):
        return None
    return f"a file that begins with {begin[:8]!r}, which neither torch nor safetensors writes"


def is_safetensors(begin):
    """Eight bytes with the length of a JSON object, and the object."""
    return begin[5:9] == b"\0\0\0{"


# --- what torch writes


class Unpickler(pickle._Unpickler):
    """A pickle whose classes and functions are stubs, but for what tensors are made of.

    The unpickler that is written in Python: its memo grows with what is there, not with what a file claims.
    """

    def __init__(self, file, storage_of):
        super().__init__(file, encoding="utf-8")
        self.storage_of = storage_of

    def find_class(self, module, name):
        if module.split(".")[0] == "torch" and name in STORAGES:
            return DtypeOfStorage(STORAGES[name])
        return TENSOR_PARTS.get((module, name)) or type(name, (Stub,), {"__module__": module})

    def persistent_load(self, pid):
        kind, dtype, key, _location, count, *view = pid
        if kind != "storage" or not isinstance(dtype, DtypeOfStorage) or not isinstance(count, int) or count < 0:
            raise pickle.UnpicklingError(f"{str(pid)[:80]} is no storage of numbers")
        return self.storage_of(str(key), dtype.dtype, count, view[0] if view else None)


def lazy_tensor(storage, offset, size, stride, *_others):
    if not isinstance(storage, Storage):
        raise pickle.UnpicklingError("a tensor without a storage")
    numbers = (offset, *size, *stride)
    if not all(type(number) is int and number >= 0 for number in numbers) or len(size) != len(stride):
        raise pickle.UnpicklingError(f"a tensor of size {size}, stride {stride} from {offset} on")
    return Lazy(storage, offset, tuple(size), tuple(stride))


def of_type(function, _type, arguments, _state):
    """A tensor of a subclass is a tensor."""
    return function(*arguments) if function is lazy_tensor else Stub()


TENSOR_PARTS = {
    ("torch._utils", "_rebuild_tensor"): lazy_tensor,
    ("torch._utils", "_rebuild_tensor_v2"): lazy_tensor,
    ("torch._utils", "_rebuild_parameter"): lambda data, *_others: data,
    ("torch._utils", "_rebuild_parameter_with_state"): lambda data, *_others: data,
    ("torch._tensor", "_rebuild_from_type_v2"): of_type,
    ("torch", "Size"): tuple,
    ("collections", "OrderedDict"): State,
    ("__builtin__", "set"): set,
    ("builtins", "set"): set,
}


def read_zip(path):
    """The object of a file of torch 1.6 or newer: a zip archive of a pickle and its storages."""
    try:
        with zipfile.ZipFile(path) as archive:
            return read_archive(path, archive)
    except (zipfile.BadZipFile, zlib.error, RuntimeError, EOFError, ValueError, struct.error) as error:
        size = path.stat().st_size
        raise Refused(f"{path}: a zip archive that is cut off or damaged ({size} bytes: {error}); {EXPECTED}") from error


def read_archive(path, archive):
    names = archive.namelist()
    pickles = [name for name in names if name == "data.pkl" or name.endswith("/data.pkl")]
    if any("/code/" in name for name in names):
        raise Refused(f"{path}: a TorchScript program; {EXPECTED}")
    if len(pickles) != 1:
        raise Refused(f"{path}: a zip archive with {len(pickles)} files data.pkl, so none of torch.save; {EXPECTED}")
    folder = pickles[0].removesuffix("data.pkl")
    if folder + "byteorder" in names and read_member(archive, folder + "byteorder", 16) != b"little":
        raise Refused(f"{path}: written on a big-endian machine; little-endian files are read")
    storages = {}

    def storage_of(key, dtype, count, _view):
        if key not in storages:
            wanted = count * SIZES[dtype]
            if wanted + sum(len(storage.raw) for storage in storages.values()) > MAX_FILE_BYTES:
                raise pickle.UnpicklingError(f"storages of more than {MAX_FILE_BYTES} bytes")
            raw = read_member(archive, f"{folder}data/{key}", wanted)
            if len(raw) != wanted:
                raise pickle.UnpicklingError(f"storage {key} has {len(raw)} bytes, {wanted} are claimed")
            storages[key] = Storage(dtype, count, raw)
        return storages[key]

    return unpickle(path, io.BytesIO(read_member(archive, pickles[0], MAX_PICKLE_BYTES)), storage_of)


def read_member(archive, name, limit):
    """A file of an archive: no more than `limit` bytes of it, whatever it claims."""
    try:
        with archive.open(name) as file:
            return file.read(limit)
    except KeyError as error:
        raise zipfile.BadZipFile(f"{name} is missing") from error


def read_legacy(path, size):
    """The object of a file of torch 1.5 or older: pickles one after the other, then the storages."""
    storages = OrderedDict()

    def storage_of(key, dtype, count, view):
        if view is not None:
            raise pickle.UnpicklingError(f"storage {key} is a view of another")
        return storages.setdefault(key, Storage(dtype, count))

    with path.open("rb") as file:
        if unpickle(path, file, storage_of) != LEGACY_MAGIC:
            raise Refused(f"{path}: a pickle, but none that torch.save has written; {EXPECTED}")
        _protocol, _system, loaded, keys = [unpickle(path, file, storage_of) for _ in range(4)]
        for key in keys if isinstance(keys, list) else []:
            storage = storages.get(str(key))
            count = file.read(8)
            if storage is None or len(count) != 8 or struct.unpack("<q", count)[0] != storage.count:
                raise Refused(f"{path}: cut off or damaged: storage {key} is not where it should be; {EXPECTED}")
            storage.raw = file.read(min(storage.count * SIZES[storage.dtype], size))
    return loaded


def unpickle(path, file, storage_of):
    try:
        return Unpickler(file, storage_of).load()
    except (Refused, zipfile.BadZipFile):
        raise
    # Whatever a pickle makes its reader trip over.
    except Exception as error:
        raise Refused(f"{path}: a pickle that is cut off or damaged ({type(error).__name__}: {error}); {EXPECTED}") from error


# --- the state dictionary in it


def is_tensor(value):
    return isinstance(value, Lazy)


def state_dictionary(path, loaded, depth=0):
    """The tensors by name, and what they had to be taken out of."""
    if isinstance(loaded, Stub) and "_parameters" in loaded.attributes:
        whole = f"{type(loaded).__module__}.{type(loaded).__name__}"
        return dict(of_module(loaded, "", 0)), f"a whole pickled model of class {whole}"
    if not isinstance(loaded, dict):
        kind = f"{type(loaded).__module__}.{type(loaded).__name__}".removeprefix("builtins.")
        raise Refused(f"{path}: a pickled object of type {kind}; {EXPECTED}")
    if any(is_tensor(value) for value in loaded.values()):
        return checked_names(path, loaded), None
    inner = [key for key in STATE_KEYS if holds_tensors(loaded.get(key))]
    inner = inner or [key for key, value in loaded.items() if isinstance(key, str) and holds_tensors(value)]
    if not inner or depth > 4:
        keys = ", ".join(repr(key)[:40] for key in list(loaded)[:8]) or "no key at all"
        raise Refused(f"{path}: a dictionary without tensors (its keys: {keys}); {EXPECTED}")
    if len(inner) > 1 and inner[0] not in STATE_KEYS:
        raise Refused(f"{path}: {len(inner)} state dictionaries, under {', '.join(inner)}; {EXPECTED}")
    state, source = state_dictionary(path, loaded[inner[0]], depth + 1)
    return state, source or f"its key {inner[0]!r}"


def holds_tensors(value, depth=0):
    if isinstance(value, Stub):
        return "_parameters" in value.attributes
    if not isinstance(value, dict) or depth > 4:
        return False
    return any(is_tensor(inner) for inner in value.values()) or any(
        holds_tensors(value.get(key), depth + 1) for key in STATE_KEYS
    )


def of_module(module, prefix, depth):
    """The parameters and buffers of a pickled module and of those inside it."""
    parts = [module.attributes.get(part) for part in ("_parameters", "_buffers", "_modules")]
    parameters, buffers, inner = [part if isinstance(part, dict) else {} for part in parts]
    for name, value in [*parameters.items(), *buffers.items()]:
        if is_tensor(value):
            yield f"{prefix}{name}", value
    for name, value in inner.items():
        if isinstance(value, Stub) and depth < MAX_DEPTH:
            yield from of_module(value, f"{prefix}{name}.", depth + 1)


def checked_names(path, state):
    for name, value in state.items():
        if not isinstance(name, str) or not is_tensor(value):
            kind = type(value).__name__
            raise Refused(f"{path}: entry {name!r} of the state dictionary is of type {kind}, expected is a tensor")
    return state


def materialized(path, state):
    tensors, total = {}, 0
    for name, tensor in state.items():
        values = gathered(path, name, tensor)
        total += len(values)
        if total > MAX_FILE_BYTES:
            raise Refused(f"{path}: its tensors take more than {MAX_FILE_BYTES} bytes")
        tensors[name] = (tensor.storage.dtype, list(tensor.size), values)
    return unwrapped(path, tensors)


def unwrapped(path, tensors):
    """The same without the prefixes of what wraps a model: DataParallel, a compiled model, a training harness."""
    while tensors and all(name.startswith("model.") for name in tensors):
        tensors = {name.removeprefix("model."): tensor for name, tensor in tensors.items()}
    names = {}
    for name in tensors:
        short = name
        while short.startswith(WRAPPERS):
            short = short.removeprefix("module.").removeprefix("_orig_mod.")
        if short in names:
            raise Refused(f"{path}: tensors {names[short]!r} and {name!r} have the same name without their prefix")
        names[short] = name
    return {short: tensors[name] for short, name in names.items()}


def gathered(path, name, tensor):
    """The values of a tensor in row-major order."""
    storage, offset, size, stride = tensor
    count = math.prod(size)
    last = offset + sum((extent - 1) * step for extent, step in zip(size, stride))
    width = SIZES[storage.dtype]
    held = len(storage.raw) // width
    if count and (count > held or last >= held):
        raise Refused(f"{path}: tensor {name!r} of {size} reads value {last} of a storage of {held}: cut off or damaged")

    def read(offset, size, stride):
        expected = [math.prod(size[axis + 1 :]) for axis in range(len(size))]
        if all(extent == 1 or step == usual for extent, step, usual in zip(size, stride, expected)):
            return storage.raw[offset * width : (offset + math.prod(size)) * width]
        return b"".join(read(offset + row * stride[0], size[1:], stride[1:]) for row in range(size[0]))

    return read(offset, size, stride) if count else b""


# --- safetensors


def read_safetensors(path):
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
    return unwrapped(path, tensors), metadata


def entry_of(entry, body):
    (begin, end), dtype, shape = entry["data_offsets"], entry["dtype"], entry["shape"]
    if not 0 <= begin <= end <= len(body) or end - begin != math.prod(shape) * SIZES[dtype]:
        raise ValueError(f"a tensor of {dtype} {shape} at bytes {begin} to {end} of {len(body)}")
    return dtype, shape, bytes(body[begin:end])


def write_safetensors(path, tensors, header):
    """Writes a file of the safetensors format: length of the header, header, data."""
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
