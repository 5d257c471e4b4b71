"""A headless Chromium for tests of pages: one is looked for, none is installed."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome-headless-shell")
_OPTIONS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--hide-scrollbars",
    "--virtual-time-budget=20000",
    "--enable-logging=stderr",
)
_FRAME = """<!DOCTYPE html><meta charset="utf-8"><body><pre id="found"></pre><script>
const page = {page}, probe = new Function("frame", "page", "width", {probe}), found = {{}}, widths = {widths};
const next = () => {{
  if (!widths.length) {{ document.getElementById("found").textContent = JSON.stringify(found); return; }}
  const width = widths.shift(), frame = Object.assign(document.createElement("iframe"), {{ width, height: 900, srcdoc: page }});
  frame.onload = () => {{
    try {{ found[width] = probe(frame.contentWindow, frame.contentDocument, width); }} catch (error) {{ found[width] = String(error); }}
    frame.remove(); next();
  }};
  document.body.append(frame);
}};
next();
</script>"""


def chromium() -> str:
    """Return the browser's path, or skip the test with a message."""
    found = next((path for name in _NAMES if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(f"no headless browser: none of {', '.join(_NAMES)} is installed")
    return found


def probe(page: str, script: str, widths: list[int], folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Run the body of a function of `frame`, `page` and `width` at several widths; return results and the console."""
    texts = {"page": json.dumps(page).replace("</", "<\\/"), "probe": json.dumps(script), "widths": json.dumps(widths)}
    place = folder / "frame.html"
    place.write_text(_FRAME.format(**texts), encoding="utf-8")
    command = [
        chromium(),
        *_OPTIONS,
        f"--user-data-dir={folder / 'profile'}",
        "--window-size=1600,1000",
        "--dump-dom",
        place.as_uri(),
    ]
    run = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    found = re.search(r'<pre id="found">(.*?)</pre>', run.stdout, re.DOTALL)
    assert found, run.stderr[-2000:]
    return json.loads(html.unescape(found[1])), [line for line in run.stderr.splitlines() if "CONSOLE" in line]


def printed_pages(page: str, folder: Path) -> int:
    """Return how many pages of paper a page takes."""
    source, target = folder / "print.html", folder / "print.pdf"
    source.write_text(page, encoding="utf-8")
    command = [
        chromium(),
        *_OPTIONS[:3],
        f"--user-data-dir={folder / 'profile'}",
        f"--print-to-pdf={target}",
        source.as_uri(),
    ]
    subprocess.run(command, capture_output=True, check=True, timeout=120)
    return len(re.findall(rb"/Type\s*/Page\b(?!s)", target.read_bytes()))
