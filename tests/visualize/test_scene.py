"""The 3-D page: whole in one file, small, with every point and box in it, and clicked through in a real browser."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
import subprocess
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from beambox.checks import BeamboxError
from beambox.geometry import Calibration, corners_3d
from beambox.structures import Detections, Frame, Labels
from beambox.visualize import scene
from beambox.visualize.page import fill, script_json
from beambox.visualize.scene import Scene, scene_html
from beambox.visualize.viewer import viewer_html
from oracles.browser import needs_browser, run_in_browser

BOX = [10.0, 2.0, -0.9, 4.0, 1.8, 1.5, 0.5]
POINTS = torch.tensor([[1.234, -2.5, -1.73, 0.2], [40.0, 10.0, 2.0, 0.9], [5000.0, 0.0, 0.0, 0.1]])
SCRIPT = Path(scene.__file__).with_name("scene.js")
NODE = pytest.mark.skipif(shutil.which("node") is None, reason="needs node to run the page's script")


def detections(*scores: float, names: tuple[str, ...] = ("Car",)) -> Detections:
    boxes = torch.tensor([[10.0 + 8 * k, 2.0, -0.9, 4.0, 1.8, 1.5, 0.5] for k in range(len(scores))])
    return Detections(boxes, torch.tensor(scores), torch.zeros(len(scores), dtype=torch.int64), names)


def page(**parts: Any) -> str:
    frame = Frame(POINTS, "a <b>{{DATA}}")
    return viewer_html(frame, detections(0.75), Labels(torch.tensor([BOX]), ("Car</script><!--<script>",)), **parts)


def data_of(text: str) -> dict[str, Any]:
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', text, flags=re.DOTALL)
    assert found is not None
    return json.loads(found.group(1))


def unpacked(sweep: dict[str, Any]) -> np.ndarray:
    planes = np.frombuffer(zlib.decompress(base64.b64decode(sweep["xyz"])), dtype=np.uint8).reshape(3, 2, sweep["size"])
    steps = planes[:, 0].astype(np.int64) + 256 * planes[:, 1].astype(np.int64)
    sums = np.cumsum(steps, axis=1) % 65536
    return np.where(sums >= 32768, sums - 65536, sums).T / 100


def test_points_are_kept_to_the_centimeter_and_far_ones_are_left_out_aloud() -> None:
    sweep = data_of(page())["sweeps"][0]
    assert np.allclose(unpacked(sweep), POINTS[:2, :3], atol=0.00501)
    assert len(zlib.decompress(base64.b64decode(sweep["intensity"]))) == 2
    assert "3 points, 1 farther than 327 m left out" in sweep["counts"]


def test_extreme_places_survive_the_differences() -> None:
    xyz = torch.tensor([[326.9, -326.9, 0.0], [-326.9, 326.9, 0.01], [326.9, -326.9, -0.01]])
    sweep = data_of(viewer_html(Frame(torch.cat((xyz, torch.zeros(3, 1)), dim=1))))["sweeps"][0]
    assert np.allclose(unpacked(sweep), xyz, atol=0.00501)


def test_boxes_are_there_and_no_text_can_break_the_page() -> None:
    text = page()
    truth, found = data_of(text)["sweeps"][0]["boxes"]
    assert found == {"box": BOX, "kind": 0, "truth": False, "score": 0.75}
    assert truth["truth"] and data_of(text)["classes"][1]["name"] == "Car</script><!--<script>"
    assert text.count("</script>") == 3 and text.count("<script") == 3 and "<!--" not in text
    assert "<title>a &lt;b&gt;{{DATA}}</title>" in text and text.count('"sweeps":') == 1, "a title is no mark"


def test_a_page_fetches_nothing() -> None:
    text = page()
    assert "default-src 'none'" in text
    addresses = set(re.findall(r"https?://[^\s\"'`)]+", text))
    assert addresses <= {"http://www.w3.org/1999/xhtml"}, "a namespace is no address"
    assert not re.search(r"<(script|link|img)[^>]+(src|href)=", text)


def test_marks_are_filled_once() -> None:
    assert fill("{{A}} {{B}}", {"A": "{{B}}", "B": "{{A}}"}) == "{{B}} {{A}}"
    with pytest.raises(KeyError):
        fill("{{C}}", {})
    assert json.loads(script_json("</script><!--&\u2028")) == "</script><!--&\u2028"
    assert not set("<>&\u2028") & set(script_json("</script><!--&\u2028"))


def test_a_page_of_120000_points_is_small_and_several_sweeps_are_thinned_to_fit() -> None:
    rng = np.random.default_rng(0)
    turn = np.linspace(0, 64 * 2 * np.pi, 120_000)  # 64 beams around, at distances that wander
    far = 8 + 40 * np.abs(np.sin(turn / 7)) + rng.normal(0, 0.02, len(turn))
    points = np.stack(
        (far * np.cos(turn), far * np.sin(turn), rng.normal(-1.7, 0.03, len(turn)), rng.random(len(turn))), 1
    )
    frame = Frame(torch.from_numpy(points.astype(np.float32)), "full")
    one = viewer_html(frame, detections(0.9))
    assert len(one) < 2_000_000 and data_of(one)["sweeps"][0]["size"] == 120_000
    limit = 1_600_000
    several = scene_html([Scene(frame), Scene(frame), Scene(frame)], largest=limit)
    sweeps = data_of(several)["sweeps"]
    assert len(several) <= limit
    assert 20_000 < sweeps[0]["size"] < 110_000 and f"{sweeps[0]['size']:,} of them shown" in sweeps[0]["counts"]


def test_awkward_sweeps_make_a_page() -> None:
    assert data_of(viewer_html(Frame(torch.zeros(0, 4))))["sweeps"][0]["size"] == 0
    broken = torch.tensor([[float("nan"), 0, 0, 0], [1.0, 2.0, 3.0, float("nan")], [float("inf"), 0, 0, 0]])
    assert unpacked(data_of(viewer_html(Frame(broken)))["sweeps"][0]).tolist() == [[1.0, 2.0, 3.0]]
    with pytest.raises(BeamboxError, match="at least one sweep"):
        scene_html([])
    with pytest.raises(BeamboxError, match="a track for each detection, got 2"):
        Scene(Frame(torch.zeros(0, 4)), detections(0.5), tracks=[1, 2])


def with_camera(folder: Path) -> Frame:
    calibration = Calibration(
        p2=torch.tensor([[700.0, 0, 600, 45], [0, 700, 180, 0.2], [0, 0, 1, 0.003]]),
        r0=torch.eye(3),
        velo_to_cam=torch.tensor([[0.0, -1, 0, 0.01], [0, 0, -1, -0.08], [1, 0, 0, -0.27]]),
    )
    Image.new("RGB", (1242, 375), (90, 90, 90)).save(folder / "image.png")
    return Frame(POINTS, "seen", calibration=calibration, image_path=folder / "image.png", image_size=(1242, 375))


def test_the_camera_picture_comes_with_its_projection(tmp_path: Path) -> None:
    frame = with_camera(tmp_path)
    camera = data_of(viewer_html(frame, detections(0.9)))["sweeps"][0]["camera"]
    assert camera["url"].startswith("data:image/jpeg;base64,")
    assert frame.calibration is not None
    points = torch.tensor([[12.0, 3.0, -1.0], [30.0, -4.0, 0.5]], dtype=torch.float64)
    wanted = frame.calibration.rect_to_image(frame.calibration.lidar_to_rect(points))[0] * (1000 / 1242)
    actual = torch.tensor(camera["matrix"], dtype=torch.float64) @ torch.cat((points, torch.ones(2, 1)), dim=1).T
    assert torch.allclose((actual[:2] / actual[2]).T, wanted, atol=1e-3)


def test_the_bundle_of_three_is_the_one_that_was_checked_and_brings_its_licence() -> None:
    folder = SCRIPT.parent / "vendor"
    content = (folder / "three-0.187.0.min.js").read_bytes()
    assert hashlib.sha256(content).hexdigest() == "7f048c1cb9a130b33408970952b80acb062c6f7d0d7127a8b5dd8ca0071a8f98"
    assert b"</script" not in content and "MIT License" in (folder / "three.LICENSE").read_text(encoding="utf-8")


@NODE
def test_the_script_computes_corners_hits_projections_and_points(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    xyz = torch.from_numpy(rng.uniform(-300, 300, (500, 3)).astype(np.float32))
    sweep = data_of(viewer_html(Frame(torch.cat((xyz, torch.rand(500, 1)), dim=1))))["sweeps"][0]
    probe = f"""
    (async () => {{
      const sweep = {json.dumps(sweep)}, points = await unpackPoints(sweep);
      console.log(JSON.stringify({{
        corners: boxCorners({BOX}),
        hit: boxHit([10, 0, 0, 4, 2, 2, Math.PI / 2], [0, 0, 0], [1, 0, 0], 0),
        miss: boxHit([10, 0, 0, 4, 2, 2, Math.PI / 2], [0, 2.5, 0], [1, 0, 0], 0),
        behind: boxHit({BOX}, [0, 0, 0], [-1, 0, 0]),
        inside: pointsInside([0, 0, 0, 200, 100, 400, 0.7], points.xyz),
        ahead: projectSegment([[700, 0, 0, 0], [0, 700, 0, 0], [0, 0, 1, 0]], [1, 2, 10], [1, 1, -5]),
        hidden: projectSegment([[700, 0, 0, 0], [0, 700, 0, 0], [0, 0, 1, 0]], [1, 2, -1], [1, 1, -5]),
        first: Array.from(points.xyz.slice(0, 6)), number: points.intensity.length,
      }}));
    }})();
    """
    (tmp_path / "probe.js").write_text(SCRIPT.read_text(encoding="utf-8") + probe, encoding="utf-8")
    output = subprocess.run(["node", str(tmp_path / "probe.js")], capture_output=True, text=True, check=True).stdout
    result = json.loads(output)
    assert np.allclose(result["corners"], corners_3d(torch.tensor([BOX], dtype=torch.float64))[0], atol=1e-6)
    assert result["hit"] == pytest.approx(9.0) and result["miss"] is None and result["behind"] is None
    from beambox.ops.points_in_boxes import points_in_boxes_mask

    inside = points_in_boxes_mask(torch.from_numpy(unpacked(sweep)), torch.tensor([[0, 0, 0, 200.0, 100, 400, 0.7]]))
    assert result["inside"] == int(inside.sum()) > 10
    assert np.allclose(result["ahead"][0], [70, 140]) and result["hidden"] is None
    assert np.allclose(result["first"], xyz[:2].reshape(-1), atol=0.0051) and result["number"] == 500


@needs_browser
@pytest.mark.slow  # a browser's virtual clock can run ahead of its drawing on a busy machine
def test_a_browser_draws_the_page_moves_the_slider_selects_a_box_and_steps_through_time(tmp_path: Path) -> None:
    points = torch.rand(4000, 4) * torch.tensor([60.0, 40, 2, 1]) - torch.tensor([0, 20.0, 2, 0])
    frame = Frame(points, "first")
    scenes = [
        Scene(frame, detections(0.9, 0.4, 0.2), Labels(torch.tensor([BOX]), ("Car",)), tracks=[7, 8, 9]),
        Scene(Frame(points[:100], "second"), detections(0.5)),
        Scene(with_camera(tmp_path), detections(0.8)),
    ]
    result = run_in_browser(
        scene_html(scenes, score_threshold=0.3, title="three <sweeps>"),
        """
        const at = (id) => document.getElementById(id), body = document.body.dataset;
        await until(() => body.ready);
        const before = Number(body.drawn);
        dispatchEvent(new Event("resize"));
        await until(() => Number(body.drawn) > before);
        const out = { title: document.title, fault: at("fault").textContent, start: body.boxes };
        const canvas = document.querySelector("#view canvas"), gl = canvas.getContext("webgl2");
        const pixels = new Uint8Array(4 * gl.drawingBufferWidth * gl.drawingBufferHeight);
        gl.readPixels(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
        const seen = new Set();
        for (let i = 0; i < pixels.length; i += 4) seen.add(pixels[i] + 256 * pixels[i + 1] + 65536 * pixels[i + 2]);
        out.colours = seen.size;
        at("score").value = "0.1"; at("score").dispatchEvent(new Event("input"));
        out.lower = body.boxes; out.value = at("score-value").textContent;
        at("score").value = "0.95"; at("score").dispatchEvent(new Event("input"));
        out.higher = body.boxes;
        at("score").value = "0.3"; at("score").dispatchEvent(new Event("input"));
        at("above").click();
        await until(() => [...document.querySelectorAll("#labels span")].some((tag) => tag.style.display === ""));
        await new Promise((done) => setTimeout(done, 300));
        const tag = [...document.querySelectorAll("#labels span")].find((one) => one.textContent.includes("0.90"));
        out.tag = tag.textContent;
        const [clientX, clientY] = [parseFloat(tag.style.left), parseFloat(tag.style.top)];
        const point = { clientX, clientY, pointerId: 1, button: 0, bubbles: true };
        canvas.dispatchEvent(new PointerEvent("pointerdown", point));
        canvas.dispatchEvent(new PointerEvent("pointerup", point));
        out.chosen = at("chosen").hidden ? "" : at("chosen").innerText.replace(/\\s+/g, " ");
        at("sweep").value = "1"; at("sweep").dispatchEvent(new Event("input"));
        await until(() => body.sweep === "1");
        out.second = [body.boxes, at("sweep-name").textContent, at("counts").textContent, at("chosen").hidden];
        dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight" }));
        await until(() => body.sweep === "2");
        out.camera = [at("camera").hidden, at("camera").firstElementChild.width];
        dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight" }));
        await until(() => body.sweep === "0");
        document.querySelector("#legend input").click();
        out.unticked = body.boxes;
        return out;
        """,
        tmp_path,
    )
    assert result["title"] == "three <sweeps>" and result["fault"] == ""
    assert (result["start"], result["lower"], result["higher"], result["value"]) == ("3", "4", "1", "0.10")
    assert result["colours"] > 50, "points and boxes are drawn"
    assert result["tag"] == "Car 0.90 #7"
    assert result["chosen"].startswith("Car track 7 score 0.900 x 10.00 m") and "distance 10.20 m" in result["chosen"]
    assert result["second"] == ["1", "2 / 3  second", "100 points, 1 detections", True]
    assert result["camera"] == [False, 1000]
    assert result["unticked"] == "1", "the ground truth alone is left"
