"""A real browser without a display: loads a page, runs a script in it, and tells what came of it."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)

needs_browser = pytest.mark.skipif(
    CHROMIUM is None, reason="needs Chromium (chromium, google-chrome) to click through a page"
)

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--window-size=1000,700",
    "--virtual-time-budget=240000",
)


def run_in_browser(page: str, script: str, folder: Path) -> dict[str, Any]:
    """Load a page in Chromium and return what a script in it answers.

    Args:
        page: HTML.
        script: body of an async function that returns plain values; ``until(test)`` waits for something.
        folder: for the page and the browser's profile.
    """
    assert CHROMIUM is not None
    probe = f"""<script>
    const faults = [];
    addEventListener("error", (event) => faults.push(String(event.message)));
    async function until(test) {{
      for (let k = 0; k < 4000; k++) {{ if (test()) return; await new Promise((done) => setTimeout(done, 25)); }}
      throw new Error("waited in vain for " + test);
    }}
    (async () => {{ {script} }})().catch((error) => ({{ error: String(error) }})).then((outcome) => {{
      const told = document.createElement("pre");
      told.id = "outcome";
      told.textContent = JSON.stringify({{ ...outcome, faults }});
      document.body.append(told);
    }});
    </script></body>"""
    before, _, after = page.rpartition("</body>")
    path = folder / "page.html"
    path.write_text(before + probe + after, encoding="utf-8")
    told: dict[str, Any] = {"error": "the page gave no answer"}
    for attempt in range(3):  # the browser's clock runs ahead of its work where the machine is busy
        profile = folder / f"profile{attempt}"
        command = [CHROMIUM, *FLAGS, f"--user-data-dir={profile}", "--dump-dom", path.as_uri()]
        output = subprocess.run(command, capture_output=True, timeout=180, check=False).stdout.decode("utf-8")
        outcome = re.search(r'<pre id="outcome">(.*?)</pre>', output, flags=re.DOTALL)
        if outcome is not None:
            told = json.loads(html.unescape(outcome.group(1)))
            if "waited in vain" not in told.get("error", ""):
                break
    assert not told.get("faults") and "error" not in told, told
    return told
