"""Reader of the tensors of a checkpoint file of any training loop."""

import math

from opencood_refused import EXPECTED, MAX_FILE_BYTES, SIZES, Refused
from safetensors_file import read_safetensors
from torch_file import Lazy, Stub, read_legacy, read_zip

# Keys under which training loops keep the state dictionary, the likeliest first.
STATE_KEYS = ("model_state_dict", "state_dict", "model_state", "model", "net", "network", "weights")
# Wrappers of a model put their own names before every tensor's.
WRAPPERS = ("module.", "_orig_mod.")
MAX_DEPTH = 64


def read_checkpoint(path):
    """Name -> (dtype, shape, little-endian bytes) of every tensor, the texts of the header, and its container."""
    size = path.stat().st_size
    with path.open("rb") as file:
        begin = file.read(512)
    what = not_a_checkpoint(begin, size)
    if what is not None:
        raise Refused(f"{path}: {what}; {EXPECTED}, or a safetensors file")
    if is_safetensors(begin):
        tensors, metadata = read_safetensors(path)
        return unwrapped(path, tensors), metadata, None
    loaded = read_zip(path) if begin.startswith(b"PK") else read_legacy(path, size)
    state, source = state_dictionary(path, loaded)
    return materialized(path, state), {}, source


def not_a_checkpoint(begin, size):
    """Kind of a file that is no checkpoint, by its first bytes."""
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


def is_tensor(value):
    return isinstance(value, Lazy)


def state_dictionary(path, loaded, depth=0):
    """The tensors by name, and their container."""
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
    """The same without the prefixes of wrappers: DataParallel, a compiled model, a training harness."""
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
