"""The page to send to a colleague: whole in one file, with every point and box in it."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from beambox.geometry import corners_3d
from beambox.structures import Detections, Frame, Labels
from beambox.visualise.viewer import viewer_html

BOX = [10.0, 2.0, -0.9, 4.0, 1.8, 1.5, 0.5]
POINTS = torch.tensor([[1.234, -2.5, -1.73, 0.2], [40.0, 10.0, 2.0, 0.9], [5000.0, 0.0, 0.0, 0.1]])


def page(**parts: object) -> str:
    found = Detections(torch.tensor([BOX]), torch.tensor([0.75]), torch.tensor([0]), ("Car",))
    return viewer_html(Frame(POINTS, "a <b>"), found, Labels(torch.tensor([BOX]), ("Car</script>",)), **parts)  # type: ignore[arg-type]


def data_of(text: str) -> dict[str, object]:
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', text, flags=re.DOTALL)
    assert found is not None
    return json.loads(found.group(1))


def test_points_are_kept_to_the_centimetre_and_far_ones_left_out() -> None:
    data = data_of(page())
    xyz = np.frombuffer(base64.b64decode(str(data["xyz"])), dtype="<i2").reshape(-1, 3) / 100
    assert np.allclose(xyz, POINTS[:2, :3], atol=0.00501)
    assert len(base64.b64decode(str(data["height"]))) == len(base64.b64decode(str(data["intensity"]))) == 2


def test_boxes_names_and_scores_are_there_and_names_cannot_break_the_page() -> None:
    text = page()
    truth, found = data_of(text)["boxes"]  # type: ignore[misc]
    assert found["label"] == "Car 0.75" and found["box"] == BOX and not found["truth"]
    assert truth["truth"] and truth["colour"] != found["colour"]
    assert text.count("</script>") == 2 and "<title>a &lt;b&gt;</title>" in text
    assert "http" not in text.replace("http-equiv", ""), "nothing is fetched"


def test_a_sweep_without_points_is_a_page() -> None:
    assert data_of(viewer_html(Frame(torch.zeros(0, 4))))["xyz"] == ""


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node to run the page's script")
def test_the_script_puts_corners_and_pixels_where_they_belong(tmp_path: Path) -> None:
    script = re.findall(r"<script>\n(.*?)</script>", page(), flags=re.DOTALL)[0]
    probe = f"""
    const camera = cameraOf({{ turn: 0, tilt: 0, distance: 10, target: [10, 0, 0] }});
    const pixels = new Uint32Array(100 * 100);
    paintPoints(pixels, 100, 100, 100, camera, Int16Array.from([2000, 100, 100]), Uint8Array.from([7]),
                Array(256).fill(0xffffffff));
    console.log(JSON.stringify({{
      corners: boxCorners({BOX}),
      ahead: segment(100, 100, 100, camera, [20, 1, 1], [20, -1, 0]),
      behind: segment(100, 100, 100, camera, [-5, 0, 0], [-6, 0, 0]),
      lit: pixels.reduce((sum, value, k) => value === 0xffffffff ? sum.concat([k]) : sum, []),
    }}));
    """
    (tmp_path / "probe.js").write_text(script + probe, encoding="utf-8")
    said = subprocess.run(["node", str(tmp_path / "probe.js")], capture_output=True, text=True, check=True).stdout
    told = json.loads(said)
    assert np.allclose(told["corners"], corners_3d(torch.tensor([BOX], dtype=torch.float64))[0], atol=1e-6)
    assert np.allclose(told["ahead"], [[45, 45], [55, 50]]), "20 m ahead, 1 m left and up: left of and above the middle"
    assert told["behind"] is None
    assert {(k % 100, k // 100) for k in told["lit"]} == {(45, 45), (46, 45), (45, 46), (46, 46)}
