"""Disk that forgets what was not synced: its operations are read from a trace of a real program, and cut anywhere.

A trace of strace holds, in their order, the calls that change files below a folder, with all bytes, the lines that the
program prints, and the ends of its processes. The disk applies them one by one. After a power cut it holds

- of each file what was synced, and of the later writes a random part: in half of the cuts the file ends there, in the
  other half it has its length and zeros from there on, as ext4 and xfs leave it;
- of each folder the names that were synced, and of the later changes (new, renamed and removed files and folders) the
  first few, in their order: in half of the cuts up to one moment for all folders, as a journal keeps them, in the other
  half each folder up to its own. Only a sync of that folder, or of the whole file system, keeps a name: that of the file
  does not.

A call that has no model here (a copy within the kernel, links, mapped memory that is written) is refused: `NotModelled`.
"""

import os
import pathlib
import re
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

SYNCS = ("fsync", "fdatasync", "syncfs", "sync")
WRITES = ("write", "pwrite64", "writev", "pwritev", "pwritev2")
RESIZES = ("ftruncate", "truncate")
NAMES = ("rename", "renameat", "renameat2", "unlink", "unlinkat", "rmdir", "mkdir", "mkdirat")
OPENS = ("open", "openat", "creat")
# Refused where they are of a file below the folder.
REFUSED = ("openat2", "copy_file_range", "sendfile", "splice", "fallocate", "link", "linkat", "symlink", "symlinkat", "mmap",
           "msync", "chdir", "fchdir", "io_uring_setup")
CALLS = (*SYNCS, *WRITES, *RESIZES, *NAMES, *OPENS, *REFUSED, "lseek", "execve")
# Longer writes would be shortened in the trace; strace has memory for one.
LONGEST = 1 << 26

DESCRIPTOR = re.compile(rb"\w+\((?:AT_FDCWD|\d+)<([^>]*)>")
PATHS = re.compile(rb'(?:(?:AT_FDCWD|\d+)<([^>]*)>, )?"([^"]*)"')
STRING = re.compile(rb'"([^"]*)"(\.\.\.)?')
RESULT = re.compile(rb"\) += (-?\d+)(?:<([^>]*)>)?")
LAST_NUMBER = re.compile(rb", (\d+)\) += \d")


class NotModelled(Exception):
    """A call that the disk has no model of, or a trace that differs from what is on the real disk."""


@dataclass
class Event:
    """A call that has ended, a printed line, or the end of a process."""

    # "open", "write", "resize", "seek", "rename", "remove", "make", "sync", "printed" or "ended".
    kind: str
    path: str = ""
    # Second path of a renaming; the printed line; the command of a process that ended.
    text: str = ""
    data: bytes = b""
    # Offset of a write that has one, length of a resized file, position of a seek.
    place: int | None = None
    flags: bytes = b""
    # Number of events that had ended when the call began.
    began: int = 0

    @property
    def is_report(self) -> bool:
        return self.kind in ("printed", "ended")


def can_trace() -> bool:
    """True if strace is there and may trace."""
    if not shutil.which("strace"):
        return False
    words = ["strace", "-f", "--seccomp-bpf", "-o", os.devnull, "-e", "trace=open", "true"]
    return subprocess.run(words, capture_output=True).returncode == 0


def trace(command: Iterable, folder: pathlib.Path, scratch: pathlib.Path) -> tuple[list[Event], int]:
    """Runs a command in a folder, which is empty; its events and its exit code."""
    file, printed = scratch / "trace", scratch / "printed"
    options = ["-f", "-y", "-xx", "-s", str(LONGEST), "--seccomp-bpf", "-o", file, "-e", f"trace={','.join(CALLS)}"]
    with printed.open("wb") as output:
        done = subprocess.run(["strace", *options, *command], cwd=folder, stdin=subprocess.DEVNULL, stdout=output,
                              stderr=subprocess.STDOUT)
    reader = TraceReader(folder, printed)
    with file.open("rb") as lines:
        for line in lines:
            reader.line(line)
    file.unlink()
    return reader.events, done.returncode


def unhex(text: bytes) -> bytes:
    return bytes.fromhex(text.replace(b"\\x", b"").decode())


class TraceReader:
    """Events from the lines of strace."""

    def __init__(self, folder: pathlib.Path, printed: pathlib.Path):
        self.folder, self.printed = str(folder.resolve()), str(printed.resolve())
        self.events: list[Event] = []
        # First part of a call that another thread interrupted in the trace, by thread.
        self.begun: dict[bytes, tuple[int, bytes]] = {}
        self.commands: dict[bytes, str] = {}
        self.unfinished_line = b""

    def line(self, line: bytes) -> None:
        thread, _, text = line.partition(b" ")
        text = text.strip()
        began = len(self.events)
        if text.startswith(b"+++ exited"):
            if thread in self.commands:
                self.add("ended", text=self.commands[thread])
            return
        if text.endswith(b"<unfinished ...>"):
            self.begun[thread] = began, text.removesuffix(b"<unfinished ...>")
            return
        if text.startswith(b"<... "):
            began, first = self.begun.pop(thread)
            text = first + text.partition(b" resumed>")[2]
        name, bracket, _ = text.partition(b"(")
        result = RESULT.search(text, text.rfind(b") "))
        if bracket and result and not result[1].startswith(b"-"):
            self.call(name.decode(), text, result, thread, began)

    def call(self, name: str, text: bytes, result: re.Match, thread: bytes, began: int) -> None:
        if name == "execve":
            self.commands[thread] = " ".join(unhex(word).decode() for word, _ in STRING.findall(text)[1:])
        elif name in OPENS:
            self.opened(text, result, began)
        elif name in NAMES:
            self.renamed(name, text, began)
        elif name in REFUSED:
            self.refuse(name, text)
        elif name == "sync":
            self.add("sync", path="/", began=began)
        elif (path := self.descriptor(text)) == self.printed:
            self.print(b"".join(unhex(data) for data, _ in STRING.findall(text))[:int(result[1])])
        elif (path := self.inside(path)) is not None:
            self.changed(name, path, text, int(result[1]), began)

    def changed(self, name: str, path: str, text: bytes, result: int, began: int) -> None:
        if name in SYNCS:
            self.add("sync", path="/" if name == "syncfs" else path, began=began)
        elif name == "lseek":
            self.add("seek", path=path, place=result, began=began)
        elif name in RESIZES:
            self.add("resize", path=path, place=int(LAST_NUMBER.search(text)[1]), began=began)
        else:
            strings = STRING.findall(text)
            if any(shortened for _, shortened in strings):
                raise NotModelled(f"{name} of more than {LONGEST} bytes: {path}")
            data = b"".join(unhex(data) for data, _ in strings)[:result]
            place = int(LAST_NUMBER.search(text)[1]) if name.startswith("p") else None
            self.add("write", path=path, data=data, place=place, began=began)

    def opened(self, text: bytes, result: re.Match, began: int) -> None:
        flags = text[:result.start()].rpartition(b'", ')[2]
        if not re.search(rb"O_WRONLY|O_RDWR|O_CREAT|O_TRUNC|O_TMPFILE", flags) and not text.startswith(b"creat("):
            return
        path = self.inside(unhex(result[2]).decode())
        if path is None:
            return
        if b"O_TMPFILE" in flags or text.startswith(b"creat("):
            raise NotModelled(f"a file without a name, or creat: {path}")
        self.add("open", path=path, flags=flags, began=began)

    def renamed(self, name: str, text: bytes, began: int) -> None:
        named = [os.path.join(unhex(base).decode() or self.folder, unhex(path).decode()) for base, path in PATHS.findall(text)]
        paths = [self.inside(path) for path in named]
        if all(path is None for path in paths):
            return
        if None in paths or b"RENAME_EXCHANGE" in text:
            raise NotModelled(f"{name}: {named}")
        kind = "rename" if name.startswith("rename") else "make" if name.startswith("mkdir") else "remove"
        self.add(kind, path=paths[0], text=paths[-1], began=began)

    def refuse(self, name: str, text: bytes) -> None:
        """Refuses a call that concerns the folder; mapped memory only if it is shared and written."""
        if name == "mmap" and not (b"MAP_SHARED" in text and b"PROT_WRITE" in text):
            return
        paths = [unhex(path).decode() for path in re.findall(rb"<((?:\\x[0-9a-f]{2})+)>", text)]
        paths += [os.path.join(self.folder, unhex(path).decode()) for path in re.findall(rb'"((?:\\x[0-9a-f]{2})+)"', text)]
        if name == "io_uring_setup" or any(self.inside(path) is not None for path in paths):
            raise NotModelled(f"{name}: {paths}")

    def descriptor(self, text: bytes) -> str:
        found = DESCRIPTOR.match(text)
        return unhex(found[1]).decode() if found and found[1].startswith(b"\\x") else ""

    def inside(self, path: str) -> str | None:
        """Path below the folder, "" for itself; None elsewhere."""
        path = os.path.normpath(path)
        if path == self.folder:
            return ""
        return path.removeprefix(self.folder + "/") if path.startswith(self.folder + "/") else None

    def print(self, data: bytes) -> None:
        *lines, self.unfinished_line = (self.unfinished_line + data).split(b"\n")
        for line in lines:
            self.add("printed", text=line.decode(errors="replace"))

    def add(self, kind: str, **fields) -> None:
        self.events.append(Event(kind, **{"began": len(self.events), **fields}))


@dataclass
class File:
    """A file: its bytes, those that are on the disk in any case, and the writes since."""

    content: bytearray = field(default_factory=bytearray)
    synced: bytearray = field(default_factory=bytearray)
    # Number of the event, offset and bytes; a resize has its length and no bytes.
    pending: list[tuple[int, int, bytes | None]] = field(default_factory=list)
    # Of the next write without an offset.
    position: int = 0
    appends: bool = False

    def change(self, number: int, place: int, data: bytes | None) -> None:
        change(self.content, place, data)
        self.pending.append((number, place, data))

    def sync(self, before: int) -> None:
        for _, place, data in (one for one in self.pending if one[0] < before):
            change(self.synced, place, data)
        self.pending = [one for one in self.pending if one[0] >= before]

    def after_cut(self, random) -> bytes:
        sizes = [1 if data is None else len(data) for _, _, data in self.pending]
        # Nothing and everything are as likely as all that lies between: a disk writes late, or at once.
        left = random.choice((0, sum(sizes), random.randint(0, sum(sizes)), random.randint(0, sum(sizes))))
        found = bytearray(self.synced)
        for (_, place, data), size in zip(self.pending, sizes):
            if left <= 0:
                break
            change(found, place, data if data is None else data[:left])
            left -= size
        if random.random() < 0.5:
            found.extend(bytes(max(0, len(self.content) - len(found))))
        return bytes(found)


def change(content: bytearray, place: int, data: bytes | None) -> None:
    """Writes at a place, or resizes to it."""
    if len(content) < place:
        content.extend(bytes(place - len(content)))
    if data is None:
        del content[place:]
    else:
        content[place:place + len(data)] = data


@dataclass
class Folder:
    """A folder: its names, those that are on the disk in any case, and the changes since."""

    names: dict = field(default_factory=dict)
    synced: dict = field(default_factory=dict)
    # Number of the event, and what each name stands for since: a file, a folder, or None.
    pending: list[tuple[int, dict]] = field(default_factory=list)

    def change(self, number: int, names: dict) -> None:
        update(self.names, names)
        self.pending.append((number, names))

    def sync(self, before: int) -> None:
        for _, names in (one for one in self.pending if one[0] < before):
            update(self.synced, names)
        self.pending = [one for one in self.pending if one[0] >= before]

    def after_cut(self, random, journal: int | None) -> dict:
        """Names after a cut; `journal` is the number of events that the file system has a journal of."""
        found = dict(self.synced)
        count = random.randint(0, len(self.pending)) if journal is None else sum(number < journal for number, _ in self.pending)
        for _, names in self.pending[:count]:
            update(found, names)
        return found


def update(names: dict, changes: dict) -> None:
    for name, stands_for in changes.items():
        if stands_for is None:
            names.pop(name, None)
        else:
            names[name] = stands_for


class Disk:
    """The folder of a trace on such a disk."""

    def __init__(self, forgets_syncs: bool = False):
        self.root = Folder()
        self.forgets_syncs = forgets_syncs
        self.number = 0
        # Files that a name has stood for, with the number of the event.
        self.versions: dict[str, list[tuple[int, File]]] = {}

    def apply(self, event: Event) -> None:
        if not event.is_report:
            getattr(self, event.kind)(event)
        self.number += 1

    def open(self, event: Event) -> None:
        file = self.find(event.path)
        if file is None:
            if b"O_CREAT" not in event.flags:
                return
            file = File()
            self.name(event.path, file)
        elif b"O_TRUNC" in event.flags and file.content:
            file.change(self.number, 0, None)
        file.position, file.appends = 0, b"O_APPEND" in event.flags

    def write(self, event: Event) -> None:
        # None: its name is gone.
        if isinstance(file := self.find(event.path), File):
            place = event.place
            if place is None:
                place = len(file.content) if file.appends else file.position
                file.position = place + len(event.data)
            file.change(self.number, place, event.data)

    def resize(self, event: Event) -> None:
        if isinstance(file := self.find(event.path), File) and len(file.content) != event.place:
            file.change(self.number, event.place, None)

    def seek(self, event: Event) -> None:
        if isinstance(file := self.find(event.path), File):
            file.position = event.place

    def rename(self, event: Event) -> None:
        (folder, old), (target, new) = self.place(event.path), self.place(event.text)
        if folder is not target:
            raise NotModelled(f"renamed into another folder: {event.path} to {event.text}")
        node = folder.names[old]
        folder.change(self.number, {old: None, new: node})
        self.remember(event.text, node)

    def remove(self, event: Event) -> None:
        folder, name = self.place(event.path)
        folder.change(self.number, {name: None})

    def make(self, event: Event) -> None:
        self.name(event.path, Folder())

    def sync(self, event: Event) -> None:
        if self.forgets_syncs:
            return
        if event.path == "/":
            for node in self.nodes(self.root):
                node.sync(event.began)
        elif (node := self.find(event.path)) is not None:
            node.sync(event.began)

    def name(self, path: str, node) -> None:
        folder, name = self.place(path)
        folder.change(self.number, {name: node})
        self.remember(path, node)

    def remember(self, path: str, node) -> None:
        if isinstance(node, File):
            self.versions.setdefault(path, []).append((self.number, node))

    def place(self, path: str) -> tuple[Folder, str]:
        folder, _, name = path.rpartition("/")
        return self.find(folder), name

    def find(self, path: str):
        node = self.root
        for name in filter(None, path.split("/")):
            node = node.names.get(name) if isinstance(node, Folder) else None
        return node

    def nodes(self, folder: Folder) -> Iterator:
        """Everything that is or was below a folder, and itself."""
        yield folder
        for node in {id(node): node for names in (folder.names, folder.synced) for node in names.values()}.values():
            if isinstance(node, Folder):
                yield from self.nodes(node)
            else:
                yield node

    def files(self, under: str = "") -> dict[str, File]:
        """Files by path, without a power cut."""
        folder = self.find(under)
        return dict(self.below(folder, under)) if isinstance(folder, Folder) else {}

    def below(self, folder: Folder, under: str) -> Iterator[tuple[str, File]]:
        for name, node in folder.names.items():
            path = f"{under}/{name}" if under else name
            if isinstance(node, Folder):
                yield from self.below(node, path)
            else:
                yield path, node

    def now(self) -> "State":
        """What is there without a power cut."""
        folders = {str(parent) for path in self.files() for parent in pathlib.PurePath(path).parents} - {"."}
        return State(sorted(folders), {path: bytes(file.content) for path, file in self.files().items()})

    def after_cut(self, random) -> "State":
        state = State()
        journal = random.randint(0, self.number) if random.random() < 0.5 else None
        self.cut_folder(self.root, "", random, journal, state)
        return state

    def cut_folder(self, folder: Folder, under: str, random, journal: int | None, state: "State") -> None:
        for name, node in folder.after_cut(random, journal).items():
            path = f"{under}/{name}" if under else name
            if isinstance(node, Folder):
                state.folders.append(path)
                self.cut_folder(node, path, random, journal, state)
            else:
                state.files[path] = node.after_cut(random)
                if state.files[path] != node.content:
                    state.damaged.append(path)


@dataclass
class State:
    """What a power cut leaves."""

    folders: list[str] = field(default_factory=list)
    files: dict[str, bytes] = field(default_factory=dict)
    # Files that do not hold what was written.
    damaged: list[str] = field(default_factory=list)

    def write(self, folder: pathlib.Path) -> None:
        """Writes it into a folder, which is made anew."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        for path in self.folders:
            (folder / path).mkdir()
        for path, content in self.files.items():
            (folder / path).write_bytes(content)


def check(disk: Disk, folder: pathlib.Path) -> None:
    """Compares the disk, before a power cut, with the real folder."""
    modelled = {path: bytes(file.content) for path, file in disk.files().items()}
    real = {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    for path in sorted({*modelled, *real}):
        if modelled.get(path) != real.get(path):
            raise NotModelled(f"the trace does not give the content of {path}")
