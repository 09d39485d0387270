"""PointPillars at full width on real sweeps, here and in other programs, in the same run.

    python benchmarks/peers.py [KITTI] [--packages FOLDER] [--threads 2] [--scans 12] [--rounds 5] [--json FILE]

KITTI is a data set's folder; FOLDER is where `pip install --target FOLDER --no-deps ...` put peers that are not
installed. Peers that are not there are left out and named.

All run the same network with the same random weights, whose outputs are checked to agree:

* beambox: from points in memory to boxes (crop, voxels, network, suppression); and its network alone, from voxels;
* onnxruntime, OpenVINO: the network alone, from the file that `beambox export` writes, from voxels in memory; OpenVINO
  also in bfloat16 where it would choose that by itself;
* torch-pointcloud: its own PointPillars, the network alone, from voxels in memory.

And the sparse backbone of SECOND here and in spconv (which runs on one thread: on more it is wrong in a share of runs).
Each side is a process of its own, with as many threads; sides alternate on every sweep. On a busy machine trust the CPU
time with --threads 1: threads that wait for each other wait for other programs, too.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import tempfile
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from sides import ROOT, Side, serve, timed

SIDES = {  # name -> package that it needs, whether it computes PointPillars' boxes and scores
    "beambox, points to boxes": (None, False),
    "beambox, network alone": (None, True),
    "beambox, network, plain convolutions": (None, True),
    "beambox, points to boxes, bfloat16": (None, False),
    "onnxruntime, network alone": ("onnxruntime", True),
    "OpenVINO, network alone": ("openvino", True),
    "OpenVINO, network alone, its own precision": ("openvino", True),
    "torch-pointcloud, network alone": ("torch-pointcloud", True),
    "beambox, sparse backbone": (None, False),
    "spconv, sparse backbone, 1 thread": ("spconv", False),
}
OURS = "beambox, points to boxes"
KINDS = ("median_ms", "median_of_shortest_ms", "median_of_least_cpu_ms")
Runs = tuple[Callable[[int], object], Callable[[int], Any] | None]
"""What computes scan number k, and what returns its boxes and scores."""


def random_network(points: torch.Tensor) -> Any:
    """Build PointPillars with random weights of which one anchor in a thousand finds something."""
    from beambox.detectors.pointpillars import PointPillarsConfig, pointpillars
    from beambox.structures import Batch, Frame

    torch.manual_seed(0)
    model = pointpillars(PointPillarsConfig(empty_slots=True)).eval()
    for layer in model.modules():
        if isinstance(layer, torch.nn.BatchNorm1d | torch.nn.BatchNorm2d):
            torch.nn.init.uniform_(layer.weight, 0.8, 1.6)
            torch.nn.init.normal_(layer.bias, 0, 0.1)
            layer.momentum = 1.0
    batch = Batch.of([Frame(points)])
    with torch.no_grad():
        model.train()(batch)
        torch.nn.init.normal_(model.head.cls.weight, std=0.1)
        scores = model.eval()(batch).cls.flatten()
        bias = model.head.cls.bias
        assert bias is not None
        bias -= torch.quantile(scores[:: max(1, len(scores) // 1_000_000)], 0.999) + 2.2
    return model


def prepare(data: Path, count: int, folder: Path) -> None:
    """Write sweeps, voxels, weights and the ONNX file that all sides read."""
    from beambox.data.kitti import KittiSource
    from beambox.detectors.weights import save_weights
    from beambox.export.onnx_file import export_onnx
    from beambox.ops.voxelize import voxelize

    source = KittiSource(data, "all", fov=True)
    chosen = [source[len(source) * k // count] for k in range(min(count, len(source)))]
    model = random_network(chosen[0].points)
    save_weights(folder / "network.safetensors", model, {"name": "random"})
    export_onnx(model, folder / "network.onnx")
    config = model.config
    for k, frame in enumerate(chosen):
        points = frame.points[:, :4]
        found = voxelize(points, torch.zeros(len(points), dtype=torch.int64), 1, config.grid, 32, 40000)
        order = found.voxel.argsort(stable=True)
        first = torch.searchsorted(found.voxel[order], found.voxel[order])
        padded = torch.zeros(len(found.index), 32, 4)
        padded[found.voxel[order], torch.arange(len(order)) - first] = found.points[order]
        np.savez(
            folder / f"{k}.npz", sweep=points, points=found.points, voxel=found.voxel, index=found.index[:, 1:],
            padded=padded, count=found.count,
        )  # fmt: skip


def load(folder: Path) -> list[dict[str, torch.Tensor]]:
    """Read the sweeps."""
    files = sorted(folder.glob("*.npz"), key=lambda file: int(file.stem))
    return [{name: torch.from_numpy(value) for name, value in np.load(file).items()} for file in files]


def of_beambox(name: str, folder: Path) -> Runs:
    """Detect, or run the network from voxels."""
    from beambox import load as load_detector
    from beambox.ops.voxelize import Voxels
    from beambox.structures import Frame

    if "plain" in name:
        from beambox.ops import map_conv

        map_conv.why_plain = lambda *_: "it is measured"
    detector = load_detector(
        folder / "network.safetensors", device="cpu", precision="bfloat16" if "bfloat16" in name else "float32"
    )
    sweeps = load(folder)
    frames = [Frame(sweep["sweep"]) for sweep in sweeps]

    @torch.inference_mode()
    def network(k: int) -> Any:
        """Run the network."""
        sweep = sweeps[k]
        index = torch.cat((torch.zeros_like(sweep["index"][:, :1]), sweep["index"]), dim=1)
        voxels = Voxels(sweep["points"], sweep["voxel"], sweep["count"], index, 1, detector.grid)
        return detector.model.from_voxels(voxels)

    def result(k: int) -> list[np.ndarray]:
        found = network(k)
        return [found.decoded()[0].numpy(), torch.sigmoid(found.cls[0]).numpy()]

    for frame in frames[:2]:
        detector.detect([frame])  # which also shows it empty ground
    return (lambda k: detector.detect([frames[k]]), None) if "boxes" in name else (network, result)


def of_onnxruntime(name: str, folder: Path) -> Runs:
    """Run the exported file."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    session = onnxruntime.InferenceSession(folder / "network.onnx", options, providers=["CPUExecutionProvider"])
    inputs = [{key: sweep[key].numpy() for key in ("points", "voxel", "index")} for sweep in load(folder)]
    return (lambda k: session.run(None, inputs[k])), (lambda k: session.run(None, inputs[k]))


def of_openvino(name: str, folder: Path) -> Runs:
    """Run the exported file."""
    import openvino

    options: dict[str, Any] = {"INFERENCE_NUM_THREADS": torch.get_num_threads(), "PERFORMANCE_HINT": "LATENCY"}
    options["ENABLE_CPU_PINNING"] = False  # a thread tied to a core that another program uses would wait for it
    if "own precision" not in name:
        options["INFERENCE_PRECISION_HINT"] = "f32"
    compiled = openvino.Core().compile_model(folder / "network.onnx", "CPU", options)
    request = compiled.create_infer_request()
    inputs = [{key: sweep[key].numpy() for key in ("points", "voxel", "index")} for sweep in load(folder)]

    def run(k: int) -> list[np.ndarray]:
        found = request.infer(inputs[k])
        return [found["boxes"], found["scores"]]

    return run, run


def of_torch_pointcloud(name: str, folder: Path) -> Runs:
    """Run its network with our weights: the two list their parameters in one order."""
    from torch_pointcloud.models.pointpillars import PointPillarsDetection

    from beambox.detectors.weights import load_weights
    from beambox.layers.anchors import KITTI_ANCHORS

    theirs = PointPillarsDetection(
        anchor_sizes=[anchor.size for anchor in KITTI_ANCHORS],
        anchor_bottom_heights=[anchor.bottom_z for anchor in KITTI_ANCHORS],
        feature_map_stride=2,
        norm_kwargs={"eps": 1e-3},
    ).eval()
    own = [key for key in theirs.state_dict() if "anchors" not in key]
    ours = load_weights(folder / "network.safetensors").state_dict()
    theirs.load_state_dict(dict(zip(own, ours.values(), strict=True)), strict=False)
    sweeps = load(folder)

    @torch.inference_mode()
    def run(k: int) -> Any:
        sweep = sweeps[k]
        sample = torch.zeros(len(sweep["index"]), dtype=torch.int64)
        return theirs(sweep["padded"], sweep["index"], sweep["count"], sample)

    def result(k: int) -> list[np.ndarray]:
        found = run(k)
        return [found["batch_box"][0].numpy(), torch.sigmoid(found["batch_cls"][0]).numpy()]

    return run, result


def of_sparse(name: str, folder: Path) -> Runs:
    """Run the sparse backbone on every sweep."""
    from sparse_conv import Ours, Spconv

    kind = Ours if name.startswith("beambox") else Spconv
    sides = []
    for k, sweep in enumerate(load(folder)):
        path = folder / f"{os.getpid()}-{k}.bin"
        sweep["sweep"].numpy().tofile(path)
        sides.append(kind(path, torch.float32))
    return (lambda k: sides[k].run()), (lambda k: [sides[k].run().numpy()])


def runs_of(name: str, folder: Path) -> Runs:
    """Make ready one side."""
    if "sparse" in name:
        return of_sparse(name, folder)
    makers = {
        "beambox": of_beambox,
        "onnxruntime": of_onnxruntime,
        "OpenVINO": of_openvino,
        "torch-pointcloud": of_torch_pointcloud,
    }
    return makers[name.partition(",")[0]](name, folder)


def be(name: str, folder: Path, threads: int) -> None:
    """Be one side."""
    torch.set_num_threads(1 if name.startswith("spconv") else threads)
    run, result = runs_of(name, folder)

    def save(words: str) -> str:
        number, _, path = words.partition(" ")
        if result is None:
            return "no maps"
        np.savez(path, *result(int(number)))
        return "saved"

    count = len(list(folder.glob("[0-9]*.npz")))
    for k in range(count):
        run(k)
    serve(str(count), {"run": lambda k: timed(lambda: run(int(k))), "save": save})


def installed(package: str | None) -> str | None:
    """Return a package's version, or None where it is not there."""
    try:
        return version(package) if package else version("beambox")
    except PackageNotFoundError:
        return None if package else "here"


def processor() -> str:
    """Say what the processor is and offers."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    details: dict[str, str] = {}
    for line in lines:
        key, _, value = line.partition(":")
        details.setdefault(key.strip(), value.strip())
    flags = set(details.get("flags", "").split())
    units = [unit for unit in ("avx2", "avx512f", "avx512_bf16", "amx_tile") if unit in flags]
    family = f"family {details.get('cpu family')} model {details.get('model')}" if details else ""
    return f"{details.get('model name', platform.processor())} {family}, {os.cpu_count()} cores, {' '.join(units)}"


def agreement(sides: dict[str, Side], folder: Path) -> dict[str, float]:
    """Return by how much the scores of all anchors (or the sparse backbone's map) differ from the first side's at most.

    Scores lie between 0 and 1; the map's differences are shares of its largest value.
    """
    first: dict[str, np.ndarray] = {}
    differ = {}
    for number, (name, side) in enumerate(sides.items()):
        path = folder / f"answer {number}.npz"
        if side.ask(f"save 0 {path}") == "saved":
            sparse = "sparse" in name
            found = np.load(path)["arr_0" if sparse else "arr_1"]
            wanted = first.setdefault("sparse" if sparse else "scores", found)
            scale = np.abs(wanted).max() if sparse else 1.0
            differ[name] = float(np.abs(found.reshape(wanted.shape) - wanted).max() / scale)
    return differ


def compare(arguments: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Run all sides in turn and return medians."""
    wanted = {name: needs for name, (needs, _) in SIDES.items() if not arguments.only or name in arguments.only}
    for name in [name for name, needs in wanted.items() if installed(needs) is None]:
        print(f"{name}: left out, {wanted.pop(name)} is not installed")
    prepare(arguments.data, arguments.scans, folder)
    common = [str(folder), "--threads", str(arguments.threads)]
    packages = [arguments.packages] if arguments.packages else []
    sides = {name: Side(name, [__file__, *common, "--side", name], arguments.threads, packages) for name in wanted}
    count = int(next(iter(sides.values())).details)
    times: dict[str, list[list[float]]] = {name: [[] for _ in range(count)] for name in sides}
    busy: dict[str, list[list[float]]] = {name: [[] for _ in range(count)] for name in sides}
    for _ in range(arguments.rounds):
        for k in range(count):
            for name, side in sides.items():
                wall, cpu = (float(seconds) * 1e3 for seconds in side.ask(f"run {k}").split())
                times[name][k].append(wall)
                busy[name][k].append(cpu)
    differ = agreement(sides, folder)
    medians = {
        name: statistics.median(statistics.median(of_scan) for of_scan in scans) for name, scans in times.items()
    }
    fastest = {name: statistics.median(min(of_scan) for of_scan in scans) for name, scans in times.items()}
    rows = {
        name: {
            "median_ms": round(medians[name], 2),
            "median_of_shortest_ms": round(fastest[name], 2),
            "median_of_least_cpu_ms": round(statistics.median(map(min, busy[name])), 2),
            "differs": differ.get(name),
            "version": installed(wanted[name]),
        }
        for name in sides
    }
    return {
        "processor": processor(),
        "torch": torch.__version__,
        "threads": arguments.threads,
        "scans": count,
        "rounds": arguments.rounds,
        "load_average": os.getloadavg()[0],
        "sides": rows,
    }


def show(details: dict[str, Any]) -> None:
    """Print the table and the ratios."""
    print(
        f"{details['processor']}; torch {details['torch']}, {details['threads']} threads, "
        f"load {details['load_average']:.1f}"
    )
    print(f"{details['scans']} sweeps, {details['rounds']} rounds in turn; medians over sweeps of each sweep's runs")
    print(f"{'':44} {'version':>12} {'median':>10} {'shortest':>10} {'CPU time':>10} {'differs by':>11}")
    sides = details["sides"]
    for name, row in sides.items():
        differs = "" if row["differs"] is None else f"{row['differs']:.1e}"
        print(
            f"{name:44} {row['version'] or '':>12} {row['median_ms']:7.1f} ms {row['median_of_shortest_ms']:7.1f} ms "
            f"{row['median_of_least_cpu_ms']:7.1f} ms {differs:>11}"
        )
    for name, row in sides.items():
        if OURS in sides and name != OURS and "sparse" not in name:
            first = sides[OURS]
            ratios = " / ".join(f"{first[key] / row[key]:.2f}" for key in KINDS)
            print(f"{OURS} takes {ratios} of the time of {name} (medians / shortest / CPU time)")
    sparse = [row for name, row in sides.items() if "sparse" in name]
    if len(sparse) == 2:
        ratios = " / ".join(f"{sparse[1][key] / sparse[0][key]:.2f}" for key in KINDS)
        print(f"spconv takes {ratios} times as long on the backbone (medians / shortest / CPU time)")


def main() -> None:
    data = Path(os.environ.get("BEAMBOX_DATA", ROOT / ".." / "shared" / "data"))
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("data", type=Path, nargs="?", default=data / "kitti", help="a data set in KITTI's layout")
    parser.add_argument("--packages", type=Path, help="folder that holds peers which are not installed")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--scans", type=int, default=12)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", nargs="*", choices=SIDES, help="these sides alone")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--side", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.side:
        be(arguments.side, arguments.data, arguments.threads)
        return
    if arguments.packages:
        import sys

        sys.path.append(str(arguments.packages))
    with tempfile.TemporaryDirectory() as folder:
        details = compare(arguments, Path(folder))
    show(details)
    if arguments.json:
        arguments.json.write_text(json.dumps(details, indent=1))


if __name__ == "__main__":
    main()
