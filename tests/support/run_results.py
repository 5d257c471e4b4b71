"""What a run left, to be compared with that of another run: all but manifests, the store and times."""

import json
from pathlib import Path
from typing import Any

TIMES = {"seconds", "timing_s", "checksum"}  # a checksum is of the times too


def files(folder: Path) -> set[str]:
    """Names of all files in a run folder."""
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file() or p.is_symlink()}


def results(folder: Path) -> dict[str, Any]:
    """Contents of all files but manifests and the store, without times."""
    names = [n for n in files(folder) if not n.startswith("store/") and not n.endswith("manifest.json")]
    paths = {name: folder / name for name in names}
    return {n: timeless(json.loads(p.read_text())) if p.suffix == ".json" else p.read_bytes() for n, p in paths.items()}


def timeless(content: Any) -> Any:
    """Return content without what differs from run to run."""
    if isinstance(content, dict):
        return {k: timeless(v) for k, v in content.items() if k not in TIMES}
    return [timeless(v) for v in content] if isinstance(content, list) else content
