"""Reader of torch.save files as plain objects, without running any code that they name.

Such a file is a pickle: to load one is to run what it asks for. Here every class and function of a pickle is an inert stub,
but for the few that a tensor is made of. Nothing but the standard library is needed.
"""

import io
import pickle
import struct
import zipfile
import zlib
from collections import OrderedDict, namedtuple

from opencood_refused import EXPECTED, MAX_FILE_BYTES, SIZES, Refused

STORAGES = {
    "FloatStorage": "F32", "DoubleStorage": "F64", "HalfStorage": "F16", "BFloat16Storage": "BF16", "LongStorage": "I64",
    "IntStorage": "I32", "ShortStorage": "I16", "CharStorage": "I8", "ByteStorage": "U8", "BoolStorage": "BOOL",
}  # fmt: skip
# The first pickle of a file that torch wrote before version 1.6.
LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
MAX_PICKLE_BYTES = 64 << 20

DtypeOfStorage = namedtuple("DtypeOfStorage", "dtype")
Lazy = namedtuple("Lazy", "storage offset size stride")


class Storage:
    """Values of one type; `raw` is set once they are read."""

    def __init__(self, dtype, count, raw=b""):
        self.dtype, self.count, self.raw = dtype, count, raw

    def __setstate__(self, state):
        raise pickle.UnpicklingError("a storage with a state of its own")


class State(OrderedDict):
    """A dictionary whose attributes, which hold versions of torch, are ignored."""

    def __setstate__(self, _state):
        pass


class Stub:
    """An object of an unknown class: keeps its attributes and does nothing."""

    def __new__(cls, *_arguments, **_named):
        made = object.__new__(cls)
        made.attributes = {}
        return made

    def __init__(self, *_arguments, **_named):
        """Constructor arguments are ignored."""

    def __setstate__(self, state):
        self.attributes = state if isinstance(state, dict) else {}

    def __setitem__(self, _key, _value):
        pass

    def append(self, _item):
        """List items are ignored."""

    def extend(self, _items):
        """List items are ignored."""

    def add(self, _item):
        """Set items are ignored."""


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
    """A file of an archive: at most `limit` bytes of it, independent of its stated size."""
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
    # Any error of the unpickler.
    except Exception as error:
        raise Refused(f"{path}: a pickle that is cut off or damaged ({type(error).__name__}: {error}); {EXPECTED}") from error
