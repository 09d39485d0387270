"""The eightfold sparse backbone on one real sweep, here and in spconv's CPU build, in the same run.

    python benchmarks/sparse_conv.py [SCAN.bin] [--spconv FOLDER] [--threads 2] [--rounds 7] [--dtype float32]

FOLDER is where `pip install --target FOLDER --no-deps spconv==2.3.8 cumm==0.7.11 pccm ccimport ...` put the package, if
it is not installed. spconv runs on one thread, because its CPU forward pass is wrong in a share of runs on more. Each
side runs in a process of its own; rounds alternate, so that a busy machine harms both alike;
on a busy machine trust the CPU time. The sweep is cropped to 46
degrees on both sides of straight ahead, about what KITTI's camera sees.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from timing import memory_added
from torch import Tensor, nn

ROOT = Path(__file__).resolve().parents[1]


def read_voxels(scan: Path) -> Any:
    """Return the sweep's mean voxels at 0.05 x 0.05 x 0.1 m."""
    from beambox.detectors.second import KITTI_VOXELS
    from beambox.layers.encoders import mean_voxels
    from beambox.ops.voxelize import voxelize

    points = torch.from_numpy(np.fromfile(scan, np.float32).reshape(-1, 4))
    points = points[(points[:, 1].abs() < points[:, 0] * np.tan(np.radians(46))) & points.isfinite().all(dim=1)]
    sample = torch.zeros(len(points), dtype=torch.int64)
    return mean_voxels(voxelize(points, sample, 1, KITTI_VOXELS, 5, 40000))


def encoder(seed: int = 0) -> nn.Module:
    """Return the backbone with random weights and statistics, in evaluation mode."""
    from beambox.layers.encoders import VoxelEncoder

    torch.manual_seed(seed)
    network = VoxelEncoder(4).eval()
    for module in network.modules():
        if isinstance(module, nn.BatchNorm1d):
            for values, low in ((module.running_mean, -0.1), (module.running_var, 0.2), (module.weight, 0.5)):
                nn.init.uniform_(values, low, low + 0.5)
    return network


class Ours:
    """This package."""

    def __init__(self, scan: Path, dtype: torch.dtype) -> None:
        self.voxels, self.network = read_voxels(scan), encoder().to(dtype)
        self.features = self.voxels.features.to(dtype)

    def run(self) -> Tensor:
        """Encode; maps are found anew."""
        from beambox.ops.sparse_conv import SparseTensor

        voxels = self.voxels
        with torch.inference_mode():
            return self.network(SparseTensor.of(self.features, voxels.indices, voxels.shape, 1)).bev

    def parts(self) -> dict[str, float]:
        """Time the parts of one pass in CPU seconds: maps, products, and products on rows that need no gathering."""
        from beambox.ops.sparse_conv import SparseTensor, kernel_map
        from beambox.ops.sparse_conv.cpu import forward
        from beambox.ops.sparse_conv.cpu_maps import block_pairs

        voxels = self.voxels
        x = SparseTensor.of(self.features, voxels.indices, voxels.shape, 1)
        spent = {"index building": 0.0, "gather and multiply": 0.0, "multiply alone": 0.0}
        macs = 0
        for block in self.blocks():
            start = time.process_time()
            pairs = kernel_map(x.sites, block.conv.spec)
            blocks = pairs.kept(block_pairs)
            found = time.process_time()
            features = forward(x.features, block.conv.weight.detach(), None, pairs)
            done = time.process_time()
            kept = blocks.source.copy()
            in_order = np.arange(kept.size).reshape(kept.shape) % max(1, len(x.sites))
            blocks.source[:] = in_order
            again = time.process_time()
            forward(x.features, block.conv.weight.detach(), None, pairs)
            spent["multiply alone"] += time.process_time() - again
            blocks.source[:] = kept
            spent["index building"] += found - start
            spent["gather and multiply"] += done - found
            macs += int(blocks.count.sum()) * block.conv.weight[0].numel()
            x = SparseTensor(torch.relu(features), pairs.target)
        return {**spent, "GMAC": macs / 1e9}

    def blocks(self) -> list[Any]:
        """Return the network's layers in order."""
        from beambox.layers.sparse import SparseBlock

        return [module for module in self.network.modules() if isinstance(module, SparseBlock)]


class Spconv:
    """spconv's CPU build with the same weights."""

    def __init__(self, scan: Path, dtype: torch.dtype) -> None:
        import spconv.pytorch as spconv

        self.spconv, self.voxels = spconv, read_voxels(scan)
        self.indices = self.voxels.indices.int()
        layers: list[nn.Module] = []
        for number, block in enumerate(Ours.blocks(self_with(encoder()))):
            spec, (_, c_in, c_out) = block.conv.spec, block.conv.weight.shape
            if spec.submanifold:
                conv = spconv.SubMConv3d(c_in, c_out, spec.kernel, bias=False, indice_key=f"at{self.level(layers)}")
            else:
                conv = spconv.SparseConv3d(
                    c_in, c_out, spec.kernel, spec.stride, spec.padding, bias=False, indice_key=f"d{number}"
                )
            kernel = block.conv.kernel().detach()  # (kz, ky, kx, C_in, C_out)
            conv.weight.data.copy_(kernel.permute(4, 0, 1, 2, 3))
            layers += [conv, block.norm, nn.ReLU()]
        self.network = spconv.SparseSequential(*layers).eval().to(dtype)
        self.features = self.voxels.features.to(dtype)

    def level(self, layers: list[nn.Module]) -> int:
        """Count the strided layers so far: submanifold layers of one level share their maps."""
        return sum(type(layer).__name__ == "SparseConv3d" for layer in layers)

    def run(self) -> Tensor:
        """Encode; maps are found anew."""
        with torch.inference_mode():
            x = self.spconv.SparseConvTensor(self.features, self.indices, list(self.voxels.shape), 1)
            return self.network(x).dense().flatten(1, 2)


def self_with(network: nn.Module) -> Any:
    """Return something that has a network, to list its layers."""
    return type("Holder", (), {"network": network})()


def serve(arguments: argparse.Namespace) -> None:
    """Be one side until the input ends: answer `run` with wall and CPU seconds, `save PATH`, and `parts`."""
    torch.set_num_threads(arguments.threads)
    side = {"ours": Ours, "spconv": Spconv}[arguments.side](arguments.scan, getattr(torch, arguments.dtype))
    memory = memory_added(side.run) / 2**20
    print(f"ready {len(side.voxels.features)} {memory:.0f}", flush=True)
    for line in sys.stdin:
        word, _, rest = line.strip().partition(" ")
        if word == "run":
            start, busy = time.perf_counter(), time.process_time()
            side.run()
            print(time.perf_counter() - start, time.process_time() - busy, flush=True)
        elif word == "save":
            np.save(rest, side.run().float().numpy())
            print("saved", flush=True)
        elif word == "parts" and isinstance(side, Ours):
            best = min((side.parts() for _ in range(3)), key=lambda parts: parts["gather and multiply"])
            print(" ".join(f"{name.replace(' ', '_')}={value}" for name, value in best.items()), flush=True)


class Side:
    """The parent's end of one side."""

    def __init__(self, name: str, threads: int, arguments: argparse.Namespace) -> None:
        paths = [str(ROOT / "src")] + ([str(arguments.spconv)] if arguments.spconv else [])
        environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "PYTHONWARNINGS": "ignore"}
        environment.setdefault("GOMP_SPINCOUNT", "10000")  # as the command line sets it
        environment["PYTHONPATH"] = os.pathsep.join([*paths, environment.get("PYTHONPATH", "")])
        command = [sys.executable, __file__, str(arguments.scan), "--side", name, "--threads", str(threads)]
        command += ["--dtype", arguments.dtype if name == "ours" else "float32"]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        ready = self._line().split()
        if not ready:
            raise SystemExit(f"{name} could not start; see above")
        self.threads, self.voxels, self.memory = threads, int(ready[1]), int(ready[2])

    def _line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def ask(self, question: str) -> str:
        """Send one line and return the answer."""
        assert self.process.stdin is not None
        self.process.stdin.write(question + "\n")
        self.process.stdin.flush()
        return self._line()


def compare(arguments: argparse.Namespace) -> None:
    """Run both sides in turn and print what was measured."""
    sides = {"beambox": Side("ours", arguments.threads, arguments)}
    if not arguments.alone:
        sides["spconv 2.3.8"] = Side("spconv", 1, arguments)
    times = {name: [] for name in sides}
    for _ in range(arguments.rounds):
        for name, side in sides.items():
            times[name].append([float(value) for value in side.ask("run").split()])
    ours = sides["beambox"]
    print(f"{arguments.scan.name}: {ours.voxels} voxels, {arguments.dtype}, {arguments.rounds} rounds each")
    print(f"{'':14} {'threads':>7} {'median':>11} {'shortest':>11} {'CPU time':>11} {'first run adds':>15}")
    for name, side in sides.items():
        wall, busy = (np.array(column) * 1e3 for column in zip(*times[name]))
        print(
            f"{name:14} {side.threads:7} {np.median(wall):8.1f} ms {wall.min():8.1f} ms {busy.min():8.1f} ms "
            f"{side.memory:11} MiB"
        )
    if len(sides) > 1:
        (wall, busy), (their_wall, their_busy) = (zip(*times[name]) for name in sides)
        print(
            f"spconv takes {np.median(their_wall) / np.median(wall):.2f} times as long (medians), "
            f"{min(their_wall) / min(wall):.2f} (shortest), {min(their_busy) / min(busy):.2f} (CPU time)"
        )
        with tempfile.TemporaryDirectory() as folder:
            for name, side in sides.items():
                side.ask(f"save {folder}/{name}.npy")
            a, b = (np.load(f"{folder}/{name}.npy") for name in sides)
        print(f"largest difference {np.abs(a - b).max():.2e} of values up to {np.abs(b).max():.2e}")
    if arguments.dtype != "bfloat16":
        for part in ours.ask("parts").split():
            name, value = part.split("=")
            unit, scale = ("", 1) if name == "GMAC" else (" ms CPU time", 1e3)
            print(f"  {name.replace('_', ' '):22} {float(value) * scale:8.2f}{unit}")


def main() -> None:
    data = Path(os.environ.get("BEAMBOX_DATA", ROOT / ".." / "shared" / "data"))
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scan", type=Path, nargs="?", default=data / "kitti/training/velodyne/000008.bin")
    parser.add_argument("--spconv", type=Path, help="folder that holds the package spconv")
    parser.add_argument("--alone", action="store_true", help="leave spconv out")
    parser.add_argument("--threads", type=int, default=2, help="of this package; spconv runs on one")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument(
        "--dtype", default="float32", choices=["float32", "bfloat16", "float64"], help="of this package"
    )
    parser.add_argument("--side", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.side:
        serve(arguments)
    else:
        compare(arguments)


if __name__ == "__main__":
    main()
