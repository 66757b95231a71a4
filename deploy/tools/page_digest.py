"""Digest of the page of `v2vloc view`, kept beside each picture of it in `deploy/results/view.json`."""
import hashlib
import json
import pathlib

ROOT = pathlib.Path(__file__).resolve().parents[2]
PAGE = ROOT / "deploy/src/view/page"
FILE = ROOT / "deploy/results/view.json"


def digest() -> str:
    """SHA-256 over names and contents of the files of the page."""
    found = hashlib.sha256()
    for path in sorted(PAGE.iterdir()):
        found.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return found.hexdigest()


def kept() -> dict[str, str]:
    """Digest of the page that each picture shows, by the name of its file."""
    return json.loads(FILE.read_text()) if FILE.is_file() else {}


def write(picture: pathlib.Path) -> None:
    """Notes that a picture shows the page as it is."""
    FILE.write_text(json.dumps(dict(sorted({**kept(), picture.name: digest()}.items())), indent=2) + "\n")


def problems() -> list[str]:
    """Pictures of a page that has changed since."""
    now = digest()
    return [f"{FILE.parent.name}/{name} shows an older page: draw it again (deploy/tools/picture_view.py)"
            for name, shown in kept().items() if shown != now]
